"""The classes of map changes (GND, Figure 3 and 4.4) and the colours that the paper gives them."""

from collections.abc import Mapping
from enum import IntEnum
from types import MappingProxyType


class ChangeClass(IntEnum):
    """What became of a voxel between the map and the world."""

    NORMAL = 0
    """A Gaussian in both, the same."""
    NEW = 1
    """A Gaussian in the world that the map lacks."""
    MODIFIED = 2
    """A Gaussian in both, of another shape or place."""
    DELETED = 3
    """A Gaussian in the map that is gone from the world."""
    EMPTY = 4
    """None in either."""
    UNMEASURED = 5
    """No ray came near enough to say."""


CHANGED = (ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED)

CLASS_COLOURS: Mapping[ChangeClass, str] = MappingProxyType(
    {
        ChangeClass.NORMAL: "#1f5fd0",  # blue
        ChangeClass.NEW: "#e02020",  # red
        ChangeClass.MODIFIED: "#ff9010",  # orange
        ChangeClass.DELETED: "#20a040",  # green
        ChangeClass.EMPTY: "#a0a0a0",  # grey
        ChangeClass.UNMEASURED: "#e4e4e4",  # light grey; the paper draws none
    }
)
