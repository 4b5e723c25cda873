"""Localisation on the GND map: first pose, scan-to-map matching, pose graph, final poses for the evidence."""

from gnd.vehicle_agent.localise.estimates import LocalisationError, PoseEstimate, RefinedScan, localisation_error
from gnd.vehicle_agent.localise.localiser import Localiser
from gnd.vehicle_agent.localise.parameters import LocaliserParameters

__all__ = [
    "LocalisationError",
    "Localiser",
    "LocaliserParameters",
    "PoseEstimate",
    "RefinedScan",
    "localisation_error",
]
