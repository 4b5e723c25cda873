"""Traffic of simulated drives: where it goes, that it hides no bit of what was there before, and its labels."""

import hashlib
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from gnd.fleet_sim.cars import parked_cars
from gnd.fleet_sim.drives import PERFECT, DriveConfig, DriveSimulation, simulate_drive
from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.movers import Mover
from gnd.fleet_sim.people import free_stretches
from gnd.fleet_sim.shapes import Ball
from gnd.fleet_sim.stage import Stage
from gnd.fleet_sim.traffic import STEP_S, Traffic, drive_lane
from gnd.fleet_sim.world import World
from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import read_drive

SHORT = DriveConfig(vehicle="v-1", sensor="VLP-16", seed=3, scans=4)
BUSY = Traffic(cars_per_100m=6.0, pedestrians_per_100m=8.0)
CARS = Traffic(cars_per_100m=6.0, stopping_share=0.0)

# sha256 of the points of the first two scans, made before there was any traffic.
PINNED = {
    "VLP-16": "b43bd1f70a98c57f949ef314fe70a0eb957287c940f09b944bc1f35cb91d726c",
    "HDL-32E": "e0c72f3c163923567dea5504f16a38c1eaf048e60b60e799c36e5e5b3ffe9384",
}


def scans(world: World, config: DriveConfig) -> list[Scan]:
    return [item for item in DriveSimulation(world, config).items() if isinstance(item, Scan)]


def labelled(world: World, config: DriveConfig) -> tuple[list[Scan], list[np.ndarray]]:
    labels: list[np.ndarray] = []
    told: list[int] = []
    items = DriveSimulation(world, config).items(on_labels=lambda t, moving: (told.append(t), labels.append(moving))[0])
    found = []
    for item in items:
        if isinstance(item, Scan):
            assert told[-1] == item.t_ns, "told right before the scan"
            found.append(item)
    assert len(labels) == len(found)
    return found, labels


def rows(scan: Scan) -> np.ndarray:
    assert scan.ring is not None
    return np.column_stack([scan.t_offset_ns, scan.ring, scan.points_m]).astype(np.float64)


def is_person(mover: Mover) -> bool:
    return any(mover.swing)


def simulation(world: World, seed: int, direction: int = 1, traffic: Traffic = BUSY) -> DriveSimulation:
    config = replace(SHORT, seed=seed, scans=None, traffic=traffic, direction=1 if direction > 0 else -1)
    return DriveSimulation(world, config)


@pytest.mark.parametrize("sensor", PINNED)
def test_drives_without_traffic_are_what_they_always_were(street_1: World, sensor: str) -> None:
    digest = hashlib.sha256()
    for scan in scans(street_1, replace(SHORT, sensor=sensor, scans=2)):
        digest.update(rows(scan).tobytes())
    assert digest.hexdigest() == PINNED[sensor]


def test_a_drive_with_traffic_is_the_same_to_the_bit_each_time(street_1: World) -> None:
    config = replace(SHORT, traffic=BUSY, scans=2)
    once, again = scans(street_1, config), scans(street_1, config)
    for a, b in zip(once, again, strict=True):
        np.testing.assert_array_equal(rows(a), rows(b))
    other = simulation(street_1, 4).movers
    first = simulation(street_1, 3).movers
    assert other is not None
    assert first is not None
    assert not np.array_equal(first.movers[0].track[:10], other.movers[0].track[:10])


def test_points_off_the_movers_are_those_of_the_empty_street_and_labels_say_which(street_1: World) -> None:
    """Noise and losses are drawn shot by shot, so traffic changes no other point by a bit."""
    config = replace(SHORT, traffic=CARS, scans=8)
    free = scans(street_1, replace(config, traffic=Traffic()))
    busy, labels = labelled(street_1, config)
    assert sum(int(moving.sum()) for moving in labels) > 500
    for scan, moving, empty in zip(busy, labels, free, strict=True):
        assert moving.dtype == np.bool_
        assert len(moving) == len(scan)
        there = {row.tobytes() for row in rows(empty)}
        same = np.array([row.tobytes() in there for row in rows(scan)])
        np.testing.assert_array_equal(same, ~moving)


