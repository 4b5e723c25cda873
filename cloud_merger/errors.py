"""What the merger refuses.

GndError
└── MergerError   a parameter or configuration that cannot be used
    ├── BadReport  a report that cannot be a true statement about this map
    └── NotUnderstood   a report in short that means nothing here
        └── MissingBase a version that it was coded against is not here
"""

from gnd.gnd_map.errors import GndError


class MergerError(GndError):
    """Base of the merger's errors; also a parameter or configuration that cannot be used."""


class BadReport(MergerError):
    """A report that cannot be a true statement about this map; the message says why, with numbers."""


class NotUnderstood(MergerError):
    """A report in short, perhaps a good one, that means nothing here: the vehicle is to send more."""


class MissingBase(NotUnderstood):
    """A packed report was coded against a version that is not here; the message says which."""
