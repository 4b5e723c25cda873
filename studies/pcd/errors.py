"""What the point-cloud baseline refuses.

GndError
└── PcdError        a parameter, a point cloud or a report that cannot be used
    └── PcdCodecError bytes that are no encoded report
"""

from gnd.gnd_map.errors import GndError


class PcdError(GndError):
    """Base of the point-cloud baseline's errors; also a parameter, cloud or report that cannot be used."""


class PcdCodecError(PcdError):
    """Bytes are truncated, too long, or do not decode to a valid report."""
