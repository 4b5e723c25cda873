"""What can go wrong with a store; every message is one line, with numbers and what to do.

GndError
StoreError             a store cannot do what was asked
StoreUnavailable     it cannot be opened: no such file, no permission, not a store, a newer schema
StoreDamaged       a part of it cannot be read
StoreBusy            another process has held the write lock for too long
StoreClosed          it was used after close()
UnknownVersion       the tile has no such version
UnknownReports       a publication names reports that the store does not hold
IdTaken              a report has the id of another vehicle's
"""

from gnd.gnd_map.errors import GndError


class StoreError(GndError):
    """A store cannot do what was asked."""


class StoreUnavailable(StoreError):
    """The store cannot be opened, or has failed while it was in use."""


class StoreDamaged(StoreUnavailable):
    """A page of the store cannot be read; what does not lie on it can."""


class StoreBusy(StoreError):
    """Another process has held the write lock for longer than `BUSY_TIMEOUT_S`."""


class StoreClosed(StoreError):
    """The store was used after close()."""


class UnknownVersion(StoreError):
    """The tile has no such version, or retention has removed it."""


class UnknownReports(StoreError):
    """A publication names reports that the store does not hold for its tile."""


class IdTaken(StoreError):
    """A report has the id of another vehicle's report about the same tile: it needs another in the journal."""
