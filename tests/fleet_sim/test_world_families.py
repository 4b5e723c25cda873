"""Families of worlds: a seed gives the same bits, nothing stands in the way, and the truth is what was built."""

import hashlib
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest
from click.testing import CliRunner
from plain_caster import plain_range
from sim_worlds import BOTH, COARSE, small_world, thing

from gnd.deploy.cli import gnd
from gnd.fleet_sim import parts
from gnd.fleet_sim.camera import SignCamera
from gnd.fleet_sim.cars import Stays, parked_cars
from gnd.fleet_sim.dense_scan import ScanPlan
from gnd.fleet_sim.drives import PERFECT, DriveConfig, DriveSimulation
from gnd.fleet_sim.errors import WorldError
from gnd.fleet_sim.evaluate import evaluate, false_elsewhere
from gnd.fleet_sim.families.catalogue import FAMILIES
from gnd.fleet_sim.families.names import FAMILY_NAMES, RESERVED
from gnd.fleet_sim.feature_truth import feature_truth
from gnd.fleet_sim.parking import centres_street_m, near_lanes, on_parking
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.shapes import Ball, Post
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.traffic import Traffic
from gnd.fleet_sim.truth import CHANGES, make_truth
from gnd.fleet_sim.world import STATES, World, WorldObject, from_json, to_json
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import Scan

HARDER = tuple(name for name in FAMILY_NAMES if name != "street")
SPARSE = ScanPlan(spacing_m=5.0, step_rad=np.radians(0.9))
PINNED = {
    "suburb": "aa307a8607871b78",
    "avenue": "d2eab3c4fc8a0014",
    "motorway": "726e4b6fc85dc73b",
    "snow": "51137ca4f8d27159",
    "car_park": "e7102b1a814f100e",
    "construction": "6eb4e1d38d0d033e",
    "roundabout": "21a1015061c2ce36",
    "tunnel": "22c27c6914276ffd",
}


@lru_cache
def place(family: str, seed: int = 3, edit_share: float = 1.0) -> World:
    return street(seed, StreetOptions(100.0, family=family, edit_share=edit_share))


def test_the_catalogue_holds_every_name() -> None:
    assert tuple(FAMILIES) == FAMILY_NAMES
    assert set(RESERVED) < set(FAMILY_NAMES)
    with pytest.raises(WorldError, match="unknown family 'mars'"):
        StreetOptions(family="mars")
    with pytest.raises(WorldError, match=r"parking must be in 0 … 1, got 1\.5"):
        StreetOptions(parking=1.5)


@pytest.mark.parametrize("family", HARDER)
def test_a_seed_gives_the_same_bits(family: str) -> None:
    """Figures of docs/evaluation.md refer to these worlds; whoever changes a family changes them, and this table."""
    text = to_json(place(family))
    assert to_json(street(3, StreetOptions(100.0, family=family))) == text
    assert from_json(text) == place(family)
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == PINNED[family]
    assert to_json(street(4, StreetOptions(100.0, family=family))) != text


@pytest.mark.parametrize("family", HARDER)
@pytest.mark.parametrize("seed", range(3))
def test_nothing_stands_where_vehicles_drive(family: str, seed: int) -> None:
    world = place(family, seed)
    for o in world.objects:
        for shape in o.shapes:
            x0, y0, x1, y1, top = shape.bounds()
            x = np.linspace(x0, x1, 9)
            lane = world.lane_m(x)[0]
            ground = world.relief_m(x)
            low = (shape.z_m - shape.radius_m if isinstance(shape, Ball) else shape.bottom_m) - ground.max()
            if o.kind in ("road", "ground", "pavement") or low >= 4.0 or top - ground.min() <= 0.25:
                continue
            for side in (1, -1):
                assert not ((y0 < side * lane + 1.2) & (y1 > side * lane - 1.2)).any(), (o.name, shape)


@pytest.mark.parametrize("family", HARDER)
def test_both_states_differ_in_the_edits_only(family: str) -> None:
    world = place(family)
    kept = [o for o in world.objects if o.edit == "kept"]
    assert all(o in world.in_state(state) for o in kept for state in STATES)
    edits = {o.edit for o in world.objects}
    assert {"kept", "added", "removed"} <= edits
    assert ("seasonal" in edits) == (family in ("avenue", "snow"))
    untouched = place(family, edit_share=0.0)
    assert {o.edit for o in untouched.objects} <= {"kept", "seasonal"}


