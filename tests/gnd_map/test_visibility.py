"""Lines of sight: the kernel against a plain twin, and what a drive past a wall can and cannot have observed."""

import itertools
import threading
import time
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnd.gnd_map import visibility
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.codec import Flags
from gnd.gnd_map.errors import TrackError
from gnd.gnd_map.gaussian import Gaussians, full_matrices, six_entries
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.sight import (
    NO_SLOT,
    NOTHING,
    STOP,
    SightColumns,
    SightWindow,
    cast_fans,
    fill,
    lay_out,
    pool,
    voxel_ids,
)
from gnd.gnd_map.tile_id import TileId
from gnd.gnd_map.track import Track, TrackPiece, TrackView
from gnd.gnd_map.visibility import observed_along

COLUMNS, TILES_ALONG, FLOORS = (4, 5), (2, 2), 6
METRES = np.array([0.97, 0.99, 1.0])
R2, RANGE_M, REACH_M, LEVEL = 3.0, 5.0, 7.0, 0.2


def small_window(low):
    """Two by two tiles of 4 x 5 columns, of which one is not at hand; the others' floors start at `low`."""
    slot_of = np.array([[0, 1], [NO_SLOT, 2]], np.int32)
    corner = np.array([(0, 0), (0, 5), (4, 5)], np.int32)
    offset = np.arange(4) * 20 * FLOORS
    return SightWindow(
        COLUMNS, METRES, slot_of, corner, offset, np.array(low, np.int32), np.full(3, FLOORS, np.int32), min(low)
    )


def cells(w):
    """{(column, row, floor): cell} of a window."""
    found = {}
    for slot, (x, y) in enumerate(w.corner.tolist()):
        for i in range(COLUMNS[0]):
            for j in range(COLUMNS[1]):
                first = int(w.offset[slot]) + (j * COLUMNS[0] + i) * FLOORS
                found |= {(x + i, y + j, int(w.low[slot]) + k): first + k for k in range(FLOORS)}
    return found


