"""What the merger refuses.

GndError
└── MergerError   a parameter or configuration that cannot be used
    └── BadReport a report that cannot be a true statement about this map
"""

from gnd_map.errors import GndError


class MergerError(GndError):
    """Base of the merger's errors; also a parameter or configuration that cannot be used."""


class BadReport(MergerError):
    """A report that cannot be a true statement about this map; the message says why, with numbers."""
