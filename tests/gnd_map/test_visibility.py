"""Lines of sight: the kernel against a plain twin, and what a drive past a wall can and cannot have observed."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnd_map.classes import ChangeClass
from gnd_map.codec import Flags
from gnd_map.errors import ConfigError
from gnd_map.gaussian import Gaussians
from gnd_map.grid import VoxelGrid
from gnd_map.sight import NOTHING, OUTSIDE, cast_lines
from gnd_map.tile_id import TileId
from gnd_map.track import Piece, Track, View
from gnd_map.visibility import VisibilityParameters, observed_along

METRES = np.array([0.97, 0.99, 1.0])
R2, RANGE_M, REACH_M = 3.0, 7.0, 9.0


def plain_lines(places, turn, weight, directions, state, shape, mean, whitening, level):
    """Voxel by voxel between sorted crossings; r² by looking at many points of each stretch."""
    hits, passes = np.zeros(len(mean)), np.zeros(state.size)
    for place, (cos, sin), w in zip(places, turn, weight, strict=True):
        for x, y, z in directions:
            d = np.array([cos * x - sin * y, sin * x + cos * y, z])
            crossed, met = [], abs(z) < level
            for t_in, t_out, cell in stretches(place, d / METRES, shape):
                at = np.ravel_multi_index(cell, shape)
                row = state[at]
                if row >= 0:
                    points = place * METRES + np.linspace(t_in, min(t_out, REACH_M), 4000)[:, None] * d
                    off = (points - mean[row]) @ whitening[row].T
                    if (off**2).sum(axis=1).min() <= R2:
                        met, hits[row] = True, hits[row] + w * (t_in <= RANGE_M)
                        break
                if t_in <= RANGE_M:
                    crossed.append(at)
            if met:
                passes[crossed] += w
    return hits, passes


def stretches(place, g, shape):
    """(t_in, t_out, voxel) of a line until REACH_M or out of the window, from all faces at once."""
    faces = [(k - place[axis]) / g[axis] for axis in range(3) if g[axis] for k in range(shape[axis] + 1)]
    t = np.unique([0.0, *(x for x in faces if x > 0.0)])
    for t_in, t_out in pairwise(t):
        cell = np.floor(place + g * 0.5 * (t_in + t_out)).astype(int)
        if t_in >= REACH_M or (cell < 0).any() or (cell >= shape).any():
            return
        yield t_in, t_out, tuple(cell)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_kernel_sees_what_the_plain_twin_sees(seed):
    rng = np.random.default_rng(seed)
    shape, n = (6, 7, 5), 40
    state = np.where(rng.random(6 * 7 * 5) < 0.2, OUTSIDE, NOTHING).astype(np.int32)
    cells = rng.choice(state.size, n, replace=False)
    state[cells] = np.arange(n)
    mean = (np.stack(np.unravel_index(cells, shape), axis=1) + rng.uniform(0.2, 0.8, (n, 3))) * METRES
    spread = rng.normal(size=(n, 3, 3)) * rng.choice([0.05, 0.3], (n, 1, 3))
    whitening = np.linalg.inv(np.linalg.cholesky(spread @ spread.transpose(0, 2, 1) + 0.03**2 * np.eye(3)))
    directions = rng.normal(size=(12, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    angle = rng.uniform(0.0, 7.0, 3)
    places, turn, weight = rng.uniform(0.1, [5.9, 6.9, 4.9], (3, 3)), np.stack([np.cos(angle), np.sin(angle)], 1), angle
    hits, passes = np.zeros(n), np.zeros(state.size)
    cast_lines(
        places, turn, weight, directions, METRES, state, shape, mean, whitening,
        R2, RANGE_M, REACH_M, 0.4, hits, passes,
    )  # fmt: skip
    plain_hits, plain_passes = plain_lines(places, turn, weight, directions, state, shape, mean, whitening, 0.4)
    np.testing.assert_allclose(hits, plain_hits)
    np.testing.assert_allclose(passes, plain_passes)


# --- a street of one row of tiles: flat ground, a wall along its north side


WEST = TileId(497353963154)
TILES = [TileId.from_indices(WEST.lon_index + k, WEST.lat_index) for k in range(2)]
GRID = VoxelGrid.of(WEST)
GROUND, WALL_ROW, HIGH = 20, 24, 5
FLAT = (0.28, 0.28, 0.01)
UPRIGHT = (0.42, 0.01, 0.42)  # wider than points of a voxel spread, so that no line slips through where four meet
SEEN = View((-60, -52, -36, -20, -4, 12, 28, 44, 60), rays_log2=59, range_m=60)


def voxel(ix, iy, floor):
    return int(GRID.voxel_id(ix, iy, floor))


def gaussians(at):
    """Of {voxel id: standard deviations}, each in the middle of its voxel."""
    ids = np.array(sorted(at), np.int32)
    cov = np.zeros((len(ids), 6), np.float32)
    cov[:, [0, 3, 5]] = np.array([at[i] for i in ids.tolist()], np.float32).reshape(-1, 3) ** 2
    n = len(ids)
    return Gaussians(ids, np.full(n, 200, np.int32), np.full(n, 60, np.int32), np.zeros((n, 3), np.float32), cov)


STREET = gaussians(
    {voxel(i, j, GROUND): FLAT for i in range(GRID.nx) for j in range(GRID.ny)}
    | {voxel(i, WALL_ROW, GROUND + k): UPRIGHT for i in range(GRID.nx) for k in range(HIGH)}
)
# 2 m over the ground, along row 12 through both tiles
PATH = [(64 * (TILES[k].lon_index % 32) + 8 + 48 * k, 64 * (WEST.lat_index % 32) + 20, 45) for k in range(2)]
DRIVE = Track(WEST.district, SEEN, (Piece(np.array(PATH, np.int32), 60),))


def told(*flagged, tile=WEST, base=STREET):
    ids, classes = zip(*sorted(flagged), strict=True) if flagged else ((), ())
    return Flags(tile, base, np.array(ids, np.int32), np.array(classes, np.uint8))


def seen(track=DRIVE, *flagged, **how):
    return set(observed_along(track, [told(*flagged), told(tile=TILES[1])], **how)[WEST].tolist())


def share(found, rows, floor):
    """Of the voxels of some rows on a floor, the share observed."""
    there = [voxel(i, j, floor) in found for i in range(GRID.nx) for j in rows]
    return sum(there) / len(there)


def test_a_drive_sees_the_ground_the_air_and_the_wall_but_not_what_lies_behind_it():
    found = seen()
    assert share(found, range(14, 20), GROUND) > 0.95
    assert share(found, range(14, 23), GROUND + 1) > 0.95
    assert share(found, [WALL_ROW], GROUND + 2) > 0.95
    behind = range(WALL_ROW + 2, WALL_ROW + 10)
    flat = gaussians({voxel(i, j, GROUND): FLAT for i in range(GRID.nx) for j in range(GRID.ny)})
    without = observed_along(DRIVE, [told(base=flat), told(tile=TILES[1], base=flat)])[WEST].tolist()
    for floor in (GROUND, GROUND + 1):
        assert share(found, behind, floor) < 0.1
        assert share(set(without), behind, floor) > 0.6


def test_what_is_flagged_is_always_observed_and_stops_lines_unless_it_is_gone():
    behind = voxel(15, WALL_ROW + 1, GROUND + 2)
    gone = [(voxel(i, WALL_ROW, GROUND + k), ChangeClass.DELETED) for i in range(GRID.nx) for k in range(HIGH)]
    assert behind not in seen()
    assert behind in seen(DRIVE, *gone)
    assert {v for v, _ in gone} <= seen(DRIVE, *gone)
    fence = [(voxel(i, 18, GROUND + k), ChangeClass.NEW) for i in range(GRID.nx) for k in range(1, 6)]
    before = voxel(15, WALL_ROW, GROUND + 2)
    assert before in seen()
    assert before not in seen(DRIVE, *fence)
    assert {v for v, _ in fence} <= seen(DRIVE, *fence)
    moved = [(voxel(i, WALL_ROW, GROUND + k), ChangeClass.MODIFIED) for i in range(GRID.nx) for k in range(HIGH)]
    assert behind not in seen(DRIVE, *moved)


def test_next_to_changes_more_rays_are_needed():
    beside = [(voxel(15 + i, 18 + j, GROUND + 1), ChangeClass.NEW) for i, j in ((1, 0), (-1, 0), (0, 1))]
    air = voxel(15, 18, GROUND + 1)
    assert air in seen(DRIVE, *beside, parameters=VisibilityParameters(passes_near=1.0))
    assert air not in seen(DRIVE, *beside, parameters=VisibilityParameters(passes_near=1000.0))


def test_a_sensor_that_looks_ahead_only_does_not_see_what_it_starts_beside():
    narrow = View(SEEN.levels, 0b1000000000000001, SEEN.rays_log2, SEEN.range_m)
    start = voxel(4, 20, GROUND)  # beside the start of the drive, which goes east
    assert start in seen()
    assert start not in seen(Track(WEST.district, narrow, DRIVE.pieces))


def test_where_there_is_no_map_nothing_stops_a_line():
    empty = [told(base=Gaussians.empty()), told(tile=TILES[1], base=Gaussians.empty())]
    found = observed_along(DRIVE, empty, VisibilityParameters(open_rad=1.0))
    below = set(found[WEST].tolist())
    assert voxel(15, 18, GROUND + 1) in below
    assert voxel(15, WALL_ROW + 6, GROUND + 1) in below


def test_what_lies_under_the_ground_is_not_observed_though_lines_slip_through_its_gaps():
    found = seen()
    assert share(found, range(10, 20), GROUND) > 0.9
    assert share(found, range(10, 20), GROUND - 1) < 0.02


def test_a_standing_vehicle_sees_and_a_track_without_scans_sees_nothing():
    stands = Track(WEST.district, SEEN, (Piece(np.array(PATH[:1], np.int32), 60),))
    assert len(seen(stands)) > 200
    assert seen(Track(WEST.district, SEEN, ())) == set()


def test_the_same_drive_gives_the_same_prediction_sorted():
    one, two = (observed_along(DRIVE, [told(), told(tile=TILES[1])]) for _ in range(2))
    assert list(one) == list(two) == TILES
    for tile in TILES:
        np.testing.assert_array_equal(one[tile], two[tile])
        assert one[tile].dtype == np.int32
        assert (np.diff(one[tile]) > 0).all()
        assert len(one[tile]) > 300


def test_tiles_of_two_latitude_zones_are_looked_at_apart():
    lat = WEST.lat_index
    while VoxelGrid.of(TileId.from_indices(WEST.lon_index, lat)).nx == GRID.nx:
        lat += 1
    pair = [TileId.from_indices(WEST.lon_index, lat - 1), TileId.from_indices(WEST.lon_index, lat)]
    corner = TileId(pair[0].district.first_morton)
    path = [((pair[0].lon_index - corner.lon_index) * 64 + 20 + k, (lat - corner.lat_index) * 64, 45) for k in (0, 20)]
    track = Track(pair[0].district, SEEN, (Piece(np.array(path, np.int32), 40),))
    found = observed_along(track, [told(tile=tile, base=Gaussians.empty()) for tile in pair])
    assert min(len(found[tile]) for tile in pair) > 200


@pytest.mark.parametrize("name", ["step_m", "azimuths", "levels", "range_m", "noise_m", "r2", "hits_near"])
def test_parameters_outside_their_range_are_refused_with_the_value(name):
    with pytest.raises(ConfigError, match=f"{name} must lie in .* got -7"):
        VisibilityParameters(**{name: -7})
