"""One run of the localiser over a recorded drive, the map's tiles held around the vehicle as the agent does."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from gnd.gnd_map.motion import Trajectory
from gnd.schemas.drive import DriveHeader, DriveItem, GnssFix, ReferencePose, Scan
from gnd.vehicle_agent.config import PipelineParameters
from gnd.vehicle_agent.localise.estimates import PoseEstimate
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.pipeline import Pipeline
from gnd.vehicle_agent.sources.recording import first_fix
from gnd.vehicle_agent.tiles_at_hand import TilesAtHand
from studies.localisation_study.series import PoseSeries
from studies.simulation.base_map import BaseMap

WITHOUT: Final = "without_submap"
OUTDATED: Final = "outdated"
UPDATED: Final = "updated"
FRESH: Final = "fresh"
"""Runs: on the outdated map without and with submaps, and on the two newer maps."""


@dataclass(frozen=True, slots=True, eq=False)
class LocalisedVariant:
    """What a run gave: final and online poses against the truth, and how many scans it was given."""

    final: PoseSeries
    online: PoseSeries
    scans: int


class LocalisingVehicle:
    """A localiser over held tiles; gives its online pose after every scan.

    Attributes:
        scans: how many its sensor gave, usable or not.
        online: all online poses so far, those called lost left out.
    """

    def __init__(self, header: DriveHeader, fix: GnssFix, base: BaseMap, parameters: LocaliserParameters) -> None:
        self.pipeline = Pipeline(
            header,
            fix,
            lambda local_map, touched: TilesAtHand(base, local_map, touched),
            PipelineParameters(localise=parameters),
        )
        self.scans = 0
        self.online: list[PoseEstimate] = []
        self.T_map_anchor = self.pipeline.place.frame.T_self_other(header.anchor)
        self._final: list[PoseEstimate] = []
        self._newest_ns = -1

    def push(self, item: DriveItem) -> None:
        """Take a measurement."""
        output = self.pipeline.push(item)
        self._final += output.poses
        if output.online is not None and output.online.t_ns > self._newest_ns:
            self._newest_ns = output.online.t_ns
            self.online += [output.online] if output.online.health != "lost" else []

    def finish(self) -> list[PoseEstimate]:
        """End the drive and give all final poses."""
        self._final += self.pipeline.finish().poses
        return self._final

    def reference(self, poses: Iterable[ReferencePose]) -> Trajectory:
        """Return true poses in this vehicle's map frame."""
        known = list(poses)
        T = self.T_map_anchor @ np.stack([pose.T_map_vehicle for pose in known])
        return Trajectory(np.array([pose.t_ns for pose in known], np.int64), T)


def localise(
    header: DriveHeader,
    items: Iterable[DriveItem],
    base: BaseMap,
    parameters: LocaliserParameters,
) -> LocalisedVariant:
    """Run the localiser over a drive.

    Args:
        header: of the drive.
        items: in time order, with reference poses, which the vehicle never sees.
        base: the map that it drives on.
        parameters: of the localiser.

    Raises:
        VehicleError: the drive has no GNSS fix.
    """
    fix, all_items = first_fix(items, header.drive_id)
    vehicle = LocalisingVehicle(header, fix, base, parameters)
    reference: list[ReferencePose] = []
    for item in all_items:
        vehicle.scans += isinstance(item, Scan)
        if isinstance(item, ReferencePose):
            reference.append(item)
        else:
            vehicle.push(item)
    final, true = vehicle.finish(), vehicle.reference(reference)
    return LocalisedVariant(PoseSeries.of(final, true), PoseSeries.of(vehicle.online, true), vehicle.scans)


def without_submaps(parameters: LocaliserParameters) -> LocaliserParameters:
    """Return the parameters of the general graph SLAM: final poses are those that leave the pose graph."""
    return replace(parameters, refine=replace(parameters.refine, enabled=False))
