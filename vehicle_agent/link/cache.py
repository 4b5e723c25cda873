"""Tiles on disk: what was downloaded once is asked for only by its version and hash.

Bodies are kept as they arrived, in whatever codec. Every read is verified against the hash that was published; a tile
that fails is dropped, and the caller downloads it again. The cache is all that a download needs to go on after a lost
link or a kill; it may be deleted at any time.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Generic, cast

from gnd.gnd_map.content import TileT, day_of_tile, encode_content, kind_of_layer
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas import limits
from gnd.schemas.tiles import TileBlob, as_kind, content_of
from gnd.tile_client.checking import SeenVersion
from gnd.vehicle_agent.errors import CacheError
from gnd.vehicle_agent.link.sqlite import Database

SCHEMA = """
CREATE TABLE IF NOT EXISTS tile (
    layer    TEXT NOT NULL,
    morton   INTEGER NOT NULL,
    version  INTEGER NOT NULL,
    sha      BLOB NOT NULL,
    codec_id INTEGER NOT NULL,
    body     BLOB NOT NULL,
    day      INTEGER NOT NULL DEFAULT 0,
    PRIMARY KEY (layer, morton)
) STRICT, WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS seen (
    layer   TEXT NOT NULL,
    morton  INTEGER NOT NULL,
    made_s  INTEGER NOT NULL,
    version INTEGER NOT NULL,
    PRIMARY KEY (layer, morton)
) STRICT, WITHOUT ROWID;
"""
KEEP = """
INSERT INTO tile (layer, morton, version, sha, codec_id, body, day) VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)
ON CONFLICT (layer, morton) DO UPDATE
SET version = excluded.version, sha = excluded.sha, codec_id = excluded.codec_id, body = excluded.body,
    day = excluded.day
WHERE tile.sha = ?8 OR tile.version < excluded.version
"""


NOTE = """
INSERT INTO seen (layer, morton, made_s, version) VALUES (?1, ?2, ?3, ?4)
ON CONFLICT (layer, morton) DO UPDATE SET made_s = excluded.made_s, version = excluded.version
WHERE excluded.made_s > seen.made_s OR (excluded.made_s = seen.made_s AND excluded.version > seen.version)
"""
HAS_DAYS = "SELECT 1 FROM pragma_table_info('tile') WHERE name = 'day'"
ADD_DAYS = "ALTER TABLE tile ADD COLUMN day INTEGER NOT NULL DEFAULT 0"
"""Caches of older releases have none; of what they hold the day stays unknown until it changes."""


class TileCache(Generic[TileT]):
    """The newest version of each tile of one layer that this vehicle has seen, in an SQLite file; safe for several
    threads. Caches of several layers may share a file.

    Holds tiles of Gaussians (`TileCache[Tile]`) where the layer's name begins with ndt, else of features.
    """

    def __init__(self, path: Path, layer: str = "ndt") -> None:
        self.layer = layer
        self.kind = cast("type[TileT]", kind_of_layer(layer))
        self.refused = 0
        self._db = Database(path, SCHEMA, synchronous="normal", error=CacheError)
        if not self._db.run(HAS_DAYS):
            self._db.run(ADD_DAYS)

    def get(self, tile_id: TileId) -> TileT | None:
        """The tile, or None when it is not here or no longer what its hash says (then it is dropped and counted)."""
        sql = "SELECT version, sha, codec_id, body, day FROM tile WHERE layer = ? AND morton = ?"
        rows = self._db.run(sql, self._of(tile_id))
        if not rows:
            return None
        version, sha, codec_id, body, day = rows[0]
        try:
            return as_kind(content_of(TileBlob(tile_id, version, sha, codec_id, body, day)), self.kind)
        except GndError:
            self.drop(tile_id)
            self.refused += 1
            return None

    def head(self, tile_id: TileId) -> tuple[int, bytes]:
        """(version, sha) of the cached tile; (0, b"") where there is none."""
        rows = self._db.run("SELECT version, sha FROM tile WHERE layer = ? AND morton = ?", self._of(tile_id))
        return (int(rows[0][0]), bytes(rows[0][1])) if rows else (0, b"")

    def heads(self, tiles: Iterable[TileId]) -> dict[TileId, tuple[int, bytes]]:
        """(version, sha) of those tiles that are here."""
        found = ((tile_id, self.head(tile_id)) for tile_id in tiles)
        return {tile_id: head for tile_id, head in found if head[0]}

    def held_of(self, district: District) -> list[TileId]:
        """The tiles of a district that are here, in order."""
        first = district.first_morton
        sql = "SELECT morton FROM tile WHERE layer = ? AND morton BETWEEN ? AND ? ORDER BY morton"
        rows = self._db.run(sql, (self.layer, first, first + limits.MAX_TILES_OF_DISTRICT - 1))
        return [TileId(int(morton)) for (morton,) in rows]

    def keep(self, blob: TileBlob, over: bytes = b"") -> bool:
        """Keep a tile as it arrived, unless something newer came meanwhile; False then, and nothing is changed.

        Args:
            blob: what arrived; its content has been verified.
            over: sha of the version that was here when it was asked for: that one is replaced whatever its number
                (a store that was built anew counts from 1).
        """
        row = (*self._of(blob.tile), blob.version, blob.sha, blob.codec_id, blob.body, blob.day, over)
        return self._db.changes(KEEP, row) > 0

    def put(self, tile: TileT, over: bytes = b"", blob: TileBlob | None = None) -> bool:
        """As `keep`, for a tile that is at hand; without `blob` its body is made as small as the tile allows."""
        made = blob or TileBlob(tile.tile_id, tile.version, tile.sha, *encode_content(tile), day_of_tile(tile))
        return self.keep(made, over)

    def seen(self, tile: TileId) -> SeenVersion:
        """The newest version of a tile that one of the publishers answered for, here or not; of a cache of an older
        release the one that is here.
        """
        rows = self._db.run("SELECT made_s, version FROM seen WHERE layer = ? AND morton = ?", self._of(tile))
        return SeenVersion(*rows[0]) if rows else SeenVersion(0, self.head(tile)[0])

    def note(self, tile: TileId, seen: SeenVersion) -> None:
        """This version was seen; nothing where a newer one was. It outlives the tile itself."""
        self._db.run(NOTE, (*self._of(tile), seen.made_s, seen.version))

    def drop(self, tile_id: TileId) -> None:
        """Forget a tile; not here: nothing happens."""
        self._db.run("DELETE FROM tile WHERE layer = ? AND morton = ?", self._of(tile_id))

    def __len__(self) -> int:
        return int(self._db.run("SELECT count(*) FROM tile WHERE layer = ?", (self.layer,))[0][0])

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    def _of(self, tile_id: TileId) -> tuple[str, int]:
        return self.layer, tile_id.morton
