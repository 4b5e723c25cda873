"""Whether a version that came is one to use: a publisher of the pinned authority answers for it, and it is no older one
than was seen before. Neither tile server, cache nor router need be believed for that.
"""

import logging
import threading
from collections import Counter, OrderedDict
from dataclasses import dataclass
from typing import Final, Protocol, Self

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.errors import SealError
from gnd.fleet_bus.publishers import Publishers
from gnd.fleet_bus.seldom import Seldom
from gnd.gnd_map.content import AnyTile, day_of_tile
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.region import Region
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import NotSigned
from gnd.schemas.version_signature import VersionSignature
from gnd.tile_client.unsigned import UnsignedTold

MOST_SEEN: Final = 100_000
_SELDOM: Final = Seldom(logging.getLogger(__name__))


@dataclass(frozen=True, slots=True)
class SeenVersion:
    """The newest version of a tile that was seen: when it was made (POSIX seconds, 0 = not known), and its number."""

    made_s: int = 0
    version: int = 0

    def is_newer_than(self, made_s: int, version: int) -> bool:
        """Whether a version is older than this one. Times decide: a store that was built anew counts from 1 again."""
        if self.made_s and made_s != self.made_s:
            return made_s < self.made_s
        return version < self.version


class SeenVersions(Protocol):
    """Remembers the newest version that was seen of each tile of a layer; safe in several threads."""

    def seen(self, tile: TileId) -> SeenVersion:
        """The newest one; `SeenVersion()` where none was."""

    def note(self, tile: TileId, seen: SeenVersion) -> None:
        """This one was seen; nothing where a newer one was."""


class SeenInMemory:
    """The newest `MOST_SEEN` tiles, as long as the process lives."""

    def __init__(self) -> None:
        self._lock, self._seen = threading.Lock(), OrderedDict[TileId, SeenVersion]()

    def seen(self, tile: TileId) -> SeenVersion:
        """See `SeenVersions.seen`."""
        with self._lock:
            return self._seen.get(tile, SeenVersion())

    def note(self, tile: TileId, seen: SeenVersion) -> None:
        """See `SeenVersions.note`."""
        with self._lock:
            before = self._seen.pop(tile, SeenVersion())
            self._seen[tile] = before if before.is_newer_than(seen.made_s, seen.version) else seen
            if len(self._seen) > MOST_SEEN:
                self._seen.popitem(last=False)

    def versions(self, region: Region) -> dict[TileId, int]:
        """The newest version of each tile of a region that was seen."""
        with self._lock:
            return {tile: seen.version for tile, seen in self._seen.items() if tile in region}


class VersionCheck:
    """Checks the versions of one layer. Safe in several threads.

    Args:
        publishers: whose signature counts.
        layer: name of the layer.
        seen: what was seen before.

    Attributes:
        counts: versions by what came of the check: good, unsigned, wrong, older.
        publishers: whose signature counts.
        unsigned: tells of a map that nobody has signed.
    """

    def __init__(self, publishers: Publishers, layer: str, seen: SeenVersions) -> None:
        self.counts = Counter[str]()
        self.unsigned = UnsignedTold(layer)
        self.publishers, self._layer, self._seen = publishers, layer, seen

    @classmethod
    def on_the_bus(cls, bus: Bus, layer: str, seen: SeenVersions | None = None) -> Self | None:
        """For a session with an identity; None for one without, which takes what it hears.

        Raises:
            IdentityError: the identity has no authority.
        """
        publishers = Publishers.on_the_bus(bus)
        return None if publishers is None else cls(publishers, layer, SeenInMemory() if seen is None else seen)

    def check(self, tile: AnyTile, signature: VersionSignature | None) -> None:
        """Take note of a version that came.

        Args:
            tile: its content; its hash is that of the content, not one that somebody has claimed.
            signature: what came with it.

        Raises:
            NotSigned: it is not to be used; why.
        """
        name = f"tile {tile.tile_id} of layer {self._layer} version {tile.version}"
        if signature is None:
            self.counts["unsigned"] += 1
            self.unsigned.refused(name)
            raise NotSigned(f"{name}: nobody has signed it")
        statement = signature.statement(self._layer, tile.tile_id, tile.version, tile.sha, day_of_tile(tile))
        text = statement.text(signature.signer, signature.signed_s)
        try:
            self.publishers.check(signature.signer, signature.signed_s, text, signature.signature)
        except SealError as error:
            self.counts["wrong"] += 1
            raise NotSigned(f"{name}: {error}") from error
        self._check_order(name, tile.tile_id, SeenVersion(signature.made_s, tile.version))
        self.counts["good"] += 1
        self.unsigned.signed()

    def _check_order(self, name: str, tile: TileId, came: SeenVersion) -> None:
        """Raises NotSigned where a newer one was seen. A full disk stops no drive: then nothing was."""
        try:
            seen = self._seen.seen(tile)
            self._seen.note(tile, came)
        except GndError as error:
            _SELDOM.warning("which version of tile %s is the newest is not remembered: %s", tile, error)
            return
        if seen.is_newer_than(came.made_s, came.version):
            self.counts["older"] += 1
            raise NotSigned(f"{name}: older than version {seen.version}, which was seen before")

    def note_announced(self, tile: TileId, made_s: int, version: int) -> None:
        """A notice that a shard has sealed names this version: an older one will not do any more."""
        if made_s:
            self._seen.note(tile, SeenVersion(made_s, version))
