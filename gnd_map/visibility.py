"""Which voxels a drive has observed, predicted from its track: lines of sight through the map that it compared with.

A report names every voxel that its drive has observed, changed or not, because votes need those who saw no change, too.
Written out that is some 50 kB/km, nearly all of an upload. The cloud holds the same map as the vehicle, so it looks
for itself: from points along the track it sends rays the way the sensor does, lets the map's Gaussians stop them (and
what the drive flags as new, but not what it flags as gone), and counts.

The same track, flags and map give the same prediction.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from gnd.gnd_map import sight
from gnd.gnd_map.arrays import F64, I32, I64, unique
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.codec import Flags
from gnd.gnd_map.errors import TrackError
from gnd.gnd_map.grid import VoxelGrid, zones
from gnd.gnd_map.sight import FACES, MOST_RAYS, NO_SLOT, NOTHING, STOP, SightColumns, SightWindow
from gnd.gnd_map.tile_id import LON_TILES, TileId, deinterleave
from gnd.gnd_map.track import SECTORS, Track, TrackView

U64 = npt.NDArray[np.uint64]

_GOLDEN: Final = 0.6180339887498949
_NEW: Final = int(ChangeClass.NEW)
_LEAST_PLACES, _MOST_PLACES = 4, 4_000
_FLOORS_BELOW, _FLOORS_ABOVE = 3, 8
_MOST_CELLS: Final = 1 << 24
_MOST_WORDS: Final = 1 << 23  # of 64 floors of a column, from the lowest floor of all on
_PARTS: Final = 16  # of a ray: lines stand for so many of them
_SLOPES: Final = 512
_ROUND: Final = 2.0**24  # what trigonometry gives is rounded, so that no machine's last bit decides


# How lines of sight become observed voxels: vehicle and cloud have to agree, so nobody can set them.
_STEP_M: Final = 8.0
"""Places along the track are this far apart."""
_AZIMUTHS: Final = 64
"""Fans of lines of sight a whole turn at each place."""
_LINES: Final = 8
"""Of a fan, their elevations shared out as the sensor's rays are; a power of two."""
_RANGE_M: Final = 50.0
"""What lies farther is not observed; lines still end there."""
_REACH_M: Final = 70.0
"""How far lines are followed."""
_NOISE_M: Final = 0.05
"""Thickens the Gaussians that stop lines: of ranges and poses."""
_R2: Final = 3.0
"""Squared Mahalanobis distance up to which a Gaussian stops a line."""
_NEW_RADIUS_M: Final = 0.5
"""Of the ball that stands for a new voxel, whose Gaussian is not at hand."""
_MIN_HITS: Final = 48.0
"""Rays that must end in a voxel in which the map has a Gaussian."""
_MIN_PASSES: Final = 256.0
"""Rays that must cross a voxel in which it has none."""
_HITS_NEAR: Final = 6.0
"""So many times more for each face behind which the drive flags a Gaussian as gone or modified: where something goes
on to change, drives often cannot tell, and abstain."""
_PASSES_NEAR: Final = 8.0
"""So many times more for each face behind which it flags something new, for the same reason."""
_OPEN_RAD: Final = 0.04
"""A line that leaves the known map met something there if its elevation is at most this, up or down: far down a
street. A higher one went into the sky, and nothing came back; a steeper one slipped through a gap between Gaussians
of the ground."""


def observed_along(track: Track, told: Sequence[Flags]) -> dict[TileId, I32]:
    """Predict what a drive has observed.

    Args:
        track: of the drive.
        told: of each tile of the report what the vehicle compared with (no Gaussians where it had no map), and the
            voxels that it flags.

    Returns:
        Sorted voxel ids (K,) of each tile; those flagged are always among them.

    Raises:
        TrackError: the way climbs so far that looking along it would take too much memory.
    """
    by_tile = {flags.tile_id: flags for flags in told}
    found = {tile_id: flags.voxel_id for tile_id, flags in by_tile.items()}
    for group in zones(by_tile).values():
        found |= _Zone([by_tile[tile_id] for tile_id in group], track).observed()
    return found


@dataclass(frozen=True, slots=True)
class _Places:
    """Where fans start.

    Attributes:
        uv: (P, 2) tiles east and north of the zone's first tile's corner.
        height_m: (P,).
        turn: (P, 2) cosine and sine of the heading, a little more from place to place.
        rays: (P,) that each line stands for, in 1 / _PARTS.
    """

    uv: F64
    height_m: F64
    turn: F64
    rays: I64

    def take(self, rows: I64) -> "_Places":
        return _Places(self.uv[rows], self.height_m[rows], self.turn[rows], self.rays[rows])