@pytest.mark.parametrize("family", HARDER)
def test_rays_end_on_the_surfaces_that_stand_there(family: str) -> None:
    """Against the plain caster, which tries every primitive and formulates each in another way."""
    world, rng = place(family), np.random.default_rng(1)
    for state in STATES:
        shapes = world.shapes(state)
        near = [shape for shape in shapes if abs(shape.x_m) < 25.0 or not isinstance(shape, Ball | Post)][:1500]
        scene = Scene.build(near)
        x = rng.uniform(-15.0, 15.0, 12)
        y = -world.lane_m(x)[0]
        eye = np.stack([x, y, world.road_height_m(y, x) + 1.9], axis=1)
        aim = rng.normal(size=(12, 3)) * np.array([1.0, 1.0, 0.2])
        aim /= np.linalg.norm(aim, axis=1, keepdims=True)
        ranges, index = scene.cast(eye, aim, 60.0)
        for k in range(len(eye)):
            assert ranges[k] == pytest.approx(plain_range(near, eye[k], aim[k], 60.0), abs=1e-7)
            if index[k] >= 0:
                assert plain_range([near[index[k]]], eye[k], aim[k], 60.0) == pytest.approx(ranges[k], abs=1e-7)


@pytest.mark.parametrize("family", HARDER)
def test_changes_lie_where_something_was_changed(family: str) -> None:
    """What is gone or altered touches something that was edited; only what a vanished thing reveals lies elsewhere."""
    world = place(family)
    truth = make_truth(world, plan=SPARSE)
    assert min(truth.counts("all")[name] for name in ("new", "modified", "deleted")) >= 5
    edited = [o for o in world.objects if o.edit not in ("kept", "seasonal")]
    boxes = np.array([_box(o) for o in edited])
    for tile in np.unique(truth.morton).tolist():
        inside = truth.morton == tile
        centres = centres_street_m(world, TileId(int(tile)), truth.voxel_id[inside])
        changed = np.isin(truth.change_class[inside], (ChangeClass.MODIFIED, ChangeClass.DELETED))
        for centre in centres[changed]:
            away = np.maximum(np.maximum(boxes[:, 0:3] - centre, centre - boxes[:, 3:6]), 0.0).max(axis=1)
            assert away.min() <= 0.95, centre


def _box(o: WorldObject) -> tuple[float, ...]:
    bounds = np.array([shape.bounds() for shape in o.shapes])
    low = min(s.z_m - s.radius_m if isinstance(s, Ball) else s.bottom_m for s in o.shapes)
    return (*bounds[:, 0:2].min(axis=0), low, *bounds[:, 2:4].max(axis=0), float(bounds[:, 4].max()))


def leafy(state: str) -> World:
    """Two bundles of leaves of one state before a wall that stays."""
    rng = np.random.default_rng(0)
    tufts = [Ball(x, 7.0, z, 0.25) for x, z in zip(rng.uniform(-4, 4, 60), rng.uniform(0.5, 3.0, 60), strict=True)]
    leaves = WorldObject("leaves", "leaves", (state,), "seasonal", tuple(tufts))  # type: ignore[arg-type]
    return small_world(thing("wall", BOTH, "kept", parts.slab(-9, 9, 9.0, 9.3, -0.2, 3.0)), leaves)


def test_fallen_leaves_change_no_map_and_whoever_deletes_them_is_wrong() -> None:
    world = leafy("before")
    truth = make_truth(world, plan=COARSE)
    counts = truth.counts("all")
    assert counts["deleted"] == counts["modified"] == 0
    of_leaves = truth.seasonal & (truth.change_class == ChangeClass.NORMAL)
    assert of_leaves.sum() > 10
    assert (truth.seasonal & truth.observable & (truth.change_class == ChangeClass.NORMAL)).sum() > 5
    predicted = truth.change_class.copy()
    predicted[of_leaves & truth.observable] = ChangeClass.DELETED
    right, wrong = evaluate(truth, truth.change_class), evaluate(truth, predicted)
    assert wrong.scores["observable"].false_changes["deleted"] == (of_leaves & truth.observable).sum()
    assert right.scores["observable"].false_changes == {"new": 0, "modified": 0, "deleted": 0}
    assert wrong.f1() < right.f1()


def test_leaves_that_came_are_nothing_and_whoever_adds_them_is_wrong() -> None:
    truth = make_truth(leafy("after"), plan=COARSE)
    assert truth.counts("all")["new"] == truth.counts("all")["deleted"] == truth.counts("all")["modified"] == 0
    assert (truth.seasonal & (truth.change_class == ChangeClass.EMPTY)).sum() > 10


def test_a_street_without_leaves_or_snow_has_nothing_seasonal() -> None:
    assert not make_truth(place("tunnel"), plan=SPARSE).seasonal.any()


def test_ground_of_a_hill_is_where_the_vehicle_drives() -> None:
    world = place("suburb")
    scene = Scene.build(world.shapes("after"))
    x = np.linspace(-45.0, 45.0, 181)
    for side in (1, -1):
        y = np.full_like(x, side * world.lane_offset_m)
        height = world.road_height_m(y, x)
        ranges, _ = scene.cast(np.stack([x, y, height + 2.0], axis=1), np.tile([0.0, 0.0, -1.0], (len(x), 1)), 9.0)
        np.testing.assert_allclose(ranges, 2.0, atol=2e-3)
    assert np.ptp(world.relief_m(x)) > 1.0
    assert all(b[0] > a[0] for a, b in pairwise(world.relief))


