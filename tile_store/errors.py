"""What can go wrong with a store; every message is one line, with numbers and what to do.

GndError
StoreError             a store cannot do what was asked
StoreUnavailable     it cannot be opened: no such file, no permission, not a store, a newer schema
StoreDamaged       a part of it cannot be read
StoreAway          the server of its database does not answer, or starts or stops
ObjectsAway        who keeps objects, such as bodies of versions, does not answer
ClocksApart        a version was signed at a time that has not come, by the clock of here
StoreBusy            another process has held the write lock for too long
StoreMoved         it was copied to another database, which is used instead
DistrictElsewhere    a district that the store does not own, or that is just moving: nothing was written
StoreClosed          it was used after close()
NotPublished         signed versions, and nobody to sign another one
UnknownVersion       the tile has no such version
ChangedMeanwhile     a tile has another version than the one that somebody decided about
UnknownReports       a publication names reports that the store does not hold
IdTaken              a report has the id of another vehicle's
"""

from typing import Final

from gnd.gnd_map.errors import GndError

NO_ROW: Final = (TypeError, ValueError, KeyError, IndexError, ArithmeticError, AttributeError)
"""What rows with values that nobody has written lead to."""


class StoreError(GndError):
    """A store cannot do what was asked."""


class StoreUnavailable(StoreError):
    """The store cannot be opened, or has failed while it was in use."""


class StoreDamaged(StoreUnavailable):
    """A page of the store cannot be read; what does not lie on it can."""


class StoreAway(StoreUnavailable):
    """The server of the store's database does not answer, or starts or stops: it may come."""


class ObjectsAway(StoreUnavailable):
    """Who keeps objects, such as bodies of versions, does not answer, or cannot do now what is asked: it may pass. No
    report and no tile is to blame.
    """


class ClocksApart(StoreUnavailable):
    """A version was signed at a time that has not come, by the clock of here: it may be that clock which is wrong. No
    tile is to blame.
    """


BLAMELESS: Final = (ObjectsAway, ClocksApart)
"""What may pass, and is no tile's and no report's fault."""


class StoreMoved(StoreUnavailable):
    """The store was copied to another database, which is to be used instead.

    Attributes:
        target: where that is.
    """

    def __init__(self, location: str, line: str) -> None:
        self.target = line.partition("moved to ")[2].split(" CONTEXT:")[0].strip()
        super().__init__(f"{location}: moved to {self.target}; nothing was written, start this with that store")


class DistrictElsewhere(StoreError):
    """The district is another store's, or is just moving to it: nothing was written here; who asked is to ask again."""

    def __init__(self, location: str) -> None:
        super().__init__(
            f"{location}: nothing was written, as the district has moved to another store, or is just moving"
            " (`gnd regions list`)"
        )


DISTRICT_REFUSED: Final = "a district that is not written to here"
"""How the databases say it."""


def odd_row(location: str, error: Exception) -> StoreDamaged:
    """The error of a store of which a row cannot be read as what it should be."""
    reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
    return StoreDamaged(f"{location}: holds a row that no store has ({reason}); see `gnd map check`")


class StoreBusy(StoreError):
    """Another process has held the write lock for longer than `BUSY_TIMEOUT_S`."""


class StoreClosed(StoreError):
    """The store was used after close()."""


class NotPublished(StoreError):
    """The versions of the store are signed, and whoever wants to publish has no identity to sign with."""


class UnknownVersion(StoreError):
    """The tile has no such version, or retention has removed it."""


class ChangedMeanwhile(StoreError):
    """A tile has another version than the one that somebody looked at and decided about; nothing was done."""


class UnknownReports(StoreError):
    """A publication names reports that the store does not hold for its tile."""


class ImpossiblePlace(StoreError):
    """A vehicle says to have been where it cannot have been, by its other reports."""


class IdTaken(StoreError):
    """A report has the id of another vehicle's report about the same tile: it needs another in the journal."""
