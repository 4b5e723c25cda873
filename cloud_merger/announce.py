"""Update notices. The store keeps a mark for each version that nobody has announced, written in the version's own
transaction; so a notice outlives the shard that published the version, and goes out at least once.
"""

import logging
import math
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

from gnd.cloud_merger.ownership import Members
from gnd.cloud_merger.stored import Bases
from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.seldom import Seldom
from gnd.fleet_bus.subscribing import RecallingPublisher
from gnd.gnd_map.content import AnyTile, changed_between, encode_content_delta, has_deltas
from gnd.gnd_map.errors import CodecError
from gnd.gnd_map.tile import Tile, diff
from gnd.schemas.errors import SchemaError, TooLarge
from gnd.schemas.keys import update_key
from gnd.schemas.updates import TileUpdate
from gnd.tile_store.errors import ClocksApart, StoreDamaged
from gnd.tile_store.store import Store
from gnd.tile_store.values import Notice, StoredTile

REMEMBERED_KEYS: Final = 2048
# A notice goes to everybody who listens: it carries what has changed only where that is little more than itself.
# Who holds the tile asks for the rest.
NOTICE_DELTA_BYTES: Final = 512
# More voxels, or more Gaussians among them, are not even encoded: they would not fit.
NOTICE_DELTA_VOXELS: Final = 256
NOTICE_DELTA_PUT: Final = 128
# The worker of an owner that lives may be starting, stopped, or without room on its disk: its notices go out all the
# same.
OTHERS_AFTER_S: Final = 0.3
# Who is busy itself finds the owner busy, too: it is given more time, for it has in memory what a notice is made of.
BUSY_OTHERS_AFTER_S: Final = 2.0
_LOG = logging.getLogger(__name__)
_SELDOM: Final = Seldom(_LOG)
Read = Callable[[StoredTile], AnyTile]


class Announcer:
    """Announces the versions of the districts that this shard owns, oldest first, then unmarks them; and those of
    others that still wait `OTHERS_AFTER_S` after it has seen them first, or `BUSY_OTHERS_AFTER_S` while it is busy.

    The last notice of each of the newest `REMEMBERED_KEYS` tiles is repeated to late subscribers. Versions that were
    merged here lie in `bases`, and are not decoded again.
    """

    def __init__(self, store: Store, bus: Bus, members: Members, bases: Bases) -> None:
        self._store, self._bus, self._members, self._bases = store, bus, members, bases
        self._publishers: OrderedDict[str, RecallingPublisher] = OrderedDict()
        self._last_s = -math.inf
        self._seen_s: dict[Notice, float] = {}  # notices of others, since when, by the monotonic clock

    def announce(self, at_most: int, every_s: float = 0.0, *, is_busy: bool = False) -> int:
        """Announce what waits, up to `at_most` versions; the number announced (0 without a router, and where the last
        round was less than `every_s` ago). `is_busy`: this shard has tiles to merge.
        """
        now_s = time.monotonic()
        if now_s - self._last_s < every_s or not self._bus.is_connected():
            return 0  # a notice put without a router would vanish in silence
        self._last_s = now_s
        late_s = BUSY_OTHERS_AFTER_S if is_busy else OTHERS_AFTER_S
        waiting = self._own_and_late(self._store.notices(n=at_most), late_s)
        done = [notice for notice in waiting if self._announce(notice)]
        if done:
            self._store.announced(done)
        return len(done)

    def _own_and_late(self, waiting: Sequence[Notice], late_s: float) -> list[Notice]:
        now_s = time.monotonic()
        foreign = [one for one in waiting if not self._members.is_mine(one.tile.district)]
        self._seen_s = {one: self._seen_s.get(one, now_s) for one in foreign}
        return [one for one in waiting if now_s - self._seen_s.get(one, -math.inf) >= late_s]

    def _announce(self, notice: Notice) -> bool:
        """Whether it is done with; False: it is to be announced later."""
        stored = self._store.get(notice.layer, notice.tile, notice.version)
        if stored is None:
            _LOG.info("%s version %d went before it was announced", notice.tile, notice.version)
            return True
        try:
            self._store.check_signed(stored)
        except ClocksApart as error:
            _SELDOM.warning("not announced now: %s", error)
            return False
        except StoreDamaged as error:  # the notice's seal would make somebody else's version ours
            _LOG.error("not announced: %s", error)
            return True
        parent = self._store.get(notice.layer, notice.tile, stored.parent) if stored.parent else None
        key = update_key(notice.layer, notice.tile)
        self._publisher(key).put(encoded(update_of(stored, parent, self._bases.tile)), tile=notice.tile)
        return True

    def _publisher(self, key: str) -> RecallingPublisher:
        publisher = self._publishers.pop(key, None) or self._bus.advanced_publisher(key)
        self._publishers[key] = publisher
        if len(self._publishers) > REMEMBERED_KEYS:
            self._publishers.popitem(last=False)[1].close()
        return publisher


def update_of(stored: StoredTile, parent: StoredTile | None, read: Read = StoredTile.decode) -> TileUpdate:
    """The notice of a version; without its parent (new tile, or gone from the store) it carries no delta.

    `read` decodes a version.
    """
    update = TileUpdate(
        tile=stored.tile,
        layer=stored.layer,
        version=stored.version,
        previous_version=parent.version if parent else 0,
        sha=stored.sha,
        previous_sha=parent.sha if parent else b"",
        reason=stored.kind,
        day=stored.day,
        made_s=0 if stored.signature is None else stored.signature.made_s,
    )
    return _with_delta(update, stored, parent, read) if parent else update


def _with_delta(update: TileUpdate, stored: StoredTile, parent: StoredTile, read: Read) -> TileUpdate:
    """The notice with what has changed, coded for features and on a lattice, else in plain columns; of a large change
    only how much it is.
    """
    try:
        before, after = read(parent), read(stored)
        put, removed = changed_between(before, after)
        counted = replace(update, put_count=put, removed_count=removed)
        if put + removed > NOTICE_DELTA_VOXELS or put > NOTICE_DELTA_PUT:
            return counted
        if isinstance(before, Tile) and isinstance(after, Tile) and not has_deltas(stored.codec_id):
            return replace(update, delta=diff(before.gaussians, after.gaussians))
        coded = encode_content_delta(before, after)
        return replace(update, coded_delta=coded, put_voxels=put, removed_voxels=removed)
    except TooLarge:
        return update
    except (SchemaError, CodecError) as error:  # one damaged body must not keep the notices of all other tiles
        _LOG.error("%s version %d is announced without a delta: %s", stored.tile, stored.version, error)
        return update


def encoded(update: TileUpdate) -> bytes:
    """The notice's bytes; of a delta that is more than `NOTICE_DELTA_BYTES` only how much it changes."""
    put, removed = update.voxels or (0, 0)
    counted = replace(
        update, delta=None, coded_delta=b"", put_voxels=0, removed_voxels=0, put_count=put, removed_count=removed
    )
    bare = counted.encode()
    try:
        whole = update.encode()
    except TooLarge:
        return bare
    return whole if len(whole) <= len(bare) + NOTICE_DELTA_BYTES else bare
