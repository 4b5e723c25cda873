"""The rays of the dense scan beside one scene of everything; truths at all sites, and where two grids meet."""

from dataclasses import replace
from math import degrees, pi, radians
from pathlib import Path

import numpy as np
import pytest
from sim_worlds import BOTH, COARSE, small_world, thing

import gnd.fleet_sim.dense_scan
from gnd.fleet_sim import parts
from gnd.fleet_sim.dense_rays import AFTER_COME, AFTER_KEPT, BEFORE_GONE, BEFORE_KEPT, ScanPlan, shots
from gnd.fleet_sim.dense_scan import dense_scan, dense_scans, world_grid, world_grids
from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.errors import TruthError
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.street import SITES, SiteName, StreetOptions, street
from gnd.fleet_sim.truth import Truth, grid_of, grids_of, make_truth, read_truth, write_truth
from gnd.fleet_sim.world import STATES, World
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile_id import TILE_RAD, TileId
from gnd.schemas.drive_mcap import load_track, read_header

SPARSE = ScanPlan(spacing_m=12.0, step_rad=radians(0.8))
BAND_LAT_RAD = (world_grid(small_world()).lat_index_range[1] + 1) * TILE_RAD - pi / 2
"""North of Seoul, at 38.377°, tiles go from 31 to 30 columns of voxels."""


def flags_of(world: World, state: str) -> list[int]:
    """The flag of each primitive of a state, and 0 for a miss."""
    kept, changed = {"before": (BEFORE_KEPT, BEFORE_GONE), "after": (AFTER_KEPT, AFTER_COME)}[state]
    objects = [o for o in world.objects if state in o.states]
    return [*(kept if len(o.states) == 2 else changed for o in objects for _ in o.shapes), 0]


@pytest.mark.parametrize("seed", [1, 2])
def test_rays_end_where_they_meet_one_scene_of_everything(seed: int) -> None:
    world = street(seed, StreetOptions(length_m=100.0))
    scenes = [Scene.build(world.shapes(state), world.A_street_map) for state in STATES]
    for each in shots(world, SPARSE):
        way = each.ends - each.origin
        far = np.linalg.norm(way, axis=1)
        ranges, index = scenes[each.state].cast(each.origin, way / far[:, None], SPARSE.range_m)
        agree = np.isclose(far, np.minimum(ranges, SPARSE.range_m), atol=1e-9)
        flags = np.array(flags_of(world, STATES[each.state]))[index]
        assert np.mean(agree & (flags == each.flags)) > 0.9999, "an edge may be met or missed by a rounding error"


def test_rays_that_meet_a_kept_thing_in_both_states_end_in_one_point(edited_world: World) -> None:
    both = list(shots(edited_world, SPARSE))
    for before, after in zip(both[::2], both[1::2], strict=True):
        same = (before.flags == BEFORE_KEPT) & (after.flags == AFTER_KEPT)
        assert same.sum() > 1000
        np.testing.assert_array_equal(before.ends[same], after.ends[same])
        assert not before.fresh[same].any()
        assert before.fresh[before.flags == BEFORE_GONE].all()
        assert after.fresh.all()