class _Zone:
    """The tiles of one report that share their (nx, ny); tiles are counted from the first one on."""

    def __init__(self, told: Sequence[Flags], track: Track) -> None:
        self._track, self._told = track, told
        self._first, self._grid = told[0].tile_id, VoxelGrid.of(told[0].tile_id)
        self._metres = np.array([self._grid.dx_m, self._grid.dy_m, self._grid.dz_m])
        self._tile_m = self._metres[:2] * (self._grid.nx, self._grid.ny)
        self._azimuth, self._slope = _azimuths(track.view), _slopes(track.view)

    def observed(self) -> dict[TileId, I32]:
        """Of each tile that a line can reach the voxels seen and those flagged, sorted."""
        corner = self._tiles()
        places = self._make_places()
        apart_m = _apart_m(places.uv * self._tile_m, corner * self._tile_m, self._tile_m)
        within = apart_m <= _REACH_M
        reached = np.flatnonzero(within.any(axis=1))
        if len(reached) == 0:
            return {}
        of_use = np.flatnonzero(within.any(axis=0))
        shown = within[reached][:, of_use]
        places, told = places.take(of_use), [self._told[k] for k in reached.tolist()]
        w, origin = self._window(told, corner[reached], places, shown)
        return _read(w, told, self._look(w, told, places, (places.uv - origin) * w.columns))

    def _tiles(self) -> I64:
        """(T, 2) tiles east and north of the first one, along longitude the short way round."""
        lon, lat = deinterleave(np.array([flags.tile_id.morton for flags in self._told], np.int64))
        half = LON_TILES // 2
        return np.stack([(lon - lon[0] + half) % LON_TILES - half, lat - lat[0]], axis=1)

    def _make_places(self) -> _Places:
        lines = [self._line(number) for number in range(len(self._track.pieces))]
        total_m = sum(float(_legs_m(line, self._tile_m)[1].sum()) for line in lines)
        step_m = max(_STEP_M, total_m / _MOST_PLACES)
        parts = [_along(line, self._tile_m, step_m) for line in lines]
        uvh = np.concatenate([np.zeros((0, 3)), *(at for at, _ in parts)])
        ahead = np.concatenate([np.zeros((0, 2)), *(way for _, way in parts)])
        scans = [piece.scans / len(at) for piece, (at, _) in zip(self._track.pieces, parts, strict=True)]
        rays = np.array(scans) * self._track.view.rays * _PARTS / (len(self._azimuth) * _LINES)
        each = np.clip(np.round(rays), 1, MOST_RAYS).astype(np.int64)
        angle = np.arange(len(uvh)) * _GOLDEN % 1.0 * (2.0 * np.pi / _AZIMUTHS)
        cos, sin = np.cos(angle), np.sin(angle)
        turn = np.stack([ahead[:, 0] * cos - ahead[:, 1] * sin, ahead[:, 1] * cos + ahead[:, 0] * sin], axis=1)
        return _Places(uvh[:, :2], uvh[:, 2], _rounded(turn), np.repeat(each, [len(at) for at, _ in parts]))

    def _line(self, number: int) -> F64:
        """(N, 3) vertices of a piece: tiles east and north of the first tile's corner, metres up."""
        uvh = self._track.tile_coordinates(self._track.pieces[number])
        half = LON_TILES // 2
        uvh[:, 0] = (uvh[:, 0] - self._first.lon_index + half) % LON_TILES - half
        uvh[:, 1] -= self._first.lat_index
        return uvh

    def _window(
        self, told: Sequence[Flags], corner: I64, places: _Places, shown: npt.NDArray[np.bool_]
    ) -> tuple[SightWindow, I64]:
        """Room for the voxels of the tiles that lines can reach, and the tile in the window's corner.

        Args:
            told: those tiles.
            corner: (T, 2) where they lie.
            places: that reach any.
            shown: (T, P) which reaches which.
        """
        at = np.floor(places.uv).astype(np.int64)
        origin = np.minimum(corner.min(axis=0), at.min(axis=0))
        slot_of = np.full(np.maximum(corner.max(axis=0), at.max(axis=0)) - origin + 1, NO_SLOT, np.int32)
        slot_of[tuple((corner - origin).T)] = np.arange(len(told))
        steep = float(np.abs(self._slope).max())
        rise_m = _REACH_M * steep / np.sqrt(1.0 + steep**2)
        lowest, highest = self._known_floors(told, places.height_m)
        bottom = np.where(shown, places.height_m, np.inf).min(axis=1) - rise_m
        top = np.where(shown, places.height_m, -np.inf).max(axis=1) + rise_m
        low = np.maximum(np.floor(bottom).astype(np.int64), lowest - _FLOORS_BELOW)
        floors = np.maximum(np.minimum(np.floor(top).astype(np.int64), highest + _FLOORS_ABOVE) - low + 1, 0)
        columns = self._grid.nx, self._grid.ny
        offset = np.concatenate([[0], np.cumsum(floors * columns[0] * columns[1])])
        words = len(told) * columns[0] * columns[1] * (int((low + floors).max() - low.min()) // 64 + 1)
        if offset[-1] > _MOST_CELLS or words > _MOST_WORDS:
            raise TrackError(
                f"lines of sight over {len(told)} tiles between floors {low.min()} and {(low + floors).max()} cross "
                f"{offset[-1]} voxels, {words} words of floors: at most {_MOST_CELLS}, {_MOST_WORDS}"
            )
        first = ((corner - origin) * columns).astype(np.int32)
        return SightWindow(
            columns, self._metres, slot_of, first, offset, low.astype(np.int32), floors.astype(np.int32), int(low.min())
        ), origin

    def _known_floors(self, told: Sequence[Flags], height_m: F64) -> tuple[int, int]:
        """Lowest and highest floor of the map, the flags and the places."""
        ends = [ids[[0, -1]] for flags in told for ids in (flags.base.voxel_id, flags.voxel_id) if len(ids)]
        _, _, floor = self._grid.unravel(np.concatenate([np.zeros(0, np.int32), *ends]))
        every = np.concatenate([floor, np.floor(height_m).astype(np.int64)])
        return int(every.min()), int(every.max())

    def _look(self, w: SightWindow, told: Sequence[Flags], places: _Places, g: F64) -> U64:
        """(T * nx * ny, words) a bit for each voxel seen or flagged."""
        state, near = np.full(w.offset[-1], NOTHING, np.int32), np.zeros(w.offset[-1], np.uint8)
        words = (int((w.low + w.floors).max()) - w.lowest) // 64 + 1
        filled, seen, more = (np.zeros((len(told) * w.columns[0] * w.columns[1], words), np.uint64) for _ in range(3))
        new = [flags.voxel_id[flags.change_class == _NEW] for flags in told]
        known = [flags.base.voxel_id for flags in told]
        slot, voxel_id = _slots([*known, *new], len(told)), np.concatenate([*known, *new])
        stop = np.zeros((len(slot), STOP), np.float32)
        hits, pooled = np.zeros(len(slot), np.int64), np.zeros(len(slot), np.int64)
        mean_m = np.concatenate([flags.base.mean_m for flags in told])
        cov_m2 = np.concatenate([flags.base.cov_m2 for flags in told])
        ball_m2 = max(_NEW_RADIUS_M, 0.01) ** 2 / _R2
        sight.lay_out(w, slot, voxel_id, mean_m, cov_m2, ball_m2, _NOISE_M**2, state, filled, stop)
        flagged, classes = [flags.voxel_id for flags in told], [flags.change_class for flags in told]
        where = _slots(flagged, len(told)), np.concatenate(flagged), np.concatenate(classes)
        sight.mark(w, *where, state, filled, near, seen)
        sight.cast_fans(
            w, np.column_stack([g, places.height_m]), places.turn, places.rays, self._azimuth, self._slope, _LINES,
            stop, filled, _R2, _RANGE_M, _REACH_M, float(_rounded(np.tan(_OPEN_RAD))), state, hits,
            SightColumns.room(), np.empty(2),
        )  # fmt: skip
        sight.pool(w, filled, state, hits, pooled)
        least_hits, least_passes = _least(_MIN_HITS, _HITS_NEAR), _least(_MIN_PASSES, _PASSES_NEAR)
        sight.read_out(w, state, pooled, near, least_hits, least_passes, seen)
        sight.fill(w, filled, near, seen, more)
        return np.asarray(seen | more)


def _apart_m(position_m: F64, corner_m: F64, size_m: F64) -> F64:
    """(T, P) distance of places (P, 2) from tiles of one size, given by their corners (T, 2)."""
    ahead = corner_m[:, None, :] - position_m[None, :, :]
    outside = np.maximum(0.0, np.maximum(ahead, -ahead - size_m))
    return np.asarray(np.sqrt((outside**2).sum(axis=2)))


def _legs_m(line: F64, tile_m: F64) -> tuple[F64, F64]:
    """Legs (N - 1, 3) of a polyline in metres, and their lengths."""
    leg = np.diff(line, axis=0) * [*tile_m, 1.0]
    return leg, np.sqrt((leg**2).sum(axis=1))


def _along(line: F64, tile_m: F64, step_m: float) -> tuple[F64, F64]:
    """Places (P, 3) along a polyline, and the way ahead (P, 2), a unit vector. Where the vehicle stands still it looks
    several times: each time along other lines.
    """
    leg, length_m = _legs_m(line, tile_m)
    way_m = np.concatenate([[0.0], np.cumsum(length_m)])
    n = max(_LEAST_PLACES, round(float(way_m[-1]) / step_m))
    if way_m[-1] == 0.0:
        return np.repeat(line[:1], n, axis=0), np.tile([1.0, 0.0], (n, 1))
    at_m = (np.arange(n) + 0.5) * way_m[-1] / n
    places = np.column_stack([np.interp(at_m, way_m, line[:, axis]) for axis in range(3)])
    of_leg = np.clip(np.searchsorted(way_m, at_m, side="right") - 1, 0, len(leg) - 1)
    flat = leg[of_leg, :2]
    size = np.sqrt((flat**2).sum(axis=1))
    return places, np.where(size[:, None] > 0.0, flat / np.maximum(size, 1e-9)[:, None], [1.0, 0.0])


def _azimuths(view: TrackView) -> F64:
    """(A, 2) unit vectors, x ahead: those that the sensor looks along."""
    azimuth = (np.arange(_AZIMUTHS) + 0.5) * (2.0 * np.pi / _AZIMUTHS)
    sector = (azimuth * (SECTORS / (2.0 * np.pi))).astype(np.int64)
    azimuth = azimuth[(view.sectors >> sector) & 1 == 1]
    return _rounded(np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1))


