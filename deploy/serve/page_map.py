"""What the page asks of a map: its extent, tiles of a box, versions of a tile, one voxel, features."""

import gzip
import hashlib
import re
import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import asdict
from functools import cached_property
from typing import Any, Final

import numpy as np

from gnd.deploy.errors import BadQuestion
from gnd.deploy.serve.heads import HeadColumns, HeadTable, turns_of
from gnd.deploy.serve.packed_tile import LEVELS, packed
from gnd.deploy.serve.tile_states import TileStates
from gnd.deploy.serve.voxel_story import voxel_story
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.errors import TileError
from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.errors import UnknownVersion
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.values import NS_PER_S, VersionInfo

MOST_TILES: Final = 512
"""So many tiles are listed in one answer."""
WIDEST_M: Final = 20_000_000.0
MOST_FEATURES: Final = 20_000
PACKED_BYTES: Final = 96 << 20
"""So many bytes of packed versions are kept."""
_NS_PER_MS: Final = 1_000_000
_NEAR_M: Final = 4.0
_TILES_ASKED: Final = 500
_NUMBER: Final = re.compile(r"-?[0-9]{1,9}")


class PageMap:
    """A layer of Gaussians and the layers of features of a store. May be asked from several threads.

    Args:
        store: to read.
        layer: of Gaussians.
        title: what the page calls it.
    """

    def __init__(self, store: SqlStore, layer: str, title: str) -> None:
        self.store, self.layer, self.title = store, layer, title
        self.heads = HeadTable(store, layer)
        self.states = TileStates(store, layer)
        self._features: dict[str, HeadTable] = {}
        self._packed: OrderedDict[tuple[TileId, int, int], bytes] = OrderedDict()
        self._packed_bytes = 0
        self._lock = threading.Lock()

    @property
    def frame(self) -> LocalFrame:
        """The map's: east, north and up at a tile in its middle, m."""
        return self.heads.frame

    @cached_property
    def key(self) -> str:
        """Names this map in addresses that browsers remember: another store has another one."""
        columns = self.heads.columns
        told = hashlib.sha256(f"{self.title}|{self.layer}|{self.store.location}".encode())
        told.update(columns.morton[:64].tobytes())
        for entry in self.store.heads(self.layer)[:4]:
            first = self.store.history(self.layer, entry.tile)[0]
            told.update(first.sha + str(first.created_ns).encode())
        return told.hexdigest()[:12]

    def feature_layers(self) -> list[str]:
        """Those that there are."""
        return [one for one in self.store.layers() if is_feature_layer(one)]

    def refresh(self) -> list[tuple[str, TileId, int, int]]:
        """Look at the store; layer, tile, version before and version now of what is new."""
        found = [(self.layer, *one) for one in self.heads.refresh()]
        for layer in self.feature_layers():
            found += [(layer, *one) for one in self._heads_of(layer).refresh()]
        return found

    def refresh_tile(self, layer: str, tile: TileId) -> list[tuple[str, TileId, int, int]]:
        """Look at one tile of the store; as `refresh`."""
        if layer != self.layer and layer not in self.feature_layers():
            return []
        heads = self.heads if layer == self.layer else self._heads_of(layer)
        return [(layer, *one) for one in heads.refresh_tile(tile)]

    def _heads_of(self, layer: str) -> HeadTable:
        with self._lock:
            if layer not in self._features:
                self._features[layer] = HeadTable(self.store, layer, self.frame)
            return self._features[layer]

    def about(self) -> dict[str, Any]:
        """Where the map is, how large, and of when."""
        columns = self.heads.columns
        x, y = columns.place_m[:, 0], columns.place_m[:, 1]
        some = len(columns) > 0
        box = [float(x.min()) - 20, float(y.min()) - 20, float(x.max()) + 20, float(y.max()) + 20] if some else [0] * 4
        first_ns, changed_ns = self._times_ns(columns)
        return {
            "title": self.title,
            "key": self.key if some else "",
            "layer": self.layer,
            "origin_deg": [float(np.degrees(self.frame.lat_rad)), float(np.degrees(self.frame.lon_rad))],
            "extent_m": [round(one, 1) for one in box],
            "ground_m": round(self.ground_m(0.0, 0.0), 2) if some else 0.0,
            "tiles": len(columns),
            "changed_tiles": int((columns.version > 1).sum()),
            "first_ms": first_ns // _NS_PER_MS,
            "changed_ms": changed_ns // _NS_PER_MS,
            "last_ms": int(columns.created_ns.max(initial=0)) // _NS_PER_MS,
            "feature_layers": self.feature_layers(),
        }

    def _times_ns(self, columns: HeadColumns) -> tuple[int, int]:
        """When the first version of all was published, and the first that replaced another (0: none has), UTC.

        Of a large map those tiles tell that were published first and last.
        """
        order = np.argsort(columns.created_ns)
        chosen = np.unique(np.concatenate([order[:_TILES_ASKED], order[columns.version[order] > 1][-_TILES_ASKED:]]))
        lines = [self.store.history(self.layer, TileId(int(one))) for one in columns.morton[chosen]]
        first_ns = min((line[0].created_ns for line in lines), default=0)
        return first_ns, min((line[1].created_ns for line in lines if len(line) > 1), default=0)

    def tiles(self, box_m: tuple[float, float, float, float]) -> dict[str, Any]:
        """The tiles of a box (west, south, east, north in the map's frame, m), the nearest to its middle first, each
        with its place and versions; `left_out` says how many there are beyond the first `MOST_TILES`.

        Raises:
            BadQuestion: no such box.
        """
        west, south, east, north = box_m
        if not (np.isfinite(box_m).all() and west < east and south < north) or max(map(abs, box_m)) > WIDEST_M:
            raise BadQuestion(f"box {box_m}: west < east, south < north, in m, none beyond {WIDEST_M:.0f}")
        columns, rows = self.heads.within(box_m)
        chosen = rows[:MOST_TILES]
        turns = turns_of(columns.morton[chosen], self.frame)
        listed = [self._tile(columns, row, turn) for row, turn in zip(chosen.tolist(), turns, strict=True)]
        return {"tiles": listed, "left_out": len(rows) - len(chosen)}

    def tile(self, tile: TileId) -> dict[str, Any]:
        """One tile as `tiles` lists it.

        Raises:
            BadQuestion: it is not on the map.
        """
        columns = self.heads.columns
        row = columns.row_of(tile)
        if row is None:
            raise BadQuestion(f"tile {tile} is not on the map")
        return self._tile(columns, row, turns_of(columns.morton[row : row + 1], self.frame)[0])

    def _tile(self, columns: HeadColumns, row: int, turn: F64) -> dict[str, Any]:
        tile, version = TileId(int(columns.morton[row])), int(columns.version[row])
        lines = self.store.history(self.layer, tile) if version > 1 else []
        told = [[line.version, line.created_ns // _NS_PER_MS] for line in lines if line.version <= version]
        return {
            "id": tile.morton,
            "path": tile.path,
            "version": version,
            "place": [round(float(one), 3) for one in columns.place_m[row]],
            "turn": [round(float(one), 9) for one in turn.ravel()],
            "versions": told or [[version, int(columns.created_ns[row]) // _NS_PER_MS]],
        }

    def overview(self) -> bytes:
        """Every tile in 16 bytes: its place east and north in the map's frame (f32, m), version (u32), POSIX seconds
        of its publication (u32), column by column.
        """
        columns = self.heads.columns
        return b"".join(
            (
                columns.place_m[:, 0].astype("<f4").tobytes(),
                columns.place_m[:, 1].astype("<f4").tobytes(),
                columns.version.astype("<u4").tobytes(),
                (columns.created_ns // NS_PER_S).astype("<u4").tobytes(),
            )
        )

    def packed(self, tile: TileId, version: int, level: int) -> bytes:
        """A version as the page draws it, in gzip; see `packed_tile`.

        Raises:
            BadQuestion: no such level.
            UnknownVersion: no such version.
        """
        if not 0 <= level < LEVELS:
            raise BadQuestion(f"level {level} is not in 0 … {LEVELS - 1}")
        wanted = tile, version, level
        with self._lock:
            if wanted in self._packed:
                self._packed.move_to_end(wanted)
                return self._packed[wanted]
        body = gzip.compress(packed(self.states.state(tile, version), level), compresslevel=4, mtime=0)
        with self._lock:
            if wanted not in self._packed:
                self._packed_bytes += len(body)
                self._packed[wanted] = body
            while self._packed_bytes > PACKED_BYTES:
                self._packed_bytes -= len(self._packed.popitem(last=False)[1])
        return body

    def history(self, tile: TileId) -> list[dict[str, Any]]:
        """The versions of a tile that retention has left, oldest first.

        Raises:
            UnknownVersion: the tile is not on the map.
        """
        lines = self.store.history(self.layer, tile)
        if not lines:
            raise UnknownVersion(f"tile {tile} is not in layer {self.layer!r}")
        return [_line(line) for line in lines]

    def voxel(self, tile: TileId, voxel: int, version: int | None) -> dict[str, Any]:
        """What a voxel is in a version (None: the newest), and how it came to be that; see `voxel_story`."""
        return voxel_story(self.store, self.layer, tile, voxel, version)

    def ground_m(self, east_m: float, north_m: float) -> float:
        """Height of the lowest Gaussians near a place in the map's frame, m; of the tile's others where none is near;
        0 where no tile is.
        """
        lat, lon, _ = self.frame.geodetic_from_enu([east_m, north_m, 0.0])
        tile = TileId.from_geodetic(float(lat), float(lon))
        columns = self.heads.columns
        row = columns.row_of(tile)
        if row is None:
            return 0.0
        gaussians = self.states.state(tile, int(columns.version[row])).gaussians
        if not len(gaussians):
            return 0.0
        T = self.frame.T_self_other(LocalFrame.of_tile(tile))
        mean_m = (VoxelGrid.of(tile).centre_m(gaussians.voxel_id) + gaussians.mean_m) @ T[:3, :3].T + T[:3, 3]
        near = mean_m[np.hypot(mean_m[:, 0] - east_m, mean_m[:, 1] - north_m) < _NEAR_M, 2]
        return float(np.percentile(near if len(near) else mean_m[:, 2], 10.0))

    def place(self, lat_rad: float, lon_rad: float) -> tuple[float, float]:
        """East and north of a place in the map's frame, m, on the ellipsoid."""
        at = self.frame.enu_from_geodetic(lat_rad, lon_rad, 0.0)
        return float(at[0]), float(at[1])

    def features(self, layer: str) -> dict[str, Any]:
        """A layer of features: kind, points in the map's frame, attributes, how surely each exists.

        Raises:
            BadQuestion: there is no such layer.
        """
        if layer not in self.feature_layers():
            raise BadQuestion(f"there is no layer of features {layer[:80]!r}")
        found: list[dict[str, Any]] = []
        entries = self.store.heads(layer)
        for stored in self.store.get_each(layer, [one.tile for one in entries]):
            if stored is None or len(found) >= MOST_FEATURES:
                continue
            T = self.frame.T_self_other(LocalFrame.of_tile(stored.tile))
            for one in stored.decode_features().features:
                points = one.points_m @ T[:3, :3].T + T[:3, 3]
                found.append(
                    {
                        "id": str(one.feature_id),
                        "kind": one.kind,
                        "points_m": np.round(points, 3).tolist(),
                        "attributes": dict(one.attributes),
                        "existence": asdict(one.existence),
                        "hits": one.hits,
                        "vehicles": one.vehicles,
                        "tile": stored.tile.morton,
                        "version": stored.version,
                    }
                )
        return {"layer": layer, "features": found[:MOST_FEATURES], "left_out": max(len(found) - MOST_FEATURES, 0)}


def _line(line: VersionInfo) -> dict[str, Any]:
    return {
        "version": line.version,
        "parent": line.parent,
        "kind": line.kind,
        "created_ms": line.created_ns // _NS_PER_MS,
        "merger": line.merger,
        "reports": line.n_reports,
        "size_bytes": line.size_bytes,
    }


def tile_of(text: str) -> TileId:
    """A tile by its number.

    Raises:
        BadQuestion: it is none.
    """
    try:
        return TileId(int(text))
    except (ValueError, TileError):
        raise BadQuestion(f"{text[:80]!r} is no tile") from None


def number_of(told: Mapping[str, str], name: str, default: int) -> int:
    """A whole number that a question may hold.

    Raises:
        BadQuestion: it is none.
    """
    text = told.get(name, str(default))
    if not _NUMBER.fullmatch(text):
        raise BadQuestion(f"{name}={text[:40]!r} is no whole number of at most nine digits")
    return int(text)