def test_a_table_that_grows_gives_the_same_scan(edited_world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    large = dense_scan(edited_world, SPARSE)
    monkeypatch.setattr(gnd.fleet_sim.dense_scan, "_FIRST_VOXELS", 64)
    small = dense_scan(edited_world, SPARSE)
    for name in ("g", "cells", "row", "passes", "unexplained", "shell"):
        np.testing.assert_array_equal(getattr(small, name), getattr(large, name))
    monkeypatch.setattr(gnd.fleet_sim.dense_scan, "_MAX_VOXELS", 128)
    with pytest.raises(TruthError, match="more than 128 voxels"):
        dense_scan(edited_world, SPARSE)


@pytest.mark.parametrize("site", SITES)
def test_there_is_a_truth_at_every_site(site: SiteName) -> None:
    world = street(1, StreetOptions(100.0, site))
    truth = make_truth(world, plan=SPARSE)
    counts = truth.counts("all")
    assert min(counts.values()) > 50
    assert {VoxelGrid.of(tile).nx for tile in truth.after} == {26 if site == "north49" else 31}


@pytest.mark.parametrize(
    "options",
    [
        *(StreetOptions(100.0, site) for site in SITES),
        StreetOptions(100.0, lat_deg=degrees(BAND_LAT_RAD), lon_deg=179.9999),
    ],
    ids=[*SITES, "across a zone and the date line"],
)
def test_a_drive_can_be_simulated_at_every_site(options: StreetOptions, tmp_path: Path) -> None:
    world = street(4, options)
    config = DriveConfig("v", "VLP-16", scans=2, errors=PERFECT)
    path = simulate_drive(world, config, tmp_path / "drive.mcap")
    assert read_header(path).anchor == world.frame
    gnss = load_track(path).gnss
    places = world.street_of_map(world.frame.enu_from_geodetic(gnss.lat_rad, gnss.lon_rad, gnss.height_m))
    assert np.all(np.abs(places[:, 0]) < world.half_length_m)
    np.testing.assert_allclose(places[:, 1], -world.lane_offset_m, atol=0.3)


@pytest.fixture(scope="module")
def two_zones() -> World:
    """A wall that stays and one that goes on either side of the border of two zones of latitude."""
    walls = [(x, y) for x in (-10.0, 6.0) for y in (8.0, -8.0)]
    things = [
        thing(f"{y:+.0f} {x:+.0f}", BOTH if y > 0 else ("before",), "kept" if y > 0 else "removed", wall)
        for x, y in walls
        for wall in [parts.slab(x - 3, x + 3, y - 0.15, y + 0.15, -0.2, 3.0)]
    ]
    return replace(small_world(*things), lat_rad=BAND_LAT_RAD, heading_rad=1.5)


def test_a_street_in_two_zones_of_latitude_has_one_truth(two_zones: World, tmp_path: Path) -> None:
    assert sorted(grid.nx for grid in world_grids(two_zones)) == [30, 31]
    truth = make_truth(two_zones, plan=COARSE)
    keys = list(zip(truth.morton.tolist(), truth.voxel_id.tolist(), strict=True))
    assert keys == sorted(set(keys))
    by_zone = {nx: [t for t in truth.after if VoxelGrid.of(t).nx == nx] for nx in (30, 31)}
    for tiles in by_zone.values():
        mine = truth.clear & np.isin(truth.morton, [tile.morton for tile in tiles])
        found = np.bincount(truth.change_class[mine], minlength=5)
        assert found[0] > 100
        assert found[3] >= 5, "of the wall that goes"
    assert sorted(grid.nx for grid in grids_of(truth)) == [30, 31]
    with pytest.raises(TruthError, match="2 zones"):
        grid_of(truth)
    write_truth(truth, tmp_path / "truth.npz")
    assert read_truth(tmp_path / "truth.npz").before == truth.before


def test_no_point_is_lost_or_doubled_where_two_zones_meet(two_zones: World) -> None:
    """Every ray before that meets something lands in exactly one of the two grids."""
    scans = dense_scans(two_zones, SPARSE)
    counted = sum(int(scan.before.moments()[1].count.sum()) for scan in scans)
    hits = sum(int(np.count_nonzero(each.flags)) for each in shots(two_zones, SPARSE) if each.state == 0)
    assert counted == hits
    assert all(len(scan.before) > 100 for scan in scans)


def test_what_needs_one_grid_refuses_two_zones(two_zones: World) -> None:
    with pytest.raises(TruthError, match="2 zones"):
        world_grid(two_zones)
    with pytest.raises(TruthError, match="2 zones"):
        dense_scan(two_zones, SPARSE)


def test_tiles_of_a_street_across_the_date_line_are_neighbours() -> None:
    truth = make_truth(street(1, StreetOptions(100.0, lat_deg=0.001, lon_deg=179.99999)), plan=SPARSE)
    lon_index = {TileId(int(code)).lon_index for code in np.unique(truth.morton)}
    assert {0, 2**20 - 1} <= lon_index
    assert lon_index <= {i % 2**20 for i in range(-5, 6)}


def test_the_truth_of_a_long_street_has_every_class_all_along() -> None:
    world = street(1, StreetOptions(400.0, "wangsimni"))
    truth = make_truth(world, plan=ScanPlan(spacing_m=16.0, step_rad=radians(0.7)))
    centre = world.street_of_map(grid_of(truth).centre_map_m(all_g(truth)))
    for x0 in np.arange(-200.0, 200.0, 100.0):
        here = (centre[:, 0] >= x0) & (centre[:, 0] < x0 + 100.0)
        assert np.bincount(truth.change_class[here], minlength=5).min() > 20, f"from {x0:.0f} m"


def all_g(truth: Truth) -> np.ndarray:
    """Grid coordinates (V, 3) of all voxels of a truth in one zone."""
    grid = grid_of(truth)
    rows = [(tile, truth.voxel_id[truth.morton == tile.morton]) for tile in grid.tiles]
    return np.concatenate([grid.grid_of_voxel(tile, voxel_id) for tile, voxel_id in rows])