@pytest.mark.parametrize("family", ["roundabout", "suburb", "motorway"])
def test_a_drive_follows_its_lane_and_its_wheels_roll(family: str) -> None:
    """Wheel speed is that of the path in space: the vehicle neither slides nor jumps."""
    world = place(family)
    simulation = DriveSimulation(world, DriveConfig("car", "VLP-16", errors=PERFECT, scans=5, car_share=0.0))
    t = np.linspace(0.5, 2.0, 200)
    T = simulation.motion.T_map_vehicle(t)
    speed, _ = simulation.motion.speed_and_yaw_rate(t)
    way = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(way / np.diff(t), 0.5 * (speed[1:] + speed[:-1]), rtol=0.01)
    across = np.abs(np.einsum("kij,kj->ki", np.swapaxes(T[:-1, :3, :3], 1, 2), np.diff(T[:, :3, 3], axis=0))[:, 1])
    assert (across / way).max() < 0.03
    x, y, _ = simulation.motion.on_path(t)
    assert np.abs(-y - world.lane_m(x)[0]).max() < 0.25


def test_lanes_of_a_roundabout_swing_around_its_island() -> None:
    world = place("roundabout")
    offset, widening = world.lane_m(np.array([-40.0, 0.0, 40.0]))
    assert offset.tolist() == pytest.approx([1.75, 10.75, 1.75])
    x = np.linspace(-30.0, 30.0, 601)
    offset, widening = world.lane_m(x)
    np.testing.assert_allclose(np.gradient(offset, x)[1:-1], widening[1:-1], atol=0.02)


def test_cars_that_stay_are_met_again_and_leave_in_time() -> None:
    world = street(5, StreetOptions(400.0))

    def cars(at_h: float, seed: int) -> set[object]:
        return set(parked_cars(world, "after", 0.35, seed, Stays(2.0, at_h)))

    now = cars(3.0, 1)
    assert now == cars(3.0, 2), "whoever drives, the same cars stand there"
    same = [len(now & cars(3.0 + later_h, 1)) / len(now) for later_h in (0.1, 2.0, 20.0)]
    assert same[0] > 0.85
    assert 0.2 < same[1] < 0.6  # exp(-1) of them
    assert same[2] < 0.05
    slots = [Stays(2.0, at).chance(world.seed, slot, 0.35)[0] for slot in range(400) for at in (1.0, 30.0)]
    assert np.mean(slots) == pytest.approx(0.35, abs=0.06)


def test_bays_of_a_car_park_are_taken_anew_by_every_drive() -> None:
    world = place("car_park")
    first, second = (set(parked_cars(world, "after", 0.6, seed)) for seed in (1, 2))
    assert len(first) > 100
    assert not first & second
    truth = make_truth(world, plan=SPARSE)
    parking = on_parking(world, truth)
    assert 0.005 < parking.mean() < 0.3


def test_voxels_that_no_ray_of_the_truth_touched_are_counted_near_the_lanes_only() -> None:
    world = leafy("before")
    truth = make_truth(world, plan=COARSE)
    tile = max(truth.before, key=lambda t: len(truth.before[t]))
    old = truth.before[tile]
    inside = truth.voxel_id[truth.morton == tile.morton]
    unknown = np.setdiff1d(np.arange(60000, dtype=np.int32), inside)
    near = unknown[near_lanes(world, tile, unknown)][:3]
    made = type(old)(
        near, *(np.repeat(column[:1], len(near), axis=0) for column in (old.count, old.cells, old.mean_m, old.cov_m2))
    )
    found = false_elsewhere(truth, {tile: old}, {tile: made}, lambda t, v: near_lanes(world, t, v))
    assert found == len(near) == 3
    assert false_elsewhere(truth, {tile: old}, {tile: old}, lambda t, v: near_lanes(world, t, v)) == 0


@pytest.mark.parametrize("family", HARDER)
def test_feature_layers_and_cameras_work_in_every_family(family: str) -> None:
    world = place(family)
    assert feature_truth(world).of("signs")
    config = DriveConfig("car", "VLP-16", scans=2, camera=SignCamera(), traffic=Traffic.urban())
    items = list(DriveSimulation(world, config).items())
    assert sum(isinstance(item, Scan) for item in items) == 2
    assert all(len(item.points_m) > 5000 for item in items if isinstance(item, Scan))


def test_family_and_parking_are_options_of_the_command(tmp_path) -> None:
    file = tmp_path / "world.json"
    ran = CliRunner().invoke(
        gnd, ["sim", "world", "write", str(file), "--family", "tunnel", "--parking", "0.6", "--length", "100"]
    )
    assert ran.exit_code == 0, ran.output
    world = from_json(file.read_text())
    assert (world.family, world.parking) == ("tunnel", 0.6)
    assert set(CHANGES) == {ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED}
