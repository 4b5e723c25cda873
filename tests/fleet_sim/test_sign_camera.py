"""The camera of simulated drives: it sees the signs that nothing hides, and errs as it says."""

from dataclasses import replace
from math import radians
from pathlib import Path

import numpy as np
import pytest

from gnd.fleet_sim import parts
from gnd.fleet_sim.camera import Sightings, SignCamera, looks_of, sightings
from gnd.fleet_sim.drives import DriveConfig, DriveSimulation, simulate_drive
from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.feature_truth import feature_truth
from gnd.fleet_sim.movers import Mover, Movers
from gnd.fleet_sim.prepare import agent_configs, mapping_configs
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.roads.hard_noise import HardNoise
from gnd.fleet_sim.trajectory import DrivingStyle, lane_motion
from gnd.fleet_sim.world import State, World, WorldObject
from gnd.schemas.drive import Detections, DriveItem, GnssFix, MotionSample, ReferencePose, Scan
from gnd.schemas.drive_mcap import drive_counts, read_drive
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore

BOTH: tuple[State, ...] = ("before", "after")
QUIET = SignCamera(level=1e-6, miss_rate=0.0, false_alarms=0.0, hard=None)
KIND = SignCamera(hard=None)
SHORT = DriveConfig(vehicle="v-1", sensor="VLP-16", seed=3, scans=8)
STYLE = DrivingStyle(9.0, 1.0, 2.5, 0.0, 0.5, 0.0, 0.0, 60.0, 0.0, (0.0,) * 9)


def seen_past(street_1: World, *others: WorldObject, movers: Movers | None = None) -> Sightings:
    """One sign 40 m ahead on the right, looked at from the start of the street, with other things in between."""
    x_m = -street_1.half_length_m + 2.0
    plate = parts.sign(x_m + 40.0, -6.85, 0.03, 0.9, 2.5, 0.1)
    ground = next(o for o in street_1.objects if o.name == "road -1")
    sign = WorldObject("sign", "sign", BOTH, "kept", plate)
    world = replace(street_1, objects=(ground, *others, sign))
    scene = Scene.build(world.shapes("after"), world.A_street_map, margin_m=60.0)
    motion, _ = lane_motion(world, STYLE, 1)
    return sightings(QUIET, world, "after", scene, movers, motion, np.array([0.0]))


def container_at(street_1: World, dx_m: float, y_m: float, height_m: float = 2.6) -> WorldObject:
    x_m = -street_1.half_length_m + 2.0 + dx_m
    block = parts.slab(x_m - 2.0, x_m + 2.0, y_m - 1.0, y_m + 1.0, -0.2, height_m)
    return WorldObject("container", "container", BOTH, "kept", (block,))


def test_a_sign_in_the_open_is_seen(street_1: World) -> None:
    found = seen_past(street_1)
    assert found.visible.tolist() == [[True]]
    assert found.polar[0, 0] == pytest.approx([np.hypot(40.0, 5.1), np.arctan2(-5.1, 40.0), 2.5], abs=0.2)


@pytest.mark.parametrize(
    ("dx_m", "y_m", "height_m", "visible"),
    [(20.0, -4.4, 4.0, False), (20.0, -4.4, 1.2, True), (20.0, 0.0, 4.0, True), (60.0, -6.8, 4.0, True)],
    ids=["in between", "lower than the line of sight", "beside it", "behind the sign"],
)
def test_what_stands_between_hides_a_sign(
    street_1: World, dx_m: float, y_m: float, height_m: float, visible: bool
) -> None:
    assert seen_past(street_1, container_at(street_1, dx_m, y_m, height_m)).visible.item() is visible


@pytest.mark.parametrize(("y_m", "visible"), [(-4.4, False), (1.75, True)])
def test_what_moves_between_hides_a_sign(street_1: World, y_m: float, visible: bool) -> None:
    x_m = -street_1.half_length_m + 22.0
    van = parts.slab(-2.0, 2.0, -1.0, 1.0, 0.2, 4.0)
    row = [x_m, y_m, 0.0, 0.0, 0.0]
    movers = Movers([Mover((van,), (0.0,), np.array([row, row]))], -1.0, 2.0, 500.0)
    assert seen_past(street_1, movers=movers).visible.item() is visible


