"""Which districts a store owns, where several stores share a map: what it says of itself, and what is refused.

A store without rows in `district_owner` owns everything. One that owns "the rest" owns all districts of which it says
nothing else; one that does not owns those alone that were moved to it. Only an owner's shards and tile servers answer.
Writers are held back by triggers in the database (`copying.guard`), so that what is remembered here may be old.
"""

import logging
import threading
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol, get_args

from gnd.gnd_map.tile_id import TILES_OF_DISTRICT, District
from gnd.tile_store.connection import SqlConnection, fetch
from gnd.tile_store.errors import StoreError

DistrictState = Literal["owned", "copying", "leaving", "moved", "arriving"]
"""owned: it is this store's; copying: it is, and is being copied to another; leaving: nobody writes to it, while the
last changes are copied; moved: it is the other's; arriving: its rows come in, and it is the other's still."""
WRITTEN: Final = ("owned", "copying")
"""States in which a store takes what is said of a district."""
READ: Final = ("owned", "copying", "leaving")
"""States in which it answers for it."""
REST: Final = -1
"""The number that stands for all districts without a row."""
DEFAULT_REGION: Final = "main"
LOOK_EVERY_S: Final = 0.1
"""What is remembered of owners is at most so old."""
_LOG = logging.getLogger(__name__)


def number_of(district: District) -> int:
    """The number of a district: that of its tiles, divided by 1024."""
    return district.first_morton // TILES_OF_DISTRICT


@dataclass(frozen=True, slots=True)
class DistrictOwner:
    """What a store says of a district, or of all others (`number` -1, `path` "").

    Attributes:
        number: of the district.
        path: of the district.
        region: name of the region that has it.
        state: see `DistrictState`.
        other: the store at the other end of its last move; "": none.
        since_ns: of the state, int ns UTC.
        epoch: how often it has moved between stores.
    """

    number: int
    path: str
    region: str
    state: DistrictState
    other: str
    since_ns: int
    epoch: int

    def __post_init__(self) -> None:
        if self.state not in get_args(DistrictState):
            there_are = ", ".join(get_args(DistrictState))
            raise StoreError(f"district {self.path}: state {self.state!r}; there are {there_are}")


@dataclass(frozen=True, slots=True)
class DistrictOwners:
    """What a store says of all districts; nothing: it owns every one."""

    by_path: Mapping[str, DistrictOwner]

    @classmethod
    def of(cls, rows: Iterable[DistrictOwner]) -> "DistrictOwners":
        """Of the rows of the table."""
        return cls({row.path: row for row in rows})

    @property
    def are_several(self) -> bool:
        """Whether this store is one of several that share the map."""
        return bool(self.by_path)

    @property
    def rest(self) -> DistrictState:
        """The state of all districts without a row."""
        row = self.by_path.get("")
        return "owned" if row is None else row.state

    @property
    def region(self) -> str:
        """The name of this store's region."""
        row = self.by_path.get("")
        return DEFAULT_REGION if row is None else row.region

    def state(self, district: District) -> DistrictState:
        """Of a district."""
        row = self.by_path.get(district.path)
        return self.rest if row is None else row.state

    def takes(self, district: District) -> bool:
        """Whether what is said of the district is written here."""
        return self.state(district) in WRITTEN

    def answers(self, district: District) -> bool:
        """Whether the district's tiles are read here."""
        return self.state(district) in READ


ALL_OWNED: Final = DistrictOwners({})


class SaysOwners(Protocol):
    """What is asked of the store."""

    def district_owners(self) -> DistrictOwners:
        """See `SqlStore.district_owners`."""


class KnownOwners:
    """The owners as they were at most `LOOK_EVERY_S` ago, or when the store last answered. Safe in several threads."""

    def __init__(self, store: SaysOwners) -> None:
        self._store = store
        self._lock = threading.Lock()
        self._owners = ALL_OWNED
        self._until_s = float("-inf")

    def __call__(self) -> DistrictOwners:
        """Those of now."""
        with self._lock:
            if time.monotonic() >= self._until_s:
                self._look()
            return self._owners

    def looked_again(self) -> DistrictOwners:
        """Those that the store says now, whenever it was asked last."""
        with self._lock:
            self._look()
            return self._owners

    def _look(self) -> None:
        self._until_s = time.monotonic() + LOOK_EVERY_S
        try:
            self._owners = self._store.district_owners()
        except StoreError as error:
            _LOG.warning("cannot see whose districts are: %s", error)


class OwnsAll:
    """A store that shares its map with no other."""

    def district_owners(self) -> DistrictOwners:
        """Everything is its own."""
        return ALL_OWNED


def owners_of_districts(c: SqlConnection) -> DistrictOwners:
    """What the store says, inside the caller's transaction."""
    return DistrictOwners.of(DistrictOwner(*row) for row in fetch(c, "district_owners"))


def is_owned(c: SqlConnection, district: District) -> bool:
    """Whether a district is written to here, inside the caller's transaction."""
    wanted: dict[str, Any] = {"district": number_of(district)}
    return fetch(c, "state_of_district", wanted)[0][0] in WRITTEN
