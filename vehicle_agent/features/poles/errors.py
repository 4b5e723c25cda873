"""Errors of the pole detector."""

from gnd.vehicle_agent.errors import VehicleError


class PoleError(VehicleError):
    """Base of what the pole detector raises."""


class PoleInputError(PoleError):
    """Points that are no scan: wrong shape, or rays without an origin."""
