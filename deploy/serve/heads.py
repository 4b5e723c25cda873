"""The newest versions of a map's tiles as columns, placed in one frame: a question about a box is one of numbers."""

import threading
from dataclasses import dataclass

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.geodesy import LocalFrame, ecef_from_geodetic
from gnd.gnd_map.grid import tile_axes
from gnd.gnd_map.tile_id import TileId, deinterleave, geodetic_of_tile_coordinates
from gnd.tile_store.store import Store

REACH_M = 30.0
"""No point of a tile at the ellipsoid is farther from its centre."""


@dataclass(frozen=True, slots=True, eq=False)
class HeadColumns:
    """N tiles, by number.

    Attributes:
        morton: (N,) their numbers.
        version: (N,) their newest versions.
        created_ns: (N,) when these were published, UTC.
        place_m: (N, 3) their centres on the ellipsoid, in the map's frame, m.
    """

    morton: I64
    version: I64
    created_ns: I64
    place_m: F64

    def __len__(self) -> int:
        return len(self.morton)

    def row_of(self, tile: TileId) -> int | None:
        """Where a tile stands; None: it is not there."""
        row = int(np.searchsorted(self.morton, tile.morton))
        return row if row < len(self) and self.morton[row] == tile.morton else None


class HeadTable:
    """The newest versions of a layer. May be asked from several threads.

    Args:
        store: to read.
        layer: name of the layer.
        frame: the map's frame; None: ENU on the ellipsoid at the tile in the middle of this layer.
    """

    def __init__(self, store: Store, layer: str, frame: LocalFrame | None = None) -> None:
        self._store, self._layer = store, layer
        self._lock, self._reading = threading.Lock(), threading.Lock()
        self.frame = frame or _frame_of(np.array([one.tile.morton for one in store.heads(layer)], np.int64))
        self._begins_empty = frame is None and not store.heads(layer)
        self._columns = self._read()[0]

    @property
    def columns(self) -> HeadColumns:
        """All tiles as they were read last."""
        with self._lock:
            return self._columns

    def refresh(self) -> list[tuple[TileId, int, int]]:
        """Read them anew; tile, version before (0: it is new) and version now of those that have changed."""
        with self._reading:
            columns, changed = self._read(self.columns)
            self._put(columns)
        return changed

    def refresh_tile(self, tile: TileId) -> list[tuple[TileId, int, int]]:
        """The same of one tile; of one that is new all are read."""
        with self._reading:
            known = self.columns
            row = known.row_of(tile)
            lines = self._store.history(self._layer, tile) if row is not None else []
            if row is not None and lines:
                before, newest = int(known.version[row]), lines[-1]
                version, created_ns = known.version.copy(), known.created_ns.copy()
                version[row], created_ns[row] = newest.version, newest.created_ns
                self._put(HeadColumns(known.morton, version, created_ns, known.place_m))
                return [(tile, before, newest.version)] if before != newest.version else []
        return self.refresh()

    def _put(self, columns: HeadColumns) -> None:
        with self._lock:
            self._columns = columns

    def within(self, box_m: tuple[float, float, float, float]) -> tuple[HeadColumns, I64]:
        """All tiles, and which rows touch a box (west, south, east, north in m), the nearest to its middle first."""
        columns = self.columns
        west, south, east, north = box_m
        x, y = columns.place_m[:, 0], columns.place_m[:, 1]
        inside = (x > west - REACH_M) & (x < east + REACH_M) & (y > south - REACH_M) & (y < north + REACH_M)
        rows = np.flatnonzero(inside)
        far = np.hypot(x[rows] - (west + east) / 2, y[rows] - (south + north) / 2)
        return columns, rows[np.argsort(far, kind="stable")]

    def _read(self, known: HeadColumns | None = None) -> tuple[HeadColumns, list[tuple[TileId, int, int]]]:
        lines = self._store.head_lines(self._layer)
        morton, version, created = (
            np.array(column, np.int64)
            for column in (
                [one.tile.morton for one in lines],
                [one.version for one in lines],
                [one.created_ns for one in lines],
            )
        )
        if self._begins_empty and len(morton):  # the first tiles of all: the map begins here
            self.frame, self._begins_empty = _frame_of(morton), False
        if known is not None and np.array_equal(morton, known.morton):
            place_m = known.place_m
            before = known.version
        else:
            place_m = _places_m(morton, self.frame)
            before = np.zeros(len(morton), np.int64)
            if known is not None and len(known):
                at = np.minimum(np.searchsorted(known.morton, morton), len(known) - 1)
                before = np.where(known.morton[at] == morton, known.version[at], 0)
        rows = np.flatnonzero(version != before)
        changed = [(lines[i].tile, int(before[i]), int(version[i])) for i in rows]
        return HeadColumns(morton, version, created, place_m), changed


def _frame_of(morton: I64) -> LocalFrame:
    """ENU on the ellipsoid at the tile nearest to the middle of the tiles."""
    if not len(morton):
        return LocalFrame(0.0, 0.0)
    east, north = deinterleave(morton)
    far = np.hypot(east - np.median(east), north - np.median(north))
    return LocalFrame.of_tile(TileId(int(morton[int(np.argmin(far))])))


def _places_m(morton: I64, frame: LocalFrame) -> F64:
    east, north = deinterleave(morton)
    lat, lon = geodetic_of_tile_coordinates(east + 0.5, north + 0.5)
    return frame.enu_from_ecef(ecef_from_geodetic(lat, lon, np.zeros(len(morton)))).reshape(-1, 3)


def turns_of(morton: I64, frame: LocalFrame) -> F64:
    """(N, 3, 3) rotations from the frames of tiles to the map's frame."""
    return np.asarray(np.einsum("ji,njk->nik", frame.R_ecef_enu, tile_axes(morton)))
