from dataclasses import replace
from math import radians
from pathlib import Path

import numpy as np
import pytest

from gnd.fleet_sim.drives import EPOCH_NS, PERFECT, DriveConfig, DriveSimulation, SensorErrors, simulate_drive
from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.prepare import agent_configs, mapping_configs
from gnd.fleet_sim.sensors import HDL32E
from gnd.fleet_sim.trajectory import DrivingStyle, gauss_markov, lane_motion
from gnd.fleet_sim.world import World
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import T_inverse
from gnd.schemas.drive import DriveItem, GnssFix, MotionSample, ReferencePose, Scan
from gnd.schemas.drive_mcap import load_track, read_drive, read_header

SHORT = DriveConfig(vehicle="v-1", sensor="VLP-16", seed=3, scans=5)


@pytest.fixture(scope="module")
def drive(street_1: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate_drive(street_1, SHORT, tmp_path_factory.mktemp("drive") / "short.mcap")


def test_a_drive_is_read_back_with_everything_in_time_order(drive: Path, street_1: World) -> None:
    items = list(read_drive(drive))
    times = [item.t_ns for item in items]
    assert times == sorted(times)
    kinds = {kind: [i for i in items if isinstance(i, kind)] for kind in (Scan, MotionSample, GnssFix, ReferencePose)}
    assert [scan.t_ns for scan in kinds[Scan]] == [EPOCH_NS + k * 100_000_000 for k in range(5)]
    span_s = 0.5 + 2 * 0.2
    assert len(kinds[MotionSample]) == round(50 * span_s) + 1
    assert len(kinds[ReferencePose]) == round(100 * span_s) + 1
    assert len(kinds[GnssFix]) == round(10 * span_s) + 1
    assert kinds[ReferencePose][0].t_ns < kinds[Scan][0].t_ns
    assert kinds[ReferencePose][-1].t_ns >= kinds[Scan][-1].t_ns + 100_000_000, "the last sweep can be deskewed"
    header = read_header(drive)
    assert (header.vehicle, header.sensor_model, header.anchor) == ("v-1", "VLP-16", street_1.frame)


def test_deskewed_scans_lie_on_the_road(drive: Path, street_1: World) -> None:
    header, track = read_header(drive), load_track(drive).reference
    poses = Trajectory(track.t_ns, track.T_map_vehicle)
    for scan in (item for item in read_drive(drive) if isinstance(item, Scan)):
        points = deskew(scan.points_m, scan.t_offset_ns, scan.t_ns, poses, header.T_vehicle_lidar, scan.t_ns)
        T = poses.at(scan.t_ns)
        street = street_1.street_of_map(points @ T[:3, :3].T + T[:3, 3])
        near = (np.abs(street[:, 1]) < 3.0) & (np.abs(street[:, 2]) < 0.3) & (np.linalg.norm(points, axis=1) < 15.0)
        off = street[near, 2] - street_1.road_height_m(street[near, 1])
        assert near.sum() > 500
        assert abs(np.median(off)) < 0.02, "mount error of 3 mm and 0.02°"
        assert off.std() < 0.02, "range noise of 3 cm at a shallow angle"


def test_the_same_seed_gives_the_same_scans(street_1: World) -> None:
    def first_scan(config: DriveConfig) -> np.ndarray:
        return next(i.points_m for i in DriveSimulation(street_1, config).items() if isinstance(i, Scan))

    a, b = first_scan(SHORT), first_scan(SHORT)
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a[:100], first_scan(replace(SHORT, seed=4))[:100])


def test_points_are_rounded_to_the_resolution_of_the_sensor(street_1: World) -> None:
    scan = next(i for i in DriveSimulation(street_1, SHORT).items() if isinstance(i, Scan))
    steps = scan.points_m.astype(float) * 512
    np.testing.assert_array_equal(steps, np.round(steps))


@pytest.mark.parametrize("direction", [1, -1])
def test_a_vehicle_drives_the_whole_street_on_the_right(street_1: World, direction: int) -> None:
    config = replace(SHORT, scans=None, direction=1 if direction > 0 else -1)
    simulation = DriveSimulation(street_1, config)
    assert 180 <= simulation.scans <= 260
    t_s = np.linspace(0.0, simulation.scans / 10, 200)
    T = simulation.motion.T_map_vehicle(t_s)
    street = street_1.street_of_map(T[:, :3, 3])
    assert street[0, 0] * direction == pytest.approx(-98.0)
    assert street[-1, 0] * direction == pytest.approx(98.0, abs=1.5)
    assert np.all(np.abs(street[:, 1] + direction * 1.75) < 0.25)
    speed = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1) / np.diff(t_s)
    assert 2.5 < speed.min() < speed.max() < 12.0
    assert 7.5 < speed.mean() < 10.0
    np.testing.assert_allclose(
        T[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2), np.tile(np.eye(3), (200, 1, 1)), atol=1e-12
    )
    assert np.all(T[:, 2, 2] > np.cos(radians(3.0))), "up is up"


def test_the_vehicle_moves_where_it_points(street_1: World) -> None:
    """No side slip: over 10 ms the step in the vehicle's frame is forward (heave aside)."""
    motion = DriveSimulation(street_1, SHORT).motion
    t_s = np.linspace(0.0, 10.0, 50)
    step = T_inverse(motion.T_map_vehicle(t_s)) @ motion.T_map_vehicle(t_s + 0.01)
    assert np.all(step[:, 0, 3] > 0.03)
    assert np.abs(step[:, 1, 3]).max() < 1e-3


