"""Which shard answers for which district: rendezvous hashing over the shards that live.

Every member computes the same owner from the same members, without talking; when one goes, only its districts move.
Ownership spreads the ingest and keeps caches warm. It protects nothing: that is the store's compare-and-swap.
"""

import logging
import threading
import time
from collections.abc import Collection
from hashlib import blake2b
from typing import Final

from gnd.fleet_bus.bus import Bus
from gnd.gnd_map.tile_id import District
from gnd.schemas.keys import alive_keys, parse_alive_key
from gnd.tile_store.errors import StoreError
from gnd.tile_store.store import Store

ROLE: Final = "merger"
LOOK_EVERY_S: Final = 1.0
_LOG = logging.getLogger(__name__)


def owner_of(district: District, members: Collection[str]) -> str:
    """The member with the highest hash of (member, district); the same in every process. `members` is not empty."""
    return max(members, key=lambda member: (_score(member, district), member))


def _score(member: str, district: District) -> bytes:
    return blake2b(f"{member}\0{district.path}".encode(), digest_size=16).digest()


class Members:
    """The shards that live, as this shard sees them; itself always among them. Safe to use from any thread."""

    def __init__(self, own: str) -> None:
        self.own = own
        self._lock = threading.Lock()
        self._living = frozenset({own})

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
        """Whether this shard owns the district among those that live."""
        return owner_of(district, self._living) == self.own


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


def following(bus: Bus, own: str) -> Members:
    """The members as they come and go from now on, for who only wants to know whose a district is."""
    members = Members(own)

    def note(key: str, alive: bool) -> None:
        members.note(parse_alive_key(key)[1], alive=alive)

    bus.watch_alive(alive_keys(ROLE), note)
    return members
