"""Change detection over scans of a small place with known changes."""

from dataclasses import replace

import numpy as np
import pytest
from vehicle_scene import FIGURE_2, GRID_FRAME, HEIGHT_M, SENSOR, ground, look, tiles_of, wall

from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.errors import ShapeError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.detect.classify import classify
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.detect.evidence import TileEvidence
from gnd.vehicle_agent.detect.parameters import MEASURED_RULES, DetectParameters
from gnd.vehicle_agent.errors import MapChanged
from gnd.vehicle_agent.local_map import LocalMap

NEAR, FAR = (9.3, -8.0, 8.0, 4.0), (14.3, -8.0, 8.0, 4.0)
MODES = {"default": DetectParameters(), "paper": DetectParameters.paper()}


@pytest.fixture(scope="module")
def tiles() -> dict[TileId, Tile]:
    return tiles_of(np.concatenate([ground(), wall(9.3)]))


def hold(tiles: dict[TileId, Tile]) -> LocalMap:
    local_map = LocalMap(GRID_FRAME)
    for tile in tiles.values():
        local_map.set_tile(tile)
    return local_map


def scans(walls: list[tuple[float, float, float, float]], n: int = 4, seed: int = 7) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [look(walls, rng) for _ in range(n)]


def detect(
    local_map: LocalMap, hits: list[np.ndarray], p: DetectParameters | None = None
) -> dict[TileId, TileEvidence]:
    detector = ChangeDetector(local_map, p)
    for points in hits:
        detector.add_scan(points, SENSOR)
    return detector.finish(local_map.tiles)


def classes(evidence: dict[TileId, TileEvidence], p: DetectParameters) -> dict[tuple[TileId, int], ChangeClass]:
    return {
        (tile_id, int(voxel)): ChangeClass(int(c))
        for tile_id, e in evidence.items()
        for voxel, c in zip(e.voxel_id, classify(e, p).change_class, strict=True)
    }


def voxels_of(points: np.ndarray) -> set[tuple[TileId, int]]:
    return {(t, int(v)) for t, tile in tiles_of(points).items() for v in tile.gaussians.voxel_id}


def shares(found: dict[tuple[TileId, int], ChangeClass], voxels: set[tuple[TileId, int]]) -> dict[str, float]:
    said = [found.get(v, ChangeClass.UNMEASURED).name for v in voxels]
    return {name: said.count(name) / len(said) for name in set(said)}


@pytest.mark.parametrize("mode", MODES)
def test_an_unchanged_place_stays_normal(tiles: dict[TileId, Tile], mode: str) -> None:
    found = classes(detect(hold(tiles), scans([NEAR]), MODES[mode]), MODES[mode])
    wrong = [v for v, c in found.items() if c in (ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED)]
    limit = 0.005 if mode == "default" else 0.06
    assert len(wrong) <= limit * sum(len(t.gaussians) for t in tiles.values())
    assert shares(found, voxels_of(wall(9.3, -6, 6, 3)))["NORMAL"] > 0.97


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("rule", ["ml", "ahead", "plane"])
def test_a_wall_that_is_gone_is_deleted_and_what_stood_behind_it_is_new(
    tiles: dict[TileId, Tile], mode: str, rule: str
) -> None:
    p = replace(MODES[mode], own_rules=replace(MODES[mode].rules, passing_rule=rule))
    found = classes(detect(hold(tiles), scans([FAR]), p), p)
    assert shares(found, voxels_of(wall(9.3, -5, 5, 2.4)))["DELETED"] > 0.8
    assert shares(found, voxels_of(wall(14.3, -6, 6, 2.4)))["NEW"] > 0.9


def test_a_wall_that_moved_within_its_voxels_is_modified(tiles: dict[TileId, Tile]) -> None:
    g = GRID_FRAME.grid_of(np.array([[9.3, 0.0, HEIGHT_M + 2]]))[0, 0] % 1
    moved = (9.3 + (0.45 if g < 0.5 else -0.45), -8.0, 8.0, 4.0)
    p = DetectParameters()
    found = classes(detect(hold(tiles), scans([moved]), p), p)
    assert shares(found, voxels_of(wall(9.3, -5, 5, 2.4)))["MODIFIED"] > 0.9


