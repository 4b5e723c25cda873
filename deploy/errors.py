"""Errors of the launcher.

GndError
└── DeployError            a run cannot start or continue
    ├── RunFolderError     the output folder cannot be used
    ├── ProcessDied        a process ended too often to be restarted
    └── RegionError        a region that is no wildcard, tile or circle
"""

from gnd_map.errors import GndError


class DeployError(GndError):
    """A fleet run cannot start or continue."""


class RunFolderError(DeployError):
    """The output folder cannot be used."""


class ProcessDied(DeployError):
    """A process ended more often than the supervisor restarts it."""


class RegionError(DeployError):
    """A region that is neither a wildcard, nor a tile, nor a circle."""
