"""Which voxels a drive has observed, predicted from its track: lines of sight through the map that it compared with.

A report names every voxel that its drive has observed, changed or not, because votes need those who saw no change, too.
Written out that is some 50 kB/km, nearly all of an upload. The cloud holds the same map as the vehicle, so it looks
for itself: from points along the track it sends rays the way the sensor does, lets the map's Gaussians stop them (and
what the drive flags as new, but not what it flags as gone), and counts.

The same track, flags and map give the same prediction.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd_map.arrays import F64, I32, I64
from gnd_map.classes import ChangeClass
from gnd_map.codec import Flags
from gnd_map.errors import ConfigError
from gnd_map.gaussian import Gaussians, full_matrices
from gnd_map.grid import VoxelGrid, join_voxel_id, zones
from gnd_map.sight import NOTHING, OUTSIDE, cast_lines
from gnd_map.tile_id import LON_TILES, TileId, interleave
from gnd_map.track import SECTORS, Track

_CHUNK_M: Final = 100.0
_GOLDEN: Final = 0.6180339887498949
_MOST_PLACES: Final = 4_000
_FLOORS_BELOW, _FLOORS_ABOVE = 3, 8


@dataclass(frozen=True, slots=True)
class VisibilityParameters:
    """How lines of sight become observed voxels.

    Attributes:
        step_m: places along the track are this far apart.
        azimuths: lines of sight a whole turn at each place.
        levels: elevations of the lines, shared out as the sensor's rays are.
        range_m: what lies farther is not observed; lines still end there.
        reach_m: how far lines are followed.
        noise_m: thickens the Gaussians that stop lines: of ranges and poses.
        r2: squared Mahalanobis distance up to which a Gaussian stops a line.
        new_radius_m: of the ball that stands for a new voxel, whose Gaussian is not at hand.
        min_hits: rays that must end in a voxel in which the map has a Gaussian.
        min_passes: rays that must cross a voxel in which it has none.
        hits_near: so many times more for each face behind which the drive flags a Gaussian as gone or modified: where
            something goes on to change, drives often cannot tell, and abstain.
        passes_near: so many times more for each face behind which it flags something new, for the same reason.
        open_rad: a line that leaves the known map met something there if its elevation is at most this, up or down: far
            down a street. A higher one went into the sky, and nothing came back; a steeper one slipped through a gap
            between Gaussians of the ground.
    """

    step_m: float = 2.0
    azimuths: int = 240
    levels: int = 32
    range_m: float = 50.0
    reach_m: float = 70.0
    noise_m: float = 0.05
    r2: float = 3.0
    new_radius_m: float = 0.5
    min_hits: float = 48.0
    min_passes: float = 256.0
    hits_near: float = 3.0
    passes_near: float = 8.0
    open_rad: float = 0.04

    def __post_init__(self) -> None:
        for name, low, high in (
            ("step_m", 0.25, 20.0), ("azimuths", SECTORS, 3600), ("levels", 2, 128), ("range_m", 5.0, 100.0),
            ("reach_m", self.range_m, 150.0), ("noise_m", 0.005, 0.5), ("r2", 0.1, 100.0), ("new_radius_m", 0.0, 0.5),
            ("min_hits", 0.0, 1e6), ("min_passes", 0.0, 1e6), ("hits_near", 1.0, 1e3),
            ("passes_near", 1.0, 1e3), ("open_rad", 0.0, 1.6),
        ):  # fmt: skip
            if not low <= getattr(self, name) <= high:
                raise ConfigError(f"visibility: {name} must lie in {low:g} … {high:g}, got {getattr(self, name):g}")


def observed_along(
    track: Track, told: Sequence[Flags], parameters: VisibilityParameters | None = None
) -> dict[TileId, I32]:
    """Predict what a drive has observed.

    Args:
        track: of the drive.
        told: of each tile of the report what the vehicle compared with (no Gaussians where it had no map), and the
            voxels that it flags.
        parameters: see `VisibilityParameters`.

    Returns:
        Sorted voxel ids (K,) of each tile; those flagged are always among them.
    """
    p = parameters or VisibilityParameters()
    by_tile = {flags.tile_id: flags for flags in told}
    found = {tile_id: flags.voxel_id for tile_id, flags in by_tile.items()}
    for group in zones(by_tile).values():
        for tile_id, voxel_id in _Zone(track, [by_tile[t] for t in group], p).observed():
            found[tile_id] = np.union1d(found[tile_id], voxel_id).astype(np.int32)
    return found


@dataclass(frozen=True, slots=True)
class _Places:
    """Where lines start: grid coordinates (P, 3), cosine and sine of the heading (P, 2), rays that each line stands
    for (P,), directions before the turn by the heading (R, 3), metres.
    """

    g: F64
    turn: F64
    weight: F64
    directions: F64

    def __getitem__(self, part: slice) -> "_Places":
        return _Places(self.g[part], self.turn[part], self.weight[part], self.directions)


class _Zone:
    """The tiles of one report that share their (nx, ny), in global grid coordinates (`GridFrame`)."""

    def __init__(self, track: Track, told: Sequence[Flags], parameters: VisibilityParameters) -> None:
        self._p, self._told = parameters, told
        grid = VoxelGrid.of(told[0].tile_id)
        self._nx, self._ny = grid.nx, grid.ny
        self._metres = np.array([grid.dx_m, grid.dy_m, grid.dz_m])
        self._first_lon = told[0].tile_id.lon_index
        self._base_g = [self._grid(flags.tile_id, flags.base.voxel_id) for flags in told]
        self._set_stops()
        self._places = self._make_places(track)

    def observed(self) -> Iterator[tuple[TileId, I32]]:
        """Tiles with the ids of their voxels that were seen, sorted; a tile may come several times."""
        hits = np.zeros(len(self._g))
        crossed = [self._look(part, hits) for part in self._chunks()]
        near = self._faces(self._g, (ChangeClass.MODIFIED, ChangeClass.DELETED))
        yield from self._by_tile(self._g[hits >= self._p.min_hits * self._p.hits_near**near])
        if crossed:
            g, member = np.unique(np.concatenate([g for g, _ in crossed]), axis=0, return_inverse=True)
            passes = np.bincount(member.reshape(-1), weights=np.concatenate([n for _, n in crossed]))
            near = self._faces(g, (ChangeClass.NEW,))
            yield from self._by_tile(g[passes >= self._p.min_passes * self._p.passes_near**near])

    def _faces(self, g: I64, classes: tuple[ChangeClass, ...]) -> F64:
        """(N,) behind how many of the faces of voxels (N, 3) the drive flags one of the classes."""
        flagged = [f.voxel_id[np.isin(f.change_class, classes)] for f in self._told]
        changed = [self._grid(f.tile_id, ids) for f, ids in zip(self._told, flagged, strict=True)]
        key = self._key(np.concatenate(changed))
        steps = np.concatenate([np.eye(3, dtype=np.int64), -np.eye(3, dtype=np.int64)])
        return np.asarray(np.sum([np.isin(self._key(g + step), key) for step in steps], axis=0), np.float64)

    def _key(self, g: I64) -> I64:
        """One number a voxel (N, 3); the tiles told lie in one district or next to it."""
        corner = np.array([self._first_lon * self._nx, self._told[0].tile_id.lat_index * self._ny, 0])
        return np.asarray((g - corner) @ np.array([1 << 42, 1 << 21, 1]), np.int64)

    def _grid(self, tile_id: TileId, voxel_id: I32) -> I64:
        """(N, 3) global grid coordinates; along longitude unwrapped about the first tile."""
        ix, iy, floor = VoxelGrid.of(tile_id).unravel(voxel_id)
        half = LON_TILES // 2
        lon = self._first_lon + (tile_id.lon_index - self._first_lon + half) % LON_TILES - half
        return np.stack([lon * self._nx + ix, tile_id.lat_index * self._ny + iy, floor], axis=-1).astype(np.int64)

    def _set_stops(self) -> None:
        """What stops lines: the map's Gaussians but those flagged as gone, and a ball in each new voxel."""
        p, parts = self._p, [(np.zeros((0, 3), np.int64), Gaussians.empty())]
        for flags, g in zip(self._told, self._base_g, strict=True):
            gone = flags.voxel_id[flags.change_class == ChangeClass.DELETED]
            stays = np.flatnonzero(~np.isin(flags.base.voxel_id, gone))
            parts.append((g[stays], flags.base.take(stays)))
        new = [f.voxel_id[f.change_class == ChangeClass.NEW] for f in self._told]
        new_g = np.concatenate([self._grid(f.tile_id, ids) for f, ids in zip(self._told, new, strict=True)])
        known_g = np.concatenate([g for g, _ in parts])
        mean_m = np.concatenate([gaussians.mean_m for _, gaussians in parts])
        cov = np.concatenate([full_matrices(gaussians.cov_m2) for _, gaussians in parts]) + np.eye(3) * p.noise_m**2
        ball = np.broadcast_to(np.eye(3) * (max(p.new_radius_m, 0.01) ** 2 / p.r2), (len(new_g), 3, 3))
        self._g = np.concatenate([known_g, new_g])
        self._mean_m = np.concatenate([mean_m, np.zeros((len(new_g), 3))]).astype(np.float64)
        self._whitening = np.linalg.inv(np.linalg.cholesky(np.concatenate([cov, ball])))

    def _make_places(self, track: Track) -> _Places:
        p, view = self._p, track.view
        total_m = sum(self._length_m(track, piece_number) for piece_number in range(len(track.pieces)))
        step_m = max(p.step_m, total_m / _MOST_PLACES)
        found = [self._along(track, k, step_m) for k in range(len(track.pieces))]
        g = np.concatenate([np.zeros((0, 3)), *(part[0] for part in found)])
        heading = np.concatenate([np.zeros(0), *(part[1] for part in found)])
        scans = np.concatenate([np.zeros(0), *(part[2] for part in found)])
        directions = self._directions(track)
        jitter = np.arange(len(g)) * _GOLDEN % 1.0 * (2.0 * np.pi / p.azimuths)
        turn = np.stack([np.cos(heading + jitter), np.sin(heading + jitter)], axis=1)
        return _Places(g, turn, scans * view.rays / len(directions), directions)

    def _line(self, track: Track, number: int) -> F64:
        """(N, 3) vertices of a piece in grid coordinates."""
        uvh = track.tile_coordinates(track.pieces[number])
        half = LON_TILES // 2
        u = self._first_lon + (uvh[:, 0] - self._first_lon + half) % LON_TILES - half
        return np.column_stack([u * self._nx, uvh[:, 1] * self._ny, uvh[:, 2]])

    def _length_m(self, track: Track, number: int) -> float:
        return float(np.linalg.norm(np.diff(self._line(track, number), axis=0) * self._metres, axis=1).sum())

    def _along(self, track: Track, number: int, step_m: float) -> tuple[F64, F64, F64]:
        """Places along a piece: grid coordinates (P, 3), headings (P,), scans that each stands for (P,)."""
        line = self._line(track, number)
        if len(line) == 1:
            return line, np.zeros(1), np.full(1, float(track.pieces[number].scans))
        leg = np.diff(line, axis=0) * self._metres
        way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(leg, axis=1))])
        n = max(1, round(float(way_m[-1]) / step_m))
        at_m = (np.arange(n) + 0.5) * way_m[-1] / n
        g = np.column_stack([np.interp(at_m, way_m, line[:, axis]) for axis in range(3)])
        of_leg = np.clip(np.searchsorted(way_m, at_m, side="right") - 1, 0, len(leg) - 1)
        heading = np.arctan2(leg[of_leg, 1], leg[of_leg, 0])
        return g, heading, np.full(n, track.pieces[number].scans / n)

    def _directions(self, track: Track) -> F64:
        """(R, 3) unit directions, x ahead: the sensor's sectors of azimuth, its elevations as its rays are shared."""
        p, view = self._p, track.view
        azimuth = (np.arange(p.azimuths) + 0.5) * (2.0 * np.pi / p.azimuths)
        sector = (azimuth * (SECTORS / (2.0 * np.pi))).astype(np.int64)
        azimuth = azimuth[(view.sectors >> sector) & 1 == 1]
        share = (np.arange(p.levels) + 0.5) / p.levels
        elevation = np.interp(share, np.linspace(0.0, 1.0, len(view.levels)), view.elevations_rad)
        flat, up = np.cos(elevation), np.sin(elevation)
        rows = [np.outer(flat, np.cos(azimuth)), np.outer(flat, np.sin(azimuth)), np.outer(up, np.ones(len(azimuth)))]
        return np.ascontiguousarray(np.stack(rows, axis=-1).reshape(-1, 3))

    def _chunks(self) -> Iterator[_Places]:
        """Places in runs so short that the window about each stays small."""
        g, start = self._places.g * self._metres, 0
        for k in range(1, len(g) + 1):
            if k == len(g) or np.abs(g[k] - g[start])[:2].max() > _CHUNK_M:
                yield self._places[start:k]
                start = k

    def _look(self, places: _Places, hits: F64) -> tuple[I64, F64]:
        """Follow the lines from some places: adds to `hits` (stops,), returns the empty voxels crossed, and how often.

        Rays of lines that leave the tiles told are not counted there.
        """
        origin, shape = self._window(places)
        state = self._state(origin, shape)
        passes = np.zeros(state.size)
        cast_lines(
            places.g - origin, places.turn, places.weight, places.directions, self._metres, state, shape,
            (self._g - origin) * self._metres + 0.5 * self._metres + self._mean_m, self._whitening,
            self._p.r2, self._p.range_m, self._p.reach_m, float(np.sin(self._p.open_rad)), hits, passes,
        )  # fmt: skip
        at = np.flatnonzero((passes > 0.0) & (state == NOTHING))
        return np.stack(np.unravel_index(at, shape), axis=-1) + origin, passes[at]

    def _window(self, places: _Places) -> tuple[I64, tuple[int, int, int]]:
        reach = self._p.reach_m / self._metres[:2]
        low, high = places.g[:, :2].min(axis=0) - reach, places.g[:, :2].max(axis=0) + reach
        floors = np.concatenate([self._g[:, 2], np.floor(places.g[:, 2]).astype(np.int64)])
        origin = np.array([*np.floor(low), floors.min() - _FLOORS_BELOW]).astype(np.int64)
        shape = np.array([*np.ceil(high), floors.max() + _FLOORS_ABOVE + 1]).astype(np.int64) - origin
        return origin, (int(shape[0]), int(shape[1]), int(shape[2]))

    def _state(self, origin: I64, shape: tuple[int, int, int]) -> I32:
        """Flat int32 window: row of what stops lines, NOTHING, or OUTSIDE the tiles told."""
        state = np.full(shape, OUTSIDE, np.int32)
        for flags in self._told:
            corner = self._grid(flags.tile_id, VoxelGrid.of(flags.tile_id).voxel_id([0], [0], [0]))[0, :2] - origin[:2]
            low, high = np.maximum(corner, 0), np.maximum(corner + np.array([self._nx, self._ny]), 0)
            state[low[0] : high[0], low[1] : high[1]] = NOTHING
        at = self._g - origin
        inside = np.flatnonzero(((at >= 0) & (at < shape)).all(axis=1))
        state[tuple(at[inside].T)] = inside
        return state.reshape(-1)

    def _by_tile(self, g: I64) -> Iterator[tuple[TileId, I32]]:
        lon_index, ix = np.divmod(g[:, 0], self._nx)
        lat_index, iy = np.divmod(g[:, 1], self._ny)
        morton = interleave(lon_index % LON_TILES, lat_index)
        voxel_id = join_voxel_id(ix, iy, g[:, 2], self._nx, self._ny)
        for flags in self._told:
            mine = np.flatnonzero(morton == flags.tile_id.morton)
            yield flags.tile_id, np.unique(voxel_id[mine])
