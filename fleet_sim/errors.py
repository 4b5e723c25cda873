"""Errors of the simulator; every one is a `SimError`."""

from gnd.gnd_map.errors import GndError


class SimError(GndError):
    """Base of everything that the simulator refuses."""


class WorldError(SimError):
    """A world file is missing, corrupt or says something impossible."""


class SimShapeError(SimError):
    """A primitive with impossible dimensions."""


class SceneError(SimError):
    """A ray caster was asked for something outside the scene that it was built for."""


class DriveSimError(SimError):
    """A simulated drive cannot be made as asked."""


class TruthError(SimError):
    """A truth file is missing, corrupt or belongs to another world."""


class EvaluationError(SimError):
    """A prediction cannot be compared with the truth."""


class RoadError(SimError):
    """A road or a drive along it cannot be made as asked."""