def test_perfect_odometry_agrees_with_the_reference_poses(street_1: World) -> None:
    items = list(DriveSimulation(street_1, replace(SHORT, scans=100, errors=PERFECT))._motion_samples())
    motion = DriveSimulation(street_1, replace(SHORT, scans=100, errors=PERFECT)).motion
    t_s = np.array([(item.t_ns - EPOCH_NS) * 1e-9 for item in items])
    way = float(np.trapezoid([item.speed_mps for item in items], t_s))
    truth = motion.travelled_m(t_s[[0, -1]])
    slope = np.sqrt(1 + street_1.slope**2)
    assert way == pytest.approx(slope * (truth[1] - truth[0]), rel=2e-3)
    turned = float(np.trapezoid([item.yaw_rate_radps for item in items], t_s))
    T = motion.T_map_vehicle(t_s[[0, -1]])
    heading = np.arctan2(T[:, 1, 0], T[:, 0, 0])
    assert turned == pytest.approx(heading[1] - heading[0], abs=2e-4)


def test_sensor_errors_are_of_the_size_asked_for(street_1: World) -> None:
    errors = SensorErrors(wheel_scale=0.005, gnss_m=2.5)
    scales, fixes = [], []
    for seed in range(40):
        simulation = DriveSimulation(street_1, replace(SHORT, seed=seed, errors=errors, car_share=0.0))
        samples, truth = simulation._motion_samples(), simulation.motion
        t_s = np.array([(s.t_ns - EPOCH_NS) * 1e-9 for s in samples])
        scales.append(np.mean([s.speed_mps for s in samples] / truth.speed_and_yaw_rate(t_s)[0]) - 1)
        fix = simulation._gnss_fixes()[0]
        where = truth.T_map_vehicle(np.array([(fix.t_ns - EPOCH_NS) * 1e-9]))[0, :3, 3]
        east, north, _ = street_1.frame.enu_from_geodetic(fix.lat_rad, fix.lon_rad, fix.height_m).ravel() - where
        fixes.append(np.hypot(east, north))
    assert np.std(scales) == pytest.approx(0.005, rel=0.35)
    assert np.sqrt(np.mean(np.square(fixes))) == pytest.approx(2.5, rel=0.25)


def test_gauss_markov_is_stationary_and_correlated() -> None:
    values = gauss_markov(np.random.default_rng(0), 200_000, 0.1, 2.0, 5.0)
    assert values.std() == pytest.approx(2.0, rel=0.1)
    assert np.corrcoef(values[:-50], values[50:])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.08)


def test_the_mapping_vehicle_sees_no_parked_cars_and_the_fleet_is_mixed() -> None:
    mapping, agents = mapping_configs(1), agent_configs(1, 8)
    assert all(c.car_share == 0.0 and c.state == "before" and c.sensor == HDL32E.name for c in mapping)
    assert {c.direction for c in mapping} == {1, -1}
    assert {(c.sensor, c.direction) for c in agents} == {(s, d) for s in ("VLP-16", "HDL-32E") for d in (1, -1)}
    assert len({c.seed for c in (*mapping, *agents)}) == 10
    assert max(c.start_ns for c in mapping) < min(c.start_ns for c in agents)
    with pytest.raises(GndError, match="at least one vehicle"):
        agent_configs(1, 0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sensor": "HDL-128"}, "VLP-16, HDL-32E"),
        ({"direction": 0}, "direction"),
        ({"gnss_hz": 0}, "gnss_hz"),
    ],
)
def test_impossible_drives_are_refused(change: dict[str, object], words: str) -> None:
    with pytest.raises(DriveSimError, match=words):
        replace(SHORT, **change)


def test_no_scans_no_speed_and_negative_errors_are_refused(street_1: World) -> None:
    with pytest.raises(DriveSimError, match="at least one scan"):
        DriveSimulation(street_1, replace(SHORT, scans=0))
    with pytest.raises(DriveSimError, match="wheel_mps"):
        SensorErrors(wheel_mps=-1.0)
    style = DrivingStyle.drawn(np.random.default_rng(0), 9.0)
    with pytest.raises(DriveSimError, match="slow down"):
        lane_motion(street_1, replace(style, start_share=0.05), 1)


def test_a_drive_that_cannot_be_written_leaves_nothing(street_1: World, tmp_path: Path) -> None:
    with pytest.raises(GndError):
        simulate_drive(street_1, SHORT, tmp_path / "none" / "drive.mcap")
    assert list(tmp_path.iterdir()) == []


def test_progress_is_told_scan_by_scan(street_1: World, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    simulate_drive(
        street_1, replace(SHORT, scans=2), tmp_path / "d.mcap", lambda done, total: told.append((done, total))
    )
    assert told == [(1, 2), (2, 2)]


def _scans(items: list[DriveItem]) -> list[Scan]:
    return [i for i in items if isinstance(i, Scan)]


def test_parked_cars_hide_the_pavement(street_1: World) -> None:
    def low_points(car_share: float) -> int:
        """Points on the lower pavement front, right of the road, that cars hide."""
        simulation = DriveSimulation(street_1, replace(SHORT, scans=1, car_share=car_share, errors=PERFECT))
        scan = _scans(list(simulation.items()))[0]
        T = simulation.motion.T_map_vehicle(scan.t_offset_ns * 1e-9) @ SHORT.T_vehicle_lidar
        street = street_1.street_of_map(np.einsum("nij,nj->ni", T[:, :3, :3], scan.points_m) + T[:, :3, 3])
        return int(((np.abs(street[:, 1]) > 6.3) & (street[:, 2] < 0.5)).sum())

    assert low_points(1.0) < 0.6 * low_points(0.0)