def test_what_lies_behind_the_wall_is_not_observed(tiles: dict[TileId, Tile]) -> None:
    p = DetectParameters()
    found = classes(detect(hold(tiles), scans([NEAR]), p), p)
    hidden = ground()
    hidden = hidden[(hidden[:, 0] > 12) & (hidden[:, 0] < 16) & (np.abs(hidden[:, 1]) < 3)]
    assert shares(found, voxels_of(hidden)) == {"UNMEASURED": 1.0}


def test_air_that_rays_cross_is_observed_empty(tiles: dict[TileId, Tile]) -> None:
    p = DetectParameters()
    evidence = detect(hold(tiles), scans([NEAR]), p)
    air = voxels_of(wall(4.5, -2, 2, 1.5))
    assert shares(classes(evidence, p), air) == {"EMPTY": 1.0}
    passes = {(t, int(v)): int(n) for t, e in evidence.items() for v, n in zip(e.voxel_id, e.n_pe, strict=True)}
    assert min(passes[v] for v in air) > 100


def test_the_order_of_scans_and_the_growth_of_the_map_change_nothing(tiles: dict[TileId, Tile]) -> None:
    hits = scans([FAR], n=3)
    at_once = detect(hold(tiles), hits)
    growing = LocalMap(GRID_FRAME)
    detector = ChangeDetector(growing)
    for tile_id in sorted(tiles, reverse=True):
        growing.set_tile(tiles[tile_id])
        detector.touched_tiles()  # every step makes a window of its own
    for points in hits[::-1]:
        detector.add_scan(points, np.broadcast_to(SENSOR, points.shape))
        growing.cover_floors(int(growing.window_origin_g[2]) - 1, 40)  # the window grows between the scans
    in_steps = detector.finish(growing.tiles)
    assert sorted(in_steps) == sorted(at_once)
    for tile_id, e in at_once.items():
        other = in_steps[tile_id]
        np.testing.assert_array_equal(other.voxel_id, e.voxel_id)
        np.testing.assert_array_equal(other.counters, e.counters)
        np.testing.assert_array_equal(other.n_pe, e.n_pe)
        np.testing.assert_array_equal(other.measured.count, e.measured.count)
        np.testing.assert_allclose(other.measured.mean_m, e.measured.mean_m, atol=1e-6)


def test_evidence_is_counted_once_and_only_about_tiles_that_are_held(tiles: dict[TileId, Tile]) -> None:
    local_map = hold({t: tiles[t] for t in sorted(tiles)[:2]})
    detector = ChangeDetector(local_map)
    assert detector.touched_tiles() == ()
    detector.add_scan(scans([NEAR], n=1)[0], SENSOR)
    assert detector.touched_tiles() == local_map.tiles
    first = detector.finish(detector.touched_tiles())
    assert sum(int(e.n_bi.sum()) for e in first.values()) > 100
    assert not any(detector.touched(t) for t in local_map.tiles)
    again = detector.finish(local_map.tiles)
    assert all(len(e) == 0 for e in again.values())


def test_a_tile_may_not_change_under_its_evidence(tiles: dict[TileId, Tile]) -> None:
    local_map = hold(tiles)
    detector = ChangeDetector(local_map)
    detector.add_scan(scans([NEAR], n=1)[0], SENSOR)
    touched = detector.touched_tiles()[0]
    local_map.set_tile(Tile(touched, 2, Gaussians.empty()))
    with pytest.raises(MapChanged, match=f"{touched} version 1 was replaced or removed"):
        detector.add_scan(scans([NEAR], n=1)[0], SENSOR)


def test_where_the_store_has_no_tile_everything_solid_is_new(tiles: dict[TileId, Tile]) -> None:
    local_map = LocalMap(GRID_FRAME)
    for tile_id in FIGURE_2:
        local_map.set_absent(tile_id)
    local_map.cover_floors(28, 38)
    p = DetectParameters()
    evidence = detect(local_map, scans([NEAR]), p)
    assert all(e.base.version == 0 for e in evidence.values())
    assert shares(classes(evidence, p), voxels_of(wall(9.3, -5, 5, 2.4))) == {"NEW": 1.0}


