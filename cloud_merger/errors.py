"""What the merger refuses.

GndError
└── MergerError   a parameter or configuration that cannot be used
    ├── BadReport   a report that cannot be a true statement about this map
    └── MissingBase a packed report against a version that is not here: the vehicle is to send it whole
"""

from gnd_map.errors import GndError


class MergerError(GndError):
    """Base of the merger's errors; also a parameter or configuration that cannot be used."""


class BadReport(MergerError):
    """A report that cannot be a true statement about this map; the message says why, with numbers."""


class MissingBase(MergerError):
    """A packed report was coded against a version that is not here; the message says which."""