def test_a_sign_may_be_seen_in_part(street_1: World) -> None:
    """Two of five rays arrive over the top of a wall as high as the middle of the plate, three over a lower one."""
    heights = (2.35, 2.6)
    seen = [seen_past(street_1, container_at(street_1, 37.0, -6.8, h)).visible.item() for h in heights]
    assert seen == [True, False]


def simulated(street_1: World, config: DriveConfig) -> DriveSimulation:
    return DriveSimulation(street_1, config)


def test_looks_are_those_of_a_camera(street_1: World) -> None:
    simulation = simulated(street_1, replace(SHORT, scans=None, camera=KIND))
    found = simulation.sightings(KIND)
    times = np.arange(len(found.visible), dtype=np.int64)
    looks = looks_of(replace(KIND, false_alarms=0.0), found, times, (3, 1))
    assert len(looks) > 250
    assert sum(map(len, looks)) / found.visible.sum() == pytest.approx(0.9, abs=0.02)
    range_m, bearing = found.polar[..., 0][found.in_view], found.polar[..., 1][found.in_view]
    assert range_m.max() <= 80.0
    assert np.abs(bearing).max() <= radians(20.0)
    assert 0.5 < found.visible.sum() / found.in_view.sum() < 1.0, "houses, trees and parked cars hide some"
    late = looks_of(replace(KIND, miss_rate=0.0, false_alarms=0.0), found, times, (3, 1))
    off = [np.sort(look.range_m) - np.sort(found.polar[k, found.visible[k], 0]) for k, look in enumerate(late)]
    assert np.concatenate(off).std() < 0.75, "sorted: at most the noise"
    noisy = looks_of(replace(QUIET, false_alarms=0.5), found, times, (3, 1))
    assert (sum(map(len, noisy)) - found.visible.sum()) / len(noisy) == pytest.approx(0.5, abs=0.15)


def test_without_noise_detections_lie_on_the_signs(street_1: World) -> None:
    simulation = simulated(street_1, replace(SHORT, camera=QUIET))
    truth = feature_truth(street_1)
    standing = np.array([f.position_map_m for f in truth.of("signs", "normal", "new")])
    looks = [item for item in simulation.items() if isinstance(item, Detections)]
    assert len(looks) == 13
    assert looks[0].layer == "signs"
    for look in looks:
        T = simulation.motion.T_map_vehicle(np.array([(look.t_ns - SHORT.start_ns) * 1e-9]))[0]
        places = np.column_stack(
            [look.range_m * np.cos(look.bearing_rad), look.range_m * np.sin(look.bearing_rad), look.height_m]
        )
        away = np.linalg.norm((places @ T[:3, :3].T + T[:3, 3])[:, None] - standing[None], axis=2).min(axis=1)
        assert len(look) >= 2
        assert away.max() < 0.01


ONLY_HELD = HardNoise(
    **dict.fromkeys(("yaw_rad", "range_share", "pitch_rad", "white_ln_sigma", "miss_near", "miss_far"), 0.0),
    least_seen=1.0, lookalikes_per_km=0.0,
)  # fmt: skip


def test_errors_stay_with_a_sign_in_a_drive_and_are_others_in_the_next(street_1: World) -> None:
    camera = replace(QUIET, hard=ONLY_HELD)
    found = simulated(street_1, replace(SHORT, scans=None, camera=camera)).sightings(camera)
    sign = slice(n := int(found.visible.sum(axis=0).argmax()), n + 1)
    alone = Sightings(found.names[sign], found.polar[:, sign], found.in_view[:, sign], found.visible[:, sign])
    rows, shares = np.flatnonzero(alone.visible[:, 0]), []
    for seed in range(40):
        looks = looks_of(camera, alone, np.arange(len(alone.visible), dtype=np.int64), (seed, 1))
        of_drive = np.array([looks[k].range_m[0] / alone.polar[k, 0, 0] - 1.0 for k in rows])
        assert of_drive.std() < 1e-4
        shares.append(of_drive.mean())
    assert np.std(shares) == pytest.approx(0.05, rel=0.4)


