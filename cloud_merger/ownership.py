"""Which shard answers for which district: rendezvous hashing with bounded loads over the shards that live.

Every member computes the same owners from the same members and the districts of the map, without talking. Who has the
highest hash of (member, district) gets the district, unless it has its share already. When a member goes, hardly more
than its districts move. Districts that the map does not have yet go by the hash alone.
Ownership spreads the ingest and keeps caches warm. It protects nothing: that is the store's compare-and-swap. So
members may differ for some seconds in what they know: two acknowledge a report, or nobody does and it is sent again.

Where several stores share a map, all that is among the shards of one store, about the districts that it owns; what has
moved to another is nobody's here, and the store refuses it whatever a shard believes.
"""

import logging
import math
import threading
import time
from collections.abc import Callable, Collection
from hashlib import blake2b
from typing import Final

from gnd.fleet_bus.bus import Bus
from gnd.gnd_map.tile_id import District
from gnd.schemas.keys import alive_keys, parse_alive_key
from gnd.tile_store.districts import KnownOwners, OwnsAll
from gnd.tile_store.errors import StoreError
from gnd.tile_store.store import Store

ROLE: Final = "merger"
LOOK_EVERY_S: Final = 1.0
DISTRICTS_EVERY_S: Final = 5.0
"""The districts of the map are read so often."""
MOST_OF_MEAN: Final = 1.1
"""A member gets at most so many times the mean of the districts, rounded down, but at least the mean, rounded up."""
ENOUGH_FOR_HASHES: Final = 1000
"""With more districts a member than these, hashes alone come as near: three standard deviations are a tenth."""
_LOG = logging.getLogger(__name__)


def owner_of(district: District, members: Collection[str]) -> str:
    """The member with the highest hash of (member, district); the same in every process. `members` is not empty."""
    return max(members, key=lambda member: (_score(member, district), member))


def largest_share(districts: int, members: int) -> int:
    """So many districts a member gets at most."""
    mean = districts / members
    return max(math.ceil(mean), math.floor(MOST_OF_MEAN * mean))


def shared_out(districts: Collection[District], members: Collection[str]) -> dict[District, str]:
    """Each district's owner, the same in every process; no member gets more than its share.

    Pairs of member and district take their places in the order of their hashes, as long as the member has room: a
    stable matching, of which little changes when a member or a district comes or goes.

    Args:
        districts: of the map.
        members: names of those that live; not empty.
    """
    if len(districts) > ENOUGH_FOR_HASHES * len(members):
        return {district: owner_of(district, members) for district in districts}
    room = dict.fromkeys(members, largest_share(len(districts), len(members)))
    pairs = [(_score(member, district), member, district.path, district) for district in districts for member in room]
    owners: dict[District, str] = {}
    for _, member, _, district in sorted(pairs, reverse=True):
        if district not in owners and room[member]:
            owners[district] = member
            room[member] -= 1
    return owners


def _score(member: str, district: District) -> bytes:
    return blake2b(f"{member}\0{district.path}".encode(), digest_size=16).digest()


_NONE: Final[frozenset[District]] = frozenset()


def no_districts() -> frozenset[District]:
    """Of a map that nobody looks at: owners go by hashes alone."""
    return _NONE


class Members:
    """The shards that live, as this shard sees them; itself always among them. Safe to use from any thread.

    Args:
        own: name of this shard.
        districts: gives the districts of the map; the same object as long as they are the same.
        owners: which districts the store owns; None: all.
    """

    def __init__(
        self,
        own: str,
        districts: Callable[[], frozenset[District]] = no_districts,
        owners: KnownOwners | None = None,
    ) -> None:
        self.own = own
        self.owners = owners or KnownOwners(OwnsAll())
        self._districts = districts
        self._lock = threading.Lock()
        self._living = frozenset({own})
        self._shared: tuple[frozenset[str], frozenset[District], dict[District, str]] = self._living, _NONE, {}

    @property
    def living(self) -> frozenset[str]:
        """All members now."""
        return self._living

    def note(self, member: str, *, alive: bool) -> bool:
        """A token has come or gone; whether that changes who lives."""
        with self._lock:
            before = self._living
            self._living = before | {member} if alive else (before - {member}) | {self.own}
            return self._living != before

    def is_mine(self, district: District) -> bool:
        """Whether the store owns the district, and this shard among those that live."""
        if not self.owners().takes(district):
            return False
        living = self._living
        return (self._owners(living).get(district) or owner_of(district, living)) == self.own

    def _owners(self, living: frozenset[str]) -> dict[District, str]:
        """Of the districts of the map; shared out again when members or districts have changed."""
        districts = self._districts()
        with self._lock:
            of_living, of_districts, owners = self._shared
            if living != of_living or districts is not of_districts:
                owners = shared_out(districts, living)
                self._shared = living, districts, owners
            return owners


class KnownShards:
    """The shards that work on this map, as the store says: each gives a sign of life there, and nobody who cannot write
    to the store can forge one. Safe to use from any thread.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._lock = threading.Lock()
        self._living: frozenset[str] = frozenset()
        self._until_s = 0.0

    def has(self, name: str) -> bool:
        """Whether a shard of this name lives, as it was at most a second ago; a store that fails says what it said."""
        with self._lock:
            if time.monotonic() >= self._until_s:
                self._until_s = time.monotonic() + LOOK_EVERY_S
                try:
                    self._living = frozenset(shard.owner for shard in self._store.shards() if shard.is_alive)
                except StoreError as error:
                    _LOG.warning("cannot see which shards live: %s", error)
            return name in self._living


class KnownDistricts:
    """The districts of the map, as they were at most `DISTRICTS_EVERY_S` ago, or when the store last answered. Safe to
    use from any thread.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._lock = threading.Lock()
        self._districts: frozenset[District] = frozenset()
        self._until_s = 0.0

    def __call__(self) -> frozenset[District]:
        """Those of now; the same object as long as they are the same."""
        with self._lock:
            if time.monotonic() >= self._until_s:
                self._until_s = time.monotonic() + DISTRICTS_EVERY_S
                try:
                    found = self._store.districts()
                    self._districts = self._districts if found == self._districts else found
                except StoreError as error:
                    _LOG.warning("cannot see which districts there are: %s", error)
            return self._districts


def following(
    bus: Bus,
    own: str,
    districts: Callable[[], frozenset[District]] = no_districts,
    owners: KnownOwners | None = None,
) -> Members:
    """The members as they come and go from now on, for who only wants to know whose a district is."""
    members = Members(own, districts, owners)

    def note(key: str, alive: bool) -> None:
        members.note(parse_alive_key(key)[1], alive=alive)

    bus.watch_alive(alive_keys(ROLE), note)
    return members
