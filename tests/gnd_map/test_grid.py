"""The voxel rule: Figure 2, the equator, 49° N, the poles, the date line; and the grid over a stretch of road."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnd.gnd_map.errors import ShapeError, TileError
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame, VoxelGrid, divisions, zones
from gnd.gnd_map.near_grid import RADIUS_M, grid_near
from gnd.gnd_map.tile_id import LAT_TILES, LON_TILES, TileId, covering_circle, geodetic_of_tile_coordinates, morton_of

WANGSIMNI = TileId(497353963154)
EQUATOR = TileId.from_geodetic(1e-9, 0.3)
KARLSRUHE = TileId.from_geodetic(np.radians(49.0), np.radians(8.4))
NORTH = TileId.from_indices(5, LAT_TILES - 1)
SOUTH = TileId.from_indices(5, 0)
DATE_LINE_WEST = TileId.from_geodetic(np.radians(-17.0), np.radians(179.9999))
DATE_LINE_EAST = TileId.from_geodetic(np.radians(-17.0), np.radians(-179.9999))
PLACES = [WANGSIMNI, EQUATOR, KARLSRUHE, NORTH, SOUTH, DATE_LINE_WEST, DATE_LINE_EAST]
fractions = st.floats(0.01, 0.99)
tiles = st.one_of(
    st.sampled_from(PLACES),
    st.builds(TileId.from_indices, st.integers(0, LON_TILES - 1), st.integers(0, LAT_TILES - 1)),
)


def _frame_at(tile: TileId, height_m: float = 30.0) -> GridFrame:
    return GridFrame.around(LocalFrame(*tile.centre_rad, height_m), [tile])


def test_figure_2_has_31_by_39_voxels_of_its_printed_size() -> None:
    grid = VoxelGrid.of(WANGSIMNI)
    assert (grid.nx, grid.ny, grid.nx * grid.ny) == (31, 39, 1209)
    assert (grid.dx_m, grid.dy_m) == pytest.approx((0.9785, 0.9770), abs=5e-5)


def test_figure_2_sea_level_floor_runs_from_minus_604_to_604() -> None:
    grid = VoxelGrid.of(WANGSIMNI)
    iy, ix = np.divmod(np.arange(1209), 31)
    assert grid.voxel_id(ix, iy, 0).tolist() == list(range(-604, 605))
    assert grid.voxel_id([0, 30], 0, 0).tolist() == [-604, -574]  # the ends of the rows that the figure prints
    assert grid.voxel_id([0, 30], 1, 0).tolist() == [-573, -543]
    assert grid.voxel_id([0, 30], 37, 0).tolist() == [543, 573]
    assert grid.voxel_id([0, 30], 38, 0).tolist() == [574, 604]
    assert int(grid.voxel_id(15, 19, 0)) == 0  # the middle
    assert int(grid.voxel_id(0, 0, 1)) == 605  # the next floor begins where this one ends
    assert int(grid.voxel_id(30, 38, -1)) == -605


@pytest.mark.parametrize(
    ("tile", "nx", "ny"),
    [(EQUATOR, 39, 38), (KARLSRUHE, 26, 39), (NORTH, 1, 39), (SOUTH, 1, 39), (WANGSIMNI, 31, 39)],
)
def test_one_rule_at_every_latitude(tile: TileId, nx: int, ny: int) -> None:
    grid = VoxelGrid.of(tile)
    assert (grid.nx, grid.ny) == (nx, ny)
    iy, ix = np.divmod(np.arange(nx * ny), nx)
    half = (nx * ny) // 2
    assert grid.voxel_id(ix, iy, 0).tolist() == list(range(-half, nx * ny - half))


def test_voxels_are_nominally_one_metre_and_never_larger() -> None:
    for lat_index in range(0, LAT_TILES, 1237):
        grid = VoxelGrid.of(TileId.from_indices(0, lat_index))
        assert 0.9 < grid.dy_m <= 1.0
        assert grid.dx_m <= 1.0
        assert grid.dx_m > 1.0 - 1.0 / grid.nx or grid.nx == 1


@given(tiles, st.integers(0, 10**6), st.integers(-500, 9_000))
def test_ids_and_indices_lead_to_each_other(tile: TileId, cell: int, floor: int) -> None:
    grid = VoxelGrid.of(tile)
    iy, ix = divmod(cell % (grid.nx * grid.ny), grid.nx)
    assert tuple(map(int, grid.unravel(grid.voxel_id(ix, iy, floor)))) == (ix, iy, floor)


@given(tiles, st.integers(0, 10**6), st.integers(-500, 9_000), fractions, fractions, fractions)
def test_every_position_in_a_voxel_has_its_id(
    tile: TileId, cell: int, floor: int, x: float, y: float, z: float
) -> None:
    grid = VoxelGrid.of(tile)
    iy, ix = divmod(cell % (grid.nx * grid.ny), grid.nx)
    u, v = tile.lon_index + (ix + x) / grid.nx, tile.lat_index + (iy + y) / grid.ny
    lat, lon = geodetic_of_tile_coordinates(u, v)
    voxel_id = grid.voxel_id(ix, iy, floor)
    assert grid.voxel_of(lat, lon, floor + z) == voxel_id
    lat_c, lon_c, height_c = grid.centre_geodetic(voxel_id)
    assert grid.voxel_of(lat_c, lon_c, height_c) == voxel_id


@pytest.mark.parametrize("tile", PLACES)
def test_centres_lie_one_step_apart_in_the_tile_frame(tile: TileId) -> None:
    grid = VoxelGrid.of(tile)
    here = grid.centre_m(grid.voxel_id(0, grid.ny // 2, 0))
    north = grid.centre_m(grid.voxel_id(0, grid.ny // 2 + 1, 0))
    up = grid.centre_m(grid.voxel_id(0, grid.ny // 2, 1))
    assert np.linalg.norm(north - here) == pytest.approx(grid.dy_m, rel=1e-5)
    assert up - here == pytest.approx([0.0, 0.0, 1.0], abs=1e-5)
    if grid.nx > 1:
        east = grid.centre_m(grid.voxel_id(1, grid.ny // 2, 0))
        assert np.linalg.norm(east - here) == pytest.approx(grid.dx_m, rel=1e-4)


def test_the_tile_edge_belongs_to_the_tile_in_the_east_and_north() -> None:
    east = TileId.from_indices(WANGSIMNI.lon_index + 1, WANGSIMNI.lat_index)
    lat, lon = WANGSIMNI.centre_rad[0], east.south_west_rad[1] + 1e-12
    assert TileId.from_geodetic(lat, lon) == east
    ix, _, _ = VoxelGrid.of(east).unravel(VoxelGrid.of(east).voxel_of(lat, lon, 0.0))
    assert int(ix) == 0


def test_the_worked_example_of_the_frames_document() -> None:
    lat, lon, height = np.radians(37.56), np.radians(127.0364), 31.27
    grid = VoxelGrid.of(TileId.from_geodetic(lat, lon))
    voxel_id = grid.voxel_of(lat, lon, height)
    assert (grid.tile, int(voxel_id)) == (WANGSIMNI, 37381)
    assert tuple(map(int, grid.unravel(voxel_id))) == (10, 16, 31)
    d = grid.frame.enu_from_geodetic(lat, lon, height) - grid.centre_m(voxel_id)
    assert d == pytest.approx([-0.149, 0.238, -0.230], abs=6e-4)
    frame = GridFrame.around(LocalFrame(lat, lon, height), [WANGSIMNI])
    assert frame.grid_of_voxel(WANGSIMNI, [37381]).tolist() == [[27723558, 14490271, 31]]


def test_positions_outside_the_tile_are_refused() -> None:
    south, west = WANGSIMNI.south_west_rad
    with pytest.raises(TileError, match="latitude"):
        VoxelGrid.of(WANGSIMNI).voxel_of(south - 1e-7, west + 1e-7, 0.0)
    with pytest.raises(TileError, match="longitude"):
        VoxelGrid.of(WANGSIMNI).voxel_of(south + 1e-7, west - 1e-7, 0.0)


def test_columns_and_heights_that_do_not_exist_are_refused() -> None:
    grid = VoxelGrid.of(WANGSIMNI)
    with pytest.raises(TileError, match="ix: 31"):
        grid.voxel_id(31, 0, 0)
    with pytest.raises(TileError, match="floor"):
        grid.voxel_of(*WANGSIMNI.centre_rad, 2e5)


def test_divisions_of_one_latitude_are_those_of_the_table() -> None:
    nx, ny = divisions(WANGSIMNI.lat_index)
    assert (int(nx), int(ny)) == (31, 39)


# --- the grid of a stretch of road -----------------------------------------------------------------------------------


@given(tiles, st.integers(0, 10**6), st.integers(-100, 3_000), fractions, fractions, fractions)
def test_the_frame_finds_the_voxel_that_the_tile_finds(
    tile: TileId, cell: int, floor: int, x: float, y: float, z: float
) -> None:
    grid, frame = VoxelGrid.of(tile), _frame_at(tile)
    iy, ix = divmod(cell % (grid.nx * grid.ny), grid.nx)
    u, v = tile.lon_index + (ix + x) / grid.nx, tile.lat_index + (iy + y) / grid.ny
    p_map = frame.frame.enu_from_geodetic(*geodetic_of_tile_coordinates(u, v), floor + z)
    g = frame.grid_of(p_map[None, :])
    voxel_id = grid.voxel_id(ix, iy, floor)
    morton, found = frame.tile_voxel_of(np.floor(g).astype(np.int64))
    assert (int(morton[0]), int(found[0])) == (tile.morton, int(voxel_id))
    assert (frame.grid_of_voxel(tile, found) == np.floor(g)).all()
    np.testing.assert_allclose(frame.map_of_grid(g)[0], p_map, rtol=0, atol=1e-7)


@pytest.mark.parametrize("tile", PLACES)
def test_centres_of_frame_and_tile_are_the_same_points(tile: TileId) -> None:
    grid, frame = VoxelGrid.of(tile), _frame_at(tile)
    voxel_id = np.arange(-grid.nx, 3 * grid.nx, dtype=np.int32)
    in_map = frame.centre_map_m(frame.grid_of_voxel(tile, voxel_id))
    in_tile = frame.frame.enu_from_ecef(grid.frame.ecef_from_enu(grid.centre_m(voxel_id)))
    np.testing.assert_allclose(in_map, in_tile, rtol=0, atol=2e-8)


def test_the_grid_runs_on_over_the_date_line() -> None:
    frame = GridFrame.around(LocalFrame.of_tile(DATE_LINE_WEST), [DATE_LINE_WEST, DATE_LINE_EAST])
    east = frame.frame.enu_from_geodetic(*DATE_LINE_EAST.centre_rad, 0.5)
    points = np.linspace(0.0, 1.0, 200)[:, None] * east
    gx = frame.grid_of(points)[:, 0]
    assert (np.diff(gx) > 0).all()
    assert np.ptp(np.diff(gx)) < 1e-6
    assert gx[-1] > LON_TILES * frame.nx
    morton, voxel_id = frame.tile_voxel_of(np.floor(frame.grid_of(points)).astype(np.int64))
    assert set(morton.tolist()) == {DATE_LINE_WEST.morton, DATE_LINE_EAST.morton}
    back = frame.grid_of_voxel(DATE_LINE_EAST, voxel_id[morton == DATE_LINE_EAST.morton])
    assert (back == np.floor(frame.grid_of(points[morton == DATE_LINE_EAST.morton]))).all()
    assert (morton == morton_of(*frame.frame.geodetic_from_enu(points)[:2])).all()


@given(st.floats(-49.0, 49.0), st.tuples(*[st.floats(-1.0, 1.0)] * 3))
def test_the_affine_map_is_tangent_and_within_its_bound(lat_deg: float, direction: tuple[float, float, float]) -> None:
    tile = TileId.from_geodetic(np.radians(lat_deg), 0.2)
    frame = _frame_at(tile)
    p = np.array([300.0, -500.0, 4.0])
    A, b = frame.affine(p)
    np.testing.assert_allclose(A @ p + b, frame.grid_of(p[None, :])[0], rtol=0, atol=2e-8)
    d = 100.0 * np.array(direction) / max(1.0, float(np.linalg.norm(direction)))
    error = A @ (p + d) + b - frame.grid_of((p + d)[None, :])[0]
    bound = 1e-6 + 1.02 * 100.0**2 / (2.0 * 6.35e6 * np.cos(np.radians(lat_deg)))
    assert np.abs(error * frame.metres_per_step(frame.grid_of(p[None, :])[0])).max() <= bound


def test_where_the_paper_drove_the_affine_map_is_within_a_millimetre_at_100_m() -> None:
    frame = _frame_at(WANGSIMNI)
    A, b = frame.affine(np.zeros(3))
    direction = np.random.default_rng(3).normal(size=(5_000, 3))
    p = 100.0 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    error = (p @ A.T + b - frame.grid_of(p)) * frame.metres_per_step(frame.grid_of(p))
    assert np.abs(error).max() < 1e-3


@pytest.mark.parametrize("lat_deg", [0.0, -33.0, 37.56, 49.0, 70.0, 79.0])
@pytest.mark.parametrize("offset_m", [0.0, 5_000.0])
def test_the_fast_grid_is_the_exact_grid(lat_deg: float, offset_m: float) -> None:
    frame = _frame_at(TileId.from_geodetic(np.radians(lat_deg), 1.0))
    rng = np.random.default_rng(5)
    points = rng.uniform(-1.0, 1.0, (2_000, 3)) * RADIUS_M / np.sqrt(3.0) + offset_m * np.array([0.6, 0.8, 0.0])
    np.testing.assert_allclose(grid_near(frame, points), frame.grid_of(points), rtol=0, atol=3e-6)


def test_the_fast_grid_hands_wide_clouds_to_the_exact_one() -> None:
    frame = _frame_at(WANGSIMNI)
    points = np.array([[-4_000.0, 0.0, 0.0], [4_000.0, 3_000.0, 10.0]])
    np.testing.assert_array_equal(grid_near(frame, points), frame.grid_of(points))
    assert grid_near(frame, np.empty((0, 3))).shape == (0, 3)


def test_tiles_of_two_kinds_do_not_share_a_frame() -> None:
    with pytest.raises(TileError, match=r"31 x 39 in 1 tiles.*zones"):
        GridFrame.around(LocalFrame.of_tile(WANGSIMNI), [WANGSIMNI, KARLSRUHE])
    with pytest.raises(TileError, match="no tiles"):
        GridFrame.around(LocalFrame.of_tile(WANGSIMNI), [])


def test_a_frame_does_not_reach_around_the_equator() -> None:
    opposite = TileId.from_indices(WANGSIMNI.lon_index, LAT_TILES - 1 - WANGSIMNI.lat_index)
    assert VoxelGrid.of(opposite).nx == VoxelGrid.of(WANGSIMNI).nx
    with pytest.raises(TileError, match="latitude index of the tiles"):
        GridFrame.around(LocalFrame.of_tile(WANGSIMNI), [WANGSIMNI, opposite])


def test_zones_group_tiles_by_their_grid() -> None:
    near = covering_circle(*WANGSIMNI.centre_rad, 100.0)
    assert zones([*near, KARLSRUHE]) == {(26, 39): (KARLSRUHE,), (31, 39): near}


def test_a_frame_knows_the_band_where_its_grid_holds() -> None:
    first, last = _frame_at(WANGSIMNI).lat_index_range
    assert first < WANGSIMNI.lat_index < last
    for inside in (first, last):
        assert tuple(map(int, divisions(inside))) == (31, 39)
    for outside in (first - 1, last + 1):
        assert tuple(map(int, divisions(outside))) != (31, 39)


def test_voxels_of_other_bands_are_refused() -> None:
    frame = _frame_at(WANGSIMNI)
    _, last = frame.lat_index_range
    with pytest.raises(TileError, match="latitude index"):
        frame.tile_voxel_of(np.array([[0, (last + 1) * frame.ny, 0]]))
    with pytest.raises(TileError, match="26 x 39"):
        frame.grid_of_voxel(KARLSRUHE, np.array([0]))


def test_points_must_be_finite_triples() -> None:
    with pytest.raises(ShapeError, match="not finite"):
        _frame_at(WANGSIMNI).grid_of(np.array([[0.0, np.nan, 0.0]]))
    with pytest.raises(ShapeError, match="shape"):
        _frame_at(WANGSIMNI).grid_of(np.zeros((3, 2)))