def test_what_looks_like_a_sign_is_seen_in_some_looks_of_some_drives_and_hidden_like_one(street_1: World) -> None:
    hard = replace(ONLY_HELD, sign_range_share=0.0, sign_bearing_rad=0.0, lookalikes_per_km=40.0)
    camera = replace(QUIET, hard=hard)
    found = simulated(street_1, replace(SHORT, scans=None, camera=camera)).sightings(camera)
    kind = simulated(street_1, replace(SHORT, scans=None, camera=QUIET)).sightings(QUIET)
    assert found.names[: len(kind.names)] == kind.names
    assert np.array_equal(found.visible[:, : len(kind.names)], kind.visible)
    alike = ~found.is_sign
    assert alike.sum() >= 3
    assert found.visible[:, alike].any()
    assert (found.in_view & ~found.visible)[:, alike].any()
    times = np.arange(len(found.visible), dtype=np.int64)
    extra = [sum(map(len, looks_of(camera, found, times, (seed, 1)))) - kind.visible.sum() for seed in range(12)]
    chance = hard.lookalike_seen * np.mean(hard.lookalike_rate)
    assert np.mean(extra) == pytest.approx(chance * found.visible[:, alike].sum(), rel=0.5)
    assert np.std(extra) > 0.0


def test_far_signs_are_missed_more_often_than_near_ones(street_1: World) -> None:
    found = simulated(street_1, replace(SHORT, scans=None, camera=SignCamera())).sightings(SignCamera())
    times, near = np.arange(len(found.visible), dtype=np.int64), [0.0, 0.0]
    for seed in range(6):
        looks = looks_of(replace(SignCamera(), false_alarms=0.0), found, times, (seed, 1))
        range_m = np.concatenate([look.range_m for look in looks])
        near[0] += float((range_m < 30.0).sum())
        near[1] += float((range_m > 60.0).sum())
    true_m = found.polar[..., 0][found.visible]
    seen = near[0] / (true_m < 30.0).sum(), near[1] / (true_m > 60.0).sum()
    assert seen[0] > 1.2 * seen[1]


def test_a_camera_disturbs_nothing_else_of_a_drive(street_1: World, tmp_path: Path) -> None:
    def told(item: DriveItem) -> object:
        match item:
            case Scan():
                return item.t_ns, item.points_m.tobytes()
            case ReferencePose():
                return item.t_ns, item.T_map_vehicle.tobytes()
            case MotionSample() | GnssFix():
                return item
        return None

    with_camera = simulate_drive(street_1, replace(SHORT, camera=SignCamera()), tmp_path / "with.mcap")
    without = simulate_drive(street_1, SHORT, tmp_path / "without.mcap")
    items = [item for item in read_drive(with_camera) if not isinstance(item, Detections)]
    assert list(map(told, items)) == list(map(told, read_drive(without)))
    assert (drive_counts(with_camera).detections, drive_counts(without).detections) == (13, 0)
    shas = []
    for drive in (with_camera, without):
        with SqliteStore(tmp_path / f"{drive.stem}.sqlite") as store:
            build_map([drive], store)
            shas.append([entry.sha for entry in store.heads("ndt")])
    assert shas[0] == shas[1] != [], "a map is built from drives with looks as without"


def test_vehicles_of_a_fleet_have_cameras_mapping_vehicles_none() -> None:
    assert all(config.camera == SignCamera() for config in agent_configs(1, 3))
    assert all(config.camera is None for config in mapping_configs(1))


@pytest.mark.parametrize(
    "change",
    [
        {"level": 0.0},
        {"miss_rate": 1.0},
        {"false_alarms": -0.1},
        {"rate_hz": 0},
        {"width_deg": 0.0},
        {"range_m": 900.0},
    ],
)
def test_impossible_cameras_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(DriveSimError):
        SignCamera(**change)  # type: ignore[arg-type]
