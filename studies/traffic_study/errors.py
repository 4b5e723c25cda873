"""Errors of the traffic study; each is one line for the command line."""

from studies.simulation.errors import ReproduceError


class TrafficError(ReproduceError):
    """An upload that did not get through, a baseline that cannot be written."""
