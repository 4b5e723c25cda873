"""Errors of the merger; all are `MergerError`."""

from gnd_map.errors import GndError


class MergerError(GndError):
    """Base of the merger's errors."""


class BadReport(MergerError):
    """A report that cannot be a true statement about this map; the message says why, with numbers."""


class MergeFailed(MergerError):
    """A tile whose merge raised; the message names the tile and the attempt."""
