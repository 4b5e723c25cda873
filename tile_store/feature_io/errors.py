"""What can be wrong with a file of features; nothing of such a file is imported.

FeatureFileError   a file cannot be read or written as features; says which file, and where in it
NotWellFormed      it is no XML, no JSON, or cut off
UnsafeFile         it brings what no map needs and what can harm: a document type, entities
FileTooLarge       more bytes, nodes or vertices than the limits allow
UnknownFormat      no format that is known, or a version of it that is not
BadElement         an element lacks what it must have: a position, an id, a number
DuplicateId        two elements have the same id
MissingReference   an element names others that the file does not hold
BadGeometry        positions beyond the Earth or their frame, lines that cross themselves, crossing borders of a lane
NeedsGeoreference  local coordinates, and nothing says where they lie
MissingLibrary     an optional library is needed and not installed
"""

from gnd.tile_store.errors import StoreError


class FeatureFileError(StoreError):
    """A file cannot be read or written as features."""


class NotWellFormed(FeatureFileError):
    """The file is no XML or no JSON, or it is cut off."""


class UnsafeFile(FeatureFileError):
    """The file declares a document type or entities, which can grow to any size when they are expanded."""


class FileTooLarge(FeatureFileError):
    """The file exceeds a limit."""


class UnknownFormat(FeatureFileError):
    """The format, or this version of it, is not known."""


class BadElement(FeatureFileError):
    """An element lacks what it must have, or has what cannot be."""


class DuplicateId(FeatureFileError):
    """Two elements have the same id."""


class MissingReference(FeatureFileError):
    """An element names another that the file does not hold."""


class BadGeometry(FeatureFileError):
    """Positions or lines that cannot be."""


class NeedsGeoreference(FeatureFileError):
    """Coordinates are local, and nothing says where on the Earth they lie."""


class MissingLibrary(FeatureFileError):
    """An optional library is needed for this file."""
