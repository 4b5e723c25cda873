"""Colours of the classes that people who see no red or no green tell apart, too.

Vermilion, yellow and blue are those of Okabe and Ito (2008); what stayed is grey. The pictures of a run itself
(`map_after.png`) keep the paper's colours.
"""

from collections.abc import Mapping
from types import MappingProxyType

from gnd.gnd_map.classes import ChangeClass

SAFE_COLOURS: Mapping[ChangeClass, str] = MappingProxyType(
    {
        ChangeClass.NORMAL: "#9aa4b0",
        ChangeClass.NEW: "#d55e00",
        ChangeClass.MODIFIED: "#f0d000",
        ChangeClass.DELETED: "#0072b2",
        ChangeClass.EMPTY: "#d0d4d9",
        ChangeClass.UNMEASURED: "#eceef0",
    }
)