def test_points_beside_a_face_do_not_make_the_neighbour_voxel_new(tiles: dict[TileId, Tile]) -> None:
    centre = GRID_FRAME.grid_of(np.array([[9.3, 0.0, HEIGHT_M + 2.5]]))[0]
    face_x = float(GRID_FRAME.map_of_grid(np.array([[np.floor(centre[0]) + 1, centre[1], centre[2]]]))[0, 0])
    on_face = tiles_of(np.concatenate([ground(), wall(face_x - 0.02)]))
    hits = scans([(face_x + 0.03, -8.0, 8.0, 4.0)])
    beyond = voxels_of(wall(face_x + 0.03, -5, 5, 2.4))
    with_rule, without = DetectParameters(), DetectParameters(own_rules=replace(MEASURED_RULES, face_m=0.0))
    assert shares(classes(detect(hold(on_face), hits, with_rule), with_rule), beyond).get("NEW", 0.0) < 0.05
    assert shares(classes(detect(hold(on_face), hits, without), without), beyond)["NEW"] > 0.9


def test_a_scan_that_is_not_finite_or_has_no_origin_is_refused_and_nothing_counted(tiles: dict[TileId, Tile]) -> None:
    detector = ChangeDetector(hold(tiles))
    points = scans([NEAR], n=1)[0]
    with pytest.raises(ShapeError, match="origins for"):
        detector.add_scan(points, np.zeros((3, 3)))
    points[5, 1] = np.nan
    with pytest.raises(ShapeError, match="not finite"):
        detector.add_scan(points, SENSOR)
    assert detector.touched_tiles() == ()
    assert detector.add_scan(np.empty((0, 3)), SENSOR) == 0


def test_points_of_movers_are_no_hits_but_their_rays_pass(tiles: dict[TileId, Tile]) -> None:
    away = ChangeDetector(hold(tiles)), ChangeDetector(hold(tiles))
    for points in scans([FAR]):
        moving = np.ones(len(points), np.bool_)
        away[0].add_scan(points, SENSOR)
        away[1].add_scan(points, SENSOR, moving)
    plain, masked = (d.finish(d.local_map.tiles) for d in away)
    for tile_id, evidence in masked.items():
        assert not evidence.measured.count.any()
        assert evidence.n_bi.sum() == evidence.n_bo.sum() == evidence.n_be.sum() == 0
        assert evidence.n_pi.sum() == plain[tile_id].n_pi.sum()


def test_a_mask_of_movers_of_the_wrong_length_is_refused(tiles: dict[TileId, Tile]) -> None:
    detector = ChangeDetector(hold(tiles))
    with pytest.raises(ShapeError, match=r"\(3,\) for 5 points"):
        detector.add_scan(np.ones((5, 3)), SENSOR, np.zeros(3, np.bool_))
    assert detector.touched_tiles() == ()


def test_records_of_tiles_that_stay_are_those_made_anew(tiles: dict[TileId, Tile]) -> None:
    """Tiles come, one is replaced, one goes: what the window took over is what a new detector makes."""
    first, *others = sorted(tiles)
    local_map = hold({t: tiles[t] for t in others[: len(others) // 2]})
    detector = ChangeDetector(local_map)
    assert detector.touched_tiles() == ()
    for tile_id in [first, *others[len(others) // 2 :]]:
        local_map.set_tile(tiles[tile_id])
    local_map.set_tile(replace(tiles[others[0]], version=2, gaussians=tiles[others[0]].gaussians.take([0, 3, 4])))
    local_map.remove_tile(others[1])
    taken, anew = (one._current().records for one in (detector, ChangeDetector(local_map)))
    assert len(taken.words) == local_map.count > 100
    np.testing.assert_array_equal(taken.words, anew.words)
    np.testing.assert_array_equal(taken.block, anew.block)