def _slopes(view: TrackView) -> F64:
    """(_SLOPES,) tangents of the elevations, shared out as the sensor's rays are."""
    share = (np.arange(_SLOPES) + 0.5) / _SLOPES
    return _rounded(np.tan(np.interp(share, np.linspace(0.0, 1.0, len(view.levels)), view.elevations_rad)))


def _rounded(values: npt.ArrayLike) -> F64:
    return np.asarray(np.round(np.asarray(values) * _ROUND) / _ROUND)


def _least(rays: float, near: float) -> I64:
    """(FACES + 1,) how many rays are enough by the number of faces, in 1 / _PARTS; at least some."""
    parts = np.ceil(rays * near ** np.arange(FACES + 1) * _PARTS)
    return np.asarray(np.clip(parts, 1, MOST_RAYS), np.int64)


def _slots(parts: Sequence[I32], tiles: int) -> I32:
    """Slot of each voxel of parts that go round the tiles in order."""
    return np.repeat(np.arange(len(parts), dtype=np.int32) % tiles, [len(part) for part in parts])


def _read(w: SightWindow, told: Sequence[Flags], seen: U64) -> dict[TileId, I32]:
    """Sorted voxel ids of each tile, seen or flagged."""
    ids, ends = sight.voxel_ids(w, seen)
    columns, found = w.columns[0] * w.columns[1], {}
    for slot, (flags, mine) in enumerate(zip(told, np.split(ids, ends[:-1]), strict=True)):
        lowest = int(w.low[slot]) * columns - columns // 2
        whole = _is_within(flags.voxel_id, lowest, lowest + int(w.floors[slot]) * columns)
        found[flags.tile_id] = mine if whole else unique(np.concatenate([mine, flags.voxel_id])).astype(np.int32)
    return found


def _is_within(voxel_id: I32, lowest: int, beyond: int) -> bool:
    """Whether sorted voxel ids lie in lowest .. beyond - 1."""
    return len(voxel_id) == 0 or (int(voxel_id[0]) >= lowest and int(voxel_id[-1]) < beyond)