def test_labelled_points_lie_on_movers_at_their_own_time(street_1: World) -> None:
    config = replace(SHORT, traffic=BUSY, errors=PERFECT, scans=6)
    sim = DriveSimulation(street_1, config)
    assert sim.movers is not None
    busy, labels = labelled(street_1, config)
    for scan, moving in zip(busy, labels, strict=True):
        t_s = (scan.t_ns - config.start_ns + scan.t_offset_ns[moving]) * 1e-9
        T = sim.motion.T_map_vehicle(t_s) @ config.T_vehicle_lidar
        points = street_1.street_of_map(np.einsum("nij,nj->ni", T[:, :3, :3], scan.points_m[moving]) + T[:, :3, 3])
        away = np.stack([_outside_m(mover, sim.movers.at(t_s)[k], points) for k, mover in enumerate(sim.movers.movers)])
        assert away.min(axis=0).max() < 0.15, "range noise of 3 cm"


def _outside_m(mover: Mover, states: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How far each point lies outside the box around a mover at its own time."""
    bounds = np.array([shape.bounds() for shape in mover.shapes])
    low, high = bounds[:, :2].min(axis=0), bounds[:, [2, 3]].max(axis=0)
    swing = np.abs(states[:, 4]) * max(map(abs, mover.swing))
    rel = points - states[:, :3]
    c, s = np.cos(states[:, 3]), np.sin(states[:, 3])
    own = np.stack([c * rel[:, 0] + s * rel[:, 1], c * rel[:, 1] - s * rel[:, 0]], axis=1)
    past = np.maximum(low - own, own - high)
    past[:, 0] -= swing
    upright = np.maximum(-rel[:, 2], rel[:, 2] - bounds[:, 4].max())
    return np.maximum(past.max(axis=1), upright)


def test_recordings_hold_no_labels(street_1: World, tmp_path: Path) -> None:
    config = replace(SHORT, traffic=BUSY, scans=2)
    path = simulate_drive(street_1, config, tmp_path / "drive.mcap")
    written = [item for item in read_drive(path) if isinstance(item, Scan)]
    with_labels, labels = labelled(street_1, config)
    assert sum(int(moving.sum()) for moving in labels) > 0
    for a, b in zip(written, with_labels, strict=True):
        np.testing.assert_array_equal(rows(a), rows(b))
    assert b"moving" not in path.read_bytes()


@pytest.mark.parametrize(("seed", "direction"), [(1, 1), (2, -1), (3, 1)])
def test_cars_keep_their_distance_and_their_lane(street_1: World, seed: int, direction: int) -> None:
    sim = simulation(street_1, seed, direction)
    assert sim.movers is not None
    cars = [mover.track for mover in sim.movers.movers if not is_person(mover)]
    times = sim.movers.t0_s + STEP_S * np.arange(len(cars[0]))
    ego_x, ego_y, _ = sim.motion.on_path(times)
    ego = np.stack([ego_x + direction * 1.4, ego_y], axis=1)
    lanes = {side: [track for track in cars if track[0, 1] * side > 0] for side in (1, -1)}
    assert all(len(lane) >= 3 for lane in lanes.values())
    for side, lane in lanes.items():
        everyone = [track[:, :2] for track in lane] + ([ego] if ego_y[0] * side > 0 else [])
        ordered = sorted(everyone, key=lambda track: float(-side * -track[0, 0]))
        gaps = [np.abs(a[:, 0] - b[:, 0]) for a, b in pairwise(ordered)]
        assert min(float(gap.min()) for gap in gaps) > 5.0 + 1.5, "bumper to bumper"
        for track in everyone:
            assert np.all(np.abs(np.abs(track[:, 1]) - 1.75) < 0.25)
    for track in cars:
        way = np.diff(track[:, 0]) * (-1 if track[0, 1] > 0 else 1)
        assert np.all(way >= 0), "on the right, forwards"
        assert way.max() < 14.0 * STEP_S


def test_some_cars_stop_and_go_on(street_1: World) -> None:
    stopping = simulation(street_1, 5, traffic=Traffic(cars_per_100m=6.0, stopping_share=1.0)).movers
    assert stopping is not None
    speeds = [np.abs(np.diff(mover.track[:, 0])) / STEP_S for mover in stopping.movers]
    stood = [speed for speed in speeds if (speed < 0.05).sum() > 100]
    assert len(stood) >= 3
    assert any(speed[np.flatnonzero(speed < 0.05)[-1] :].max() > 3.0 for speed in stood), "goes on"


def test_nothing_that_stands_is_driven_or_walked_through(street_1: World) -> None:
    sim = simulation(street_1, 6)
    assert sim.movers is not None
    boxes = _boxes(street_1, 6)
    for mover in sim.movers.movers:
        half = 0.3 if is_person(mover) else 1.0
        at = mover.track[np.abs(mover.track[:, 0]) < 150.0][::5, None, :2]
        inside = (at[..., 0] > boxes[:, 0] - half) & (at[..., 0] < boxes[:, 2] + half)
        inside &= (at[..., 1] > boxes[:, 1] - half) & (at[..., 1] < boxes[:, 3] + half)
        assert not inside.any()


def _boxes(world: World, seed: int) -> np.ndarray:
    shapes = (*world.shapes("after"), *parked_cars(world, "after", 0.2, seed))
    bounds = np.array([shape.bounds() for shape in shapes])
    bottom = np.array([s.z_m - s.radius_m if isinstance(s, Ball) else s.bottom_m for s in shapes])
    return bounds[(bottom < 1.9) & (bounds[:, 4] > 0.3)]


def test_people_walk_stand_and_cross_where_there_is_room(street_1: World) -> None:
    people, crossed = 0, 0
    for seed in (1, 2):
        sim = simulation(street_1, seed, traffic=Traffic(4.0, 8.0, crossing_share=0.6))
        assert sim.movers is not None
        times = sim.movers.t0_s + STEP_S * np.arange(len(sim.movers.movers[0].track))
        ego_x, ego_y, _ = sim.motion.on_path(times)
        vehicles = [m.track[:, :2] for m in sim.movers.movers if not is_person(m)]
        vehicles.append(np.stack([ego_x + 1.4, ego_y], axis=1))
        for walker in (m.track for m in sim.movers.movers if is_person(m)):
            people += 1
            crossed += np.ptp(walker[:, 1]) > 10.0
            speed = np.hypot(*np.diff(walker[:, :2], axis=0).T) / STEP_S
            assert speed.max() < 2.1
            for vehicle in vehicles:
                off = np.maximum(np.abs(vehicle - walker[:, :2]) - [2.5, 1.0], 0.0)
                assert np.linalg.norm(off, axis=1).min() > 0.8
            on_road = np.abs(walker[:, 1]) < 4.5
            height = walker[:, 2]
            np.testing.assert_allclose(height[on_road], street_1.road_height_m(walker[on_road, 1]), atol=0.011)
            assert np.all((height > -0.2) & (height < 0.06))
    assert people == 32
    assert crossed >= 4


def test_free_stretches_are_free_and_long_enough(street_1: World) -> None:
    sim = DriveSimulation(street_1, SHORT)
    stage = Stage(street_1, street_1.shapes("after"), sim._scene, sim.motion, 20.0, 0)
    stretches = free_stretches(stage)
    assert {np.sign(s.y_m) for s in stretches} == {1, -1}
    assert len(stretches) > 20
    assert min(s.x1_m - s.x0_m for s in stretches) >= 8.0


def test_a_car_before_the_ego_vehicle_goes_on_when_it_comes() -> None:
    """The first car would stand forever; the ego vehicle comes at 10 m/s and takes no notice."""
    times = np.arange(0.0, 20.0, STEP_S)
    wanted = np.tile([0.0, 8.0, 12.0], (len(times), 1))
    ways = drive_lane(np.array([80.0, 0.0, -40.0]), wanted, (1, 10.0 * times))
    np.testing.assert_array_equal(ways[:, 1], 10.0 * times)
    assert ways[100, 0] == 80.0, "stands while the ego vehicle is far"
    assert ways[-1, 0] > 200.0
    assert min(float((a - b).min()) for a, b in pairwise(ways.T)) > 5.0 + 2.0, "bumper to bumper"


@pytest.mark.parametrize(
    "values",
    [{"cars_per_100m": -1.0}, {"pedestrians_per_100m": 11.0}, {"cars_per_100m": np.nan}, {"stopping_share": 2.0}],
)
def test_impossible_traffic_is_refused(values: dict[str, float]) -> None:
    with pytest.raises(DriveSimError, match=next(iter(values))):
        Traffic(**values)


def test_the_urban_default_is_about_ten_cars_and_ten_people_on_400_m(street_1: World) -> None:
    sim = simulation(street_1, 8, traffic=Traffic.urban())
    assert sim.movers is not None
    people = [mover for mover in sim.movers.movers if is_person(mover)]
    cars = [mover.track[:, 0] for mover in sim.movers.movers if not is_person(mover)]
    assert len(people) == 5, "on 200 m"
    assert 3.0 < np.mean(sum(np.abs(x) < 100.0 for x in cars)) < 7.0
