"""The accumulator against a plain twin that keeps every point in a dictionary."""

from collections import defaultdict

import numpy as np
import pytest

from gnd.gnd_map.accumulate import N_MIN_CELLS, VoxelAccumulator
from gnd.gnd_map.errors import ShapeError
from gnd.gnd_map.gaussian import full_matrices
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame, VoxelGrid
from gnd.gnd_map.tile_id import LON_TILES, TileId

WANGSIMNI = TileId(497353963154)
FRAME = GridFrame.around(LocalFrame(*WANGSIMNI.centre_rad, 31.0), [WANGSIMNI])
DATE_LINE = GridFrame.around(
    LocalFrame(np.radians(-17.0), np.radians(179.9999), 5.0),
    [TileId.from_geodetic(np.radians(-17.0), np.radians(179.9999))],
)


def points_in_cells(frame: GridFrame, middle_map_m: list[float], n_voxels: int, seed: int) -> np.ndarray:
    """Points (N, 3) of the map frame well inside sub-cells of voxels around a place, in a random order."""
    rng = np.random.default_rng(seed)
    middle = np.floor(frame.grid_of(np.array([middle_map_m]))[0])
    voxel = middle + rng.integers(-25, 25, (n_voxels, 3)) * [1, 1, 0.1]
    cell = np.repeat(np.floor(voxel), 60, axis=0) * 10 + rng.integers(0, 10, (60 * n_voxels, 3)) * [1, 1, 0] + [0, 0, 4]
    g = (cell + rng.uniform(0.05, 0.95, cell.shape)) / 10.0
    return np.asarray(rng.permutation(frame.map_of_grid(g)))


def plain(frame: GridFrame, points: np.ndarray) -> dict[tuple[int, int], tuple[int, int, np.ndarray, np.ndarray]]:
    """(tile, voxel) → points, occupied cells, mean and covariance in the tile's own frame, all by numpy."""
    g = frame.grid_of(points)
    morton, voxel_id = frame.tile_voxel_of(np.floor(g).astype(np.int64))
    rows = defaultdict(list)
    for k, key in enumerate(zip(morton.tolist(), voxel_id.tolist(), strict=True)):
        rows[key].append(k)
    result = {}
    for (code, voxel), members in rows.items():
        grid = VoxelGrid.of(TileId(code))
        d = grid.frame.enu_from_ecef(frame.frame.ecef_from_enu(points[members])) - grid.centre_m(voxel)
        cells = len({tuple(c) for c in np.floor(g[members] * 10).astype(int).tolist()})
        result[code, voxel] = len(members), cells, d.mean(axis=0), np.cov(d.T, bias=True)
    return result


@pytest.mark.parametrize(
    ("frame", "place"),
    [(FRAME, [0.0, 0.0, 0.0]), (FRAME, [2500.0, -3000.0, 12.0]), (DATE_LINE, [10.0, 0.0, 0.0])],
    ids=["at the origin", "4 km away", "over the date line"],
)
def test_fast_and_plain_agree(frame: GridFrame, place: list[float]) -> None:
    points = points_in_cells(frame, place, 300, seed=1)
    accumulator = VoxelAccumulator(frame)
    for part in np.array_split(points, 7):
        accumulator.add(part)
    expected = plain(frame, points)
    found = accumulator.finish(n_min_cells=1)
    assert sum(map(len, found.values())) == len(expected) == len(accumulator)
    for tile, gaussians in found.items():
        for row, voxel in enumerate(gaussians.voxel_id.tolist()):
            count, cells, mean, covariance = expected[tile.morton, voxel]
            assert (gaussians.count[row], gaussians.cells[row]) == (count, cells)
            np.testing.assert_allclose(gaussians.mean_m[row], mean, rtol=0, atol=3e-7)
            np.testing.assert_allclose(gaussians.full_cov()[row], covariance, rtol=0, atol=3e-7)


def test_over_the_date_line_both_tiles_are_filled() -> None:
    accumulator = VoxelAccumulator(DATE_LINE)
    accumulator.add(points_in_cells(DATE_LINE, [10.0, 0.0, 0.0], 300, seed=2))
    assert {tile.lon_index for tile in accumulator.finish(1)} >= {0, LON_TILES - 1}


def test_moments_are_sorted_and_about_the_voxel_centres() -> None:
    points = points_in_cells(FRAME, [5.0, 5.0, 0.0], 50, seed=3)
    accumulator = VoxelAccumulator(FRAME)
    accumulator.add(points)
    g, moments = accumulator.moments()
    assert g.dtype == np.int32
    assert g.tolist() == sorted(g.tolist())
    assert moments.count.sum() == len(points)
    assert np.abs(moments.mean_m()).max() < 0.51
    centres = FRAME.centre_map_m(g)
    total = (centres * moments.count[:, None] + moments.sum_m).sum(axis=0)  # axes turn by < 1e-5 rad so near the origin
    np.testing.assert_allclose(total / len(points), points.mean(axis=0), rtol=0, atol=1e-5)


def test_a_gaussian_needs_twenty_occupied_cells_however_many_points() -> None:
    cells = np.stack(np.unravel_index(np.arange(1000), (10, 10, 10)), axis=1)
    voxel = np.floor(FRAME.grid_of(np.zeros((1, 3))))
    for occupied, expected in ((N_MIN_CELLS - 1, 0), (N_MIN_CELLS, 1)):
        accumulator = VoxelAccumulator(FRAME)
        g = voxel + (cells[:occupied] + 0.5) / 10.0
        for _ in range(50):
            accumulator.add(FRAME.map_of_grid(g))
        assert sum(map(len, accumulator.finish().values())) == expected
        assert accumulator.moments()[1].count.tolist() == [50 * occupied]


