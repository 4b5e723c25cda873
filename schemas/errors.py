"""Everything that may be wrong with a key, a message or a recorded drive.

SchemaError
├── BadKey          a key expression that is none of ours
├── WrongVersion    another major version, in a key or a message
├── TooLarge        more bytes or items than `gnd.schemas.limits` allows
├── Malformed       bytes that are not the message they should be
├── BadValue        a field whose value cannot be
├── WrongHash       content that does not have the hash it claims
├── NotSigned       a tile version that no publisher answers for, or an older one than was seen
├── LayerError      a declaration of a feature layer that cannot be, or is missing
├── DriveError      a recorded drive that cannot be read or written
├── NoPlace         a drive whose place on the Earth is not known, where one is needed
└── TrajectoryError a file of poses that cannot be read or written
"""

from gnd.gnd_map.errors import GndError


class SchemaError(GndError):
    """Base of everything that this package refuses."""


class BadKey(SchemaError):
    """A key expression that is none of ours."""


class WrongVersion(SchemaError):
    """Another major version, in a key or a message."""


class TooLarge(SchemaError):
    """More bytes or items than `gnd.schemas.limits` allows."""


class Malformed(SchemaError):
    """Bytes that are not the message they should be: truncated, random, of another kind."""


class BadValue(SchemaError):
    """A field whose value cannot be."""


class WrongHash(SchemaError):
    """Content that does not have the hash it claims."""


class NotSigned(SchemaError):
    """A tile version that no publisher answers for, or an older one than was seen."""


class LayerError(SchemaError):
    """A declaration of a feature layer that cannot be, or is missing."""


class DriveError(SchemaError):
    """A recorded drive that cannot be read or written."""


class NoPlace(SchemaError):
    """A drive whose place on the Earth is not known, where one is needed."""


class TrajectoryError(SchemaError):
    """A file of poses that cannot be read or written."""
