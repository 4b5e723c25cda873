"""Errors of the launcher.

GndError
└── DeployError            a run cannot start or continue
    ├── RunFolderError     the output folder cannot be used
    ├── ProcessDied        a process ended too often to be restarted
    ├── LabError           namespaces or shaped links cannot be made or are taken
    │   └── LabRuns        a lab of that name is running
    ├── PageError          a page cannot be written
    ├── ReportError        a run cannot be reported
    ├── ServeError         a map cannot be shown in the browser
    ├── BadQuestion        a browser asks for what there is not
    ├── ChaosError         a chaos run cannot start, or its street cannot be read
    ├── LoadError          a load cannot be made
    └── NoStudies          the papers' results can be reproduced in a checkout only
"""

from gnd.gnd_map.errors import GndError


class DeployError(GndError):
    """A fleet run cannot start or continue."""


class RunFolderError(DeployError):
    """The output folder cannot be used."""


class ProcessDied(DeployError):
    """A process ended more often than the supervisor restarts it."""


class LabError(DeployError):
    """Namespaces or shaped links cannot be made, or are taken by another lab."""


class LabRuns(LabError):
    """A lab of that name is running."""


class PageError(DeployError):
    """A page cannot be written."""


class ReportError(DeployError):
    """A run cannot be reported: it is none, its map is missing, or there is no browser that prints."""


class ServeError(DeployError):
    """A map cannot be shown in the browser: an address that others reach without a token, a page that is missing."""


class BadQuestion(DeployError):
    """A browser asks for what there is not, or for too much."""


class ChaosError(DeployError):
    """A chaos run cannot start, or its street cannot be read."""


class LoadError(DeployError):
    """A load cannot be made: no drives to replay, or more streets than the Earth has room for."""


class NoStudies(DeployError):
    """The studies are not there: the papers' results can be reproduced in a checkout only."""