def plain_fans(w, place, turn, rays, azimuth, slope, lines, solid, state, hits):
    """Line by line, voxel by voxel between sorted crossings of faces; r² by looking at many points of each stretch."""
    at, phase, stride = cells(w), 0, len(slope) // lines
    for start, (cos, sin), n in zip(place, turn, rays.tolist(), strict=True):
        for x, y in azimuth:
            phase = (phase + 40503) % 65536
            for s in slope[phase * stride // 65536 :: stride]:
                d, length = np.array([cos * x - sin * y, sin * x + cos * y, s]), np.sqrt(1.0 + s * s)
                crossed, met = [], abs(s) < LEVEL
                for t_in, t_out, t_column, voxel in stretches(start, d, REACH_M / length):
                    row = state[at[voxel]] if voxel in at else NOTHING
                    counts = t_column <= RANGE_M / length
                    if row >= 0 and least_r2(start, d, t_in, t_out, *solid[row]) <= R2:
                        met, hits[row] = True, hits[row] + n * counts
                        break
                    if row < 0 and voxel in at and counts:
                        crossed.append(at[voxel])
                if met:
                    state[crossed] -= n


def stretches(start, d, reach):
    """(t_in, t_out, t at which the column was entered, voxel) of a line until it leaves the tiles or its reach; t is
    horizontal.
    """
    g, size = d / METRES, np.array([2 * COLUMNS[0], 2 * COLUMNS[1]])
    walls = [(k - start[a]) / g[a] for a in (0, 1) if g[a] for k in range(size[a] + 1)]
    floors = [(k - start[2]) / g[2] for k in range(-80, 40) if g[2]]
    t = np.unique([0.0, *(x for x in (*walls, *floors) if x > 0.0)])
    for t_in, t_out in pairwise(t):
        voxel = np.floor(start + g * 0.5 * (t_in + t_out)).astype(int)
        if t_in >= reach or (voxel[:2] < 0).any() or (voxel[:2] >= size).any():
            return
        yield t_in, min(t_out, reach), max([0.0, *(x for x in walls if 0.0 < x <= t_in)]), tuple(voxel.tolist())


def least_r2(start, d, t_in, t_out, mean, whitening):
    points = start * METRES + np.linspace(t_in, t_out, 4000)[:, None] * d
    return (((points - mean) @ whitening.T) ** 2).sum(axis=1).min()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_kernel_sees_what_the_plain_twin_sees(seed):
    rng = np.random.default_rng(seed)
    w = small_window(rng.integers(-3, 3, 3).tolist() if seed % 2 else [-60, -58, -61])
    n, grid = 60, cells(w)
    voxels = np.array(sorted(grid))[rng.choice(len(grid), n, replace=False)]
    slot = w.slot_of[voxels[:, 0] // COLUMNS[0], voxels[:, 1] // COLUMNS[1]]
    column = voxels[:, 1] % COLUMNS[1] * COLUMNS[0] + voxels[:, 0] % COLUMNS[0]
    ids = (voxels[:, 2] * 20 + column - 10).astype(np.int32)
    mean = rng.uniform(-0.3, 0.3, (n, 3)).astype(np.float32)
    spread = rng.normal(size=(n, 3, 3)) * rng.choice([0.05, 0.3], (n, 1, 3))
    cov = six_entries(spread @ spread.transpose(0, 2, 1)).astype(np.float32)
    state, hits = np.full(w.offset[-1], NOTHING, np.int32), np.zeros(n, np.int64)
    filled, stop = np.zeros((60, 2), np.uint64), np.zeros((n, STOP), np.float32)
    lay_out(w, slot, ids, mean, cov, 0.03, 0.03**2, state, filled, stop)
    noisy = full_matrices(cov) + 0.03**2 * np.eye(3)
    solid = list(zip((voxels + 0.5) * METRES + mean, np.linalg.inv(np.linalg.cholesky(noisy)), strict=True))
    low, angle = float(w.lowest), rng.uniform(0.0, 7.0, 3)
    place = rng.uniform([0.1, 0.1, low + 0.1], [7.9, 9.9, low + 6.0], (3, 3))
    turn, rays = np.stack([np.cos(angle), np.sin(angle)], 1), rng.integers(1, 100, 3)
    azimuth, slope = np.array([(1.0, 0.0), (0.6, 0.8), (-0.8, 0.6), (0.28, -0.96)]), np.sort(rng.normal(size=16))
    plain_state, plain_hits = state.copy(), hits.copy()
    plain_fans(w, place, turn, rays, azimuth, slope, 4, solid, plain_state, plain_hits)
    cast_fans(
        w, place, turn, rays, azimuth, slope, 4, stop, filled, R2, RANGE_M, REACH_M, LEVEL, state, hits,
        SightColumns.room(), np.empty(2),
    )  # fmt: skip
    np.testing.assert_array_equal(hits, plain_hits)
    np.testing.assert_array_equal(state, plain_state)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_pooling_filling_and_collecting_are_what_they_say(seed):
    """Against sums over sets of voxels; floors over two words, tiles with neighbours and without."""
    rng, low = np.random.default_rng(seed), [-3, 59, 60]
    w = small_window(low)
    grid = cells(w)
    solid = {v: row for row, v in enumerate(v for v in sorted(grid) if rng.random() < 0.4)}
    seen = {v for v in sorted(grid) if rng.random() < 0.6}
    fenced = {v for v in sorted(grid) if rng.random() < 0.1}
    hits, state = rng.integers(0, 1000, len(solid)), np.full(w.offset[-1], NOTHING, np.int32)
    near = np.zeros(w.offset[-1], np.uint8)
    for v, row in solid.items():
        state[grid[v]] = row
    near[[grid[v] for v in fenced]] = 1
    filled, more = bits_of(w, solid), np.zeros((60, 2), np.uint64)
    pooled = np.zeros(len(solid), np.int64)
    pool(w, filled, state, hits, pooled)
    fill(w, filled, near, bits_of(w, seen), more)
    around = [d for d in itertools.product((-1, 0, 1), repeat=3) if np.abs(d).sum() <= 2]
    for v, row in solid.items():
        beside = [hits[solid[o]] for o in (tuple(np.add(v, d).tolist()) for d in around) if o in solid]
        assert pooled[row] == sum(beside) // len(beside)
    faces = [d for d in around if np.abs(d).sum() == 1]
    between = {v for v in grid if sum(tuple(np.add(v, d).tolist()) in seen for d in faces) >= 4}
    both = seen | {v for v in between if v not in solid and v not in fenced}
    ids, ends = voxel_ids(w, bits_of(w, seen) | more)
    parts = np.split(ids, ends[:-1])
    for slot, (x, y) in enumerate(w.corner.tolist()):
        mine = [v for v in both if w.slot_of[v[0] // 4, v[1] // 5] == slot]
        assert parts[slot].tolist() == sorted(20 * k + (j - y) * 4 + i - x - 10 for i, j, k in mine)


def bits_of(w, voxels):
    """(60, 2) bits of voxels, as the kernels hold them."""
    bits = np.zeros((60, 2), np.uint64)
    for i, j, k in voxels:
        row = int(w.slot_of[i // 4, j // 5]) * 20 + j % 5 * 4 + i % 4
        bits[row, (k - w.lowest) // 64] |= np.uint64(1 << (k - w.lowest) % 64)
    return bits


# --- a street of one row of tiles: flat ground, a wall along its north side


WEST = TileId(497353963154)
TILES = [TileId.from_indices(WEST.lon_index + k, WEST.lat_index) for k in range(2)]
GRID = VoxelGrid.of(WEST)
GROUND, WALL_ROW, HIGH = 20, 24, 5
FLAT = (0.28, 0.28, 0.01)
UPRIGHT = (0.42, 0.01, 0.42)  # wider than points of a voxel spread, so that no line slips through where four meet
SEEN = TrackView((-60, -52, -36, -20, -4, 12, 28, 44, 60), rays_log2=59, range_m=60)


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
DRIVE = Track(WEST.district, SEEN, (TrackPiece(np.array(PATH, np.int32), 60),))


def told(*flagged, tile=WEST, base=STREET):
    ids, classes = zip(*sorted(flagged), strict=True) if flagged else ((), ())
    return Flags(tile, base, np.array(ids, np.int32), np.array(classes, np.uint8))


def seen(track=DRIVE, *flagged):
    return set(observed_along(track, [told(*flagged), told(tile=TILES[1])])[WEST].tolist())


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
    across = itertools.product(range(GRID.nx), (18, 19, 20), range(1, 6))  # thick: lines slip between single balls
    fence = [(voxel(i, j, GROUND + k), ChangeClass.NEW) for i, j, k in across]
    before = voxel(15, WALL_ROW, GROUND + 2)
    assert before in seen()
    fenced = set(observed_along(DRIVE, [told(*fence), told(*fence, tile=TILES[1])])[WEST].tolist())
    assert before not in fenced
    assert {v for v, _ in fence} <= fenced
    moved = [(voxel(i, WALL_ROW, GROUND + k), ChangeClass.MODIFIED) for i in range(GRID.nx) for k in range(HIGH)]
    assert behind not in seen(DRIVE, *moved)


def test_next_to_changes_more_rays_are_needed(monkeypatch):
    beside = [(voxel(15 + i, 18 + j, GROUND + 1), ChangeClass.NEW) for i, j in ((1, 0), (-1, 0), (0, 1))]
    air = voxel(15, 18, GROUND + 1)
    monkeypatch.setattr(visibility, "_PASSES_NEAR", 1.0)
    assert air in seen(DRIVE, *beside)
    monkeypatch.setattr(visibility, "_PASSES_NEAR", 1000.0)
    assert air not in seen(DRIVE, *beside)


def test_a_sensor_that_looks_ahead_only_does_not_see_what_it_starts_beside():
    narrow = TrackView(SEEN.levels, 0b1000000000000001, SEEN.rays_log2, SEEN.range_m)
    start = voxel(4, 20, GROUND)  # beside the start of the drive, which goes east
    assert start in seen()
    assert start not in seen(Track(WEST.district, narrow, DRIVE.pieces))


def test_where_there_is_no_map_nothing_stops_a_line(monkeypatch):
    monkeypatch.setattr(visibility, "_OPEN_RAD", 1.0)
    empty = [told(base=Gaussians.empty()), told(tile=TILES[1], base=Gaussians.empty())]
    found = observed_along(DRIVE, empty)
    below = set(found[WEST].tolist())
    assert voxel(15, 18, GROUND + 1) in below
    assert voxel(15, WALL_ROW + 6, GROUND + 1) in below


def test_what_lies_under_the_ground_is_not_observed_though_lines_slip_through_its_gaps():
    found = seen()
    assert share(found, range(10, 20), GROUND) > 0.9
    assert share(found, range(10, 20), GROUND - 1) < 0.02


def test_a_standing_vehicle_sees_and_a_track_without_scans_sees_nothing():
    stands = Track(WEST.district, SEEN, (TrackPiece(np.array(PATH[:1], np.int32), 60),))
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
    track = Track(pair[0].district, SEEN, (TrackPiece(np.array(path, np.int32), 40),))
    found = observed_along(track, [told(tile=tile, base=Gaussians.empty()) for tile in pair])
    assert min(len(found[tile]) for tile in pair) > 200


def test_a_track_that_jumps_by_kilometres_is_refused_before_it_takes_memory():
    corner = TileId(WEST.district.first_morton)
    tiles = [TileId.from_indices(corner.lon_index + i, corner.lat_index + j) for i in range(32) for j in range(32)]
    spots = itertools.product(range(2, 32, 4), repeat=2)
    pieces = [TrackPiece(np.array([[64 * i, 64 * j, 18_000 * (i % 8 == 2)]], np.int32), 9) for i, j in spots]
    empty = [told(tile=tile, base=Gaussians.empty()) for tile in sorted(tiles)]
    with pytest.raises(TrackError, match=r"between floors -\d+ and 90\d\d cross .* at most"):
        observed_along(Track(WEST.district, SEEN, tuple(pieces)), empty)


def test_two_threads_look_at_once_and_a_third_goes_on(monkeypatch):
    """Kernels run without the GIL. While two threads look along a drive, a third that only counts keeps most of its
    pace: with the GIL held it would stand still for whole looks.
    """
    for name, value in (("_STEP_M", 0.5), ("_AZIMUTHS", 960), ("_LINES", 32)):
        monkeypatch.setattr(visibility, name, value)
    told_all = [told(), told(tile=TILES[1])]
    observed_along(DRIVE, told_all)
    gaps_s, stop = [], threading.Event()

    def count():
        before = time.perf_counter()
        while not stop.is_set():
            time.sleep(0.001)
            gaps_s.append(time.perf_counter() - before)
            before = time.perf_counter()

    started = time.perf_counter()
    observed_along(DRIVE, told_all)
    alone_s = time.perf_counter() - started
    counter = threading.Thread(target=count)
    lookers = [threading.Thread(target=observed_along, args=(DRIVE, told_all)) for _ in range(2)]
    for thread in (counter, *lookers):
        thread.start()
    for thread in lookers:
        thread.join()
    stop.set()
    counter.join()
    assert alone_s > 0.05  # else a gap would tell nothing
    assert max(gaps_s) < 0.5 * alone_s
