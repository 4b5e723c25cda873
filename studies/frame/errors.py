"""Errors of the studies; each is one line for the command line."""

from gnd.gnd_map.errors import GndError


class ReproduceError(GndError):
    """Base of everything that a study refuses."""


class OptionError(ReproduceError):
    """An option that cannot work; the message says what can."""


class FolderError(ReproduceError):
    """A folder that holds no such run, or cannot be written."""


class RealDataError(ReproduceError):
    """A recording, or a choice of options, on which nothing can be measured."""


class Stopped(ReproduceError):
    """The run was asked to end early; what is done is kept."""


class BrowserError(ReproduceError):
    """There is no browser to measure in, or the page does not come to what is measured."""