def test_all_thousand_cells_are_told_apart() -> None:
    cells = np.stack(np.unravel_index(np.arange(1000), (10, 10, 10)), axis=1)
    voxel = np.floor(FRAME.grid_of(np.zeros((1, 3))))
    accumulator = VoxelAccumulator(FRAME)
    accumulator.add(FRAME.map_of_grid(voxel + (cells + 0.5) / 10.0))
    (gaussians,) = accumulator.finish().values()
    assert gaussians.cells.tolist() == [1000]
    assert np.abs(gaussians.mean_m).max() < 1e-6
    np.testing.assert_allclose(np.diagonal(gaussians.full_cov()[0]), [0.079, 0.0788, 0.0825], atol=1e-3)


def test_growth_loses_nothing() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform([-150.0, -150.0, 0.0], [150.0, 150.0, 3.0], (200_000, 3))
    whole, parts = VoxelAccumulator(FRAME), VoxelAccumulator(FRAME)
    whole.add(points)
    for part in np.array_split(points, 40):
        parts.add(part)
    assert len(whole) > 100_000
    (g_whole, whole_moments), (g_parts, part_moments) = whole.moments(), parts.moments()
    assert abs(len(g_whole) - len(g_parts)) <= 1  # 1e-7 m of expansion error may move a point over a face
    assert whole_moments.count.sum() == part_moments.count.sum() == len(points)
    np.testing.assert_array_equal(np.unique(np.floor(FRAME.grid_of(points)), axis=0)[:5], g_whole[:5])


def test_the_accumulator_goes_on_after_finishing() -> None:
    points = points_in_cells(FRAME, [0.0, 0.0, 0.0], 20, seed=6)
    once, twice = VoxelAccumulator(FRAME), VoxelAccumulator(FRAME)
    once.add(points)
    twice.add(points[:500])
    twice.finish()
    twice.add(points[500:])
    a, b = once.moments()[1], twice.moments()[1]
    np.testing.assert_array_equal(a.count, b.count)
    np.testing.assert_allclose(full_matrices(a.outer_m2), full_matrices(b.outer_m2), rtol=0, atol=1e-6)


def test_popped_tiles_are_forgotten_and_the_others_stay() -> None:
    points = points_in_cells(FRAME, [0.0, 0.0, 0.0], 400, seed=7)
    accumulator, whole = VoxelAccumulator(FRAME), VoxelAccumulator(FRAME)
    accumulator.add(points)
    whole.add(points)
    expected = whole.finish(1)
    first, *others = expected
    assert accumulator.pop([first], n_min_cells=1) == {first: expected[first]}
    assert accumulator.finish(1) == {tile: expected[tile] for tile in others}
    accumulator.add(points)  # the hash still finds the voxels that stayed, and knows those that went no more
    again = accumulator.finish(1)
    np.testing.assert_array_equal(again[first].count, expected[first].count)
    np.testing.assert_array_equal(again[others[0]].count, 2 * expected[others[0]].count)
    accumulator.pop(list(expected))
    assert len(accumulator) == 0


def test_popping_leaves_out_voxels_with_too_few_cells() -> None:
    accumulator = VoxelAccumulator(FRAME)
    accumulator.add(np.zeros((30, 3)))
    assert accumulator.pop([WANGSIMNI]) == {}
    assert len(accumulator) == 0


def test_points_of_another_band_are_counted_not_taken() -> None:
    _, last = FRAME.lat_index_range
    edge = TileId.from_indices(WANGSIMNI.lon_index, last)
    frame = GridFrame.around(LocalFrame(*edge.centre_rad, 0.0), [edge])
    accumulator = VoxelAccumulator(frame)
    accumulator.add(np.array([[0.0, 0.0, 5.0], [0.0, 60.0, 5.0], [0.0, 0.0, 150_000.0]]))
    assert (len(accumulator), accumulator.ignored) == (1, 2)


def test_an_empty_accumulator_has_no_tiles() -> None:
    accumulator = VoxelAccumulator(FRAME)
    accumulator.add(np.empty((0, 3)))
    assert accumulator.finish() == {}


def test_points_that_are_not_finite_are_refused_whole() -> None:
    accumulator = VoxelAccumulator(FRAME)
    with pytest.raises(ShapeError, match="2 of 6 values are not finite"):
        accumulator.add(np.array([[0.0, 0.0, 0.0], [np.nan, np.inf, 0.0]]))
    assert len(accumulator) == 0


@pytest.mark.parametrize("spread_m", [40.0, 400.0])  # the second is too wide for the expansion
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_marked_points_are_taken_as_if_they_were_copied(spread_m: float, share: float) -> None:
    rng = np.random.default_rng(7)
    points = rng.normal(scale=spread_m / 3.0, size=(20_000, 3)) * [1.0, 1.0, 0.1]
    marks = (rng.random(len(points)) < share).astype(np.uint8)
    one, other = VoxelAccumulator(FRAME), VoxelAccumulator(FRAME)
    one.add_marked(points, marks)
    other.add(points[marks != 0])
    assert len(one) == len(other)
    assert one.ignored == other.ignored
    (g, moments), (g_other, moments_other) = one.moments(), other.moments()
    np.testing.assert_array_equal(g, g_other)
    np.testing.assert_array_equal(moments.count, moments_other.count)
    np.testing.assert_array_equal(moments.sum_m, moments_other.sum_m)
