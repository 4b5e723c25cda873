"""Drives along roads: what the vehicle measures agrees with the truth as the noise models say, to the bit by seed."""

from dataclasses import replace
from math import radians
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from gnd.fleet_sim.cli import sim
from gnd.fleet_sim.drives import SensorErrors
from gnd.fleet_sim.errors import DriveSimError, RoadError
from gnd.fleet_sim.roads.drive import ROAD_ERRORS, RoadDrive, RoadDriveOptions, drive_route, road_errors
from gnd.fleet_sim.roads.looks import DetectorNoise
from gnd.fleet_sim.roads.motion import Cruise, RoadMotion
from gnd.fleet_sim.roads.motorway import motorway
from gnd.fleet_sim.roads.pictures import detection_places
from gnd.fleet_sim.roads.route import Route
from gnd.fleet_sim.roads.sight import CameraView
from gnd.fleet_sim.roads.streetlights import streetlight_motorway
from gnd.fleet_sim.roads.test_track import test_track
from gnd.fleet_sim.roads.traffic import EMPTY, RoadTraffic, drawn_boxes, lanes_taken

SHORT = RoadDriveOptions(length_m=2500.0)
NO_ERRORS = SensorErrors(0.0, 0.0, 0.0, 0.0, 0.0, 40.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def road() -> Route:
    return motorway(11, length_m=5000.0)


@pytest.fixture(scope="module")
def drive(road: Route) -> RoadDrive:
    return drive_route(road, 1, SHORT)


@pytest.fixture(scope="module")
def lap() -> RoadDrive:
    return drive_route(test_track(11), 1)


def same(a: RoadDrive, b: RoadDrive) -> dict[str, bool]:
    return {
        "motion": all(map(np.array_equal, a.motion, b.motion)),
        "gnss": np.array_equal(a.gnss.xy_m, b.gnss.xy_m),
        "looks": all(np.array_equal(x.range_m, y.range_m) for x, y in zip(a.looks, b.looks, strict=True)),
        "lanes": all(
            len(x) == len(y) and all(map(np.array_equal, x.polylines, y.polylines))
            for x, y in zip(a.lane_looks, b.lane_looks, strict=True)
        ),
        "truth": np.array_equal(a.truth.poses, b.truth.poses) and np.array_equal(a.truth.hidden, b.truth.hidden),
    }


def test_the_same_seed_gives_the_same_drive_to_the_bit(road: Route, drive: RoadDrive) -> None:
    assert all(same(drive, drive_route(road, 1, SHORT)).values())
    other = drive_route(road, 2, SHORT)
    assert not np.array_equal(other.truth.poses[:100], drive.truth.poses[:100])


def test_an_option_changes_nothing_but_its_own_stream(road: Route, drive: RoadDrive) -> None:
    changed = drive_route(road, 1, replace(SHORT, points=DetectorNoise(level=2.0)))
    assert same(drive, changed) == {"motion": True, "gnss": True, "looks": False, "lanes": True, "truth": True}
    assert all(map(np.array_equal, drive.truth.of_detection, changed.truth.of_detection)), "the same hits"
    quiet = drive_route(road, 1, replace(SHORT, errors=replace(ROAD_ERRORS, wheel_scale=0.0)))
    assert same(drive, quiet) == {"motion": False, "gnss": True, "looks": True, "lanes": True, "truth": True}


def test_perfect_wheels_and_gyro_lead_to_the_true_end(road: Route) -> None:
    found = drive_route(road, 3, RoadDriveOptions(errors=NO_ERRORS, traffic=RoadTraffic(truck_spacing_m=400.0)))
    speed, rate = found.motion.speed_mps, found.motion.yaw_rate_radps
    poses = found.truth.poses
    heading = poses[0, 2] + np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1])) * 0.02])
    middle = 0.5 * (heading[1:] + heading[:-1])
    step = 0.5 * (speed[1:] + speed[:-1]) * 0.02
    end = poses[0, :2] + (step[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=1)).sum(axis=0)
    assert np.ptp(found.truth.poses[:, 2]) > 0.1
    assert np.linalg.norm(end - poses[-1, :2]) < 0.5, "of 5 km"
    assert np.abs(heading - poses[:, 2]).max() < 1e-3


def test_detections_err_as_the_papers_table_says(lap: RoadDrive) -> None:
    of = np.concatenate(lap.truth.of_detection)
    features = {int(i): xy for i, xy in zip(lap.route.features.feature_id, lap.route.features.xy_m, strict=True)}
    pose = np.repeat(lap.truth.look_poses, [len(look) for look in lap.looks], axis=0)[of > 0]
    step = np.array([features[i] for i in of[of > 0].tolist()]) - pose[:, :2]
    range_m = np.concatenate([look.range_m for look in lap.looks])[of > 0]
    bearing = np.concatenate([look.bearing_rad for look in lap.looks])[of > 0]
    off = (bearing - np.arctan2(step[:, 1], step[:, 0]) + pose[:, 2] + np.pi) % (2 * np.pi) - np.pi
    assert len(off) > 3000
    assert (range_m - np.linalg.norm(step, axis=1)).std() == pytest.approx(1.0, rel=0.05)
    assert off.std() == pytest.approx(radians(2.5), rel=0.05)
    visible = int((lap.truth.in_view & ~lap.truth.hidden).sum())
    assert len(off) / visible == pytest.approx(0.9, abs=0.01)
    assert (of == 0).sum() / len(lap.looks) == pytest.approx(0.02, abs=0.01)
    places, _ = detection_places(lap)
    assert np.abs(places[of > 0] - step - pose[:, :2]).mean() < 2.0


def test_what_is_gone_or_out_of_view_is_never_detected(drive: RoadDrive) -> None:
    features = drive.route.features
    gone = set(features.feature_id[features.rows("deleted")].tolist())
    row = {int(number): k for k, number in enumerate(features.feature_id)}
    for look, of in enumerate(drive.truth.of_detection):
        for number in of[of > 0].tolist():
            assert number not in gone
            assert drive.truth.in_view[look, row[number]]
            assert not drive.truth.hidden[look, row[number]]
    assert (drive.truth.looks_at[features.rows("deleted")] > 10).any(), "their places were looked at"


def test_the_field_of_view_is_the_cameras(drive: RoadDrive) -> None:
    xy, poses = drive.route.features.xy_m, drive.truth.look_poses
    look, feature = np.nonzero(drive.truth.in_view)
    step = xy[feature] - poses[look, :2]
    ahead = np.cos(poses[look, 2]) * step[:, 0] + np.sin(poses[look, 2]) * step[:, 1]
    assert np.linalg.norm(step, axis=1).max() <= 80.0
    assert (ahead / np.linalg.norm(step, axis=1)).min() >= np.cos(radians(20.0)) - 1e-9
    assert drive.looks[1].t_ns - drive.looks[0].t_ns == 66_666_666


def test_false_detections_and_wrong_kinds_come_as_often_as_asked(road: Route) -> None:
    noise = DetectorNoise(level=0.5, miss_rate=0.0, false_alarms=1.0, misclassified=0.3)
    found = drive_route(road, 1, replace(SHORT, points=noise, traffic=EMPTY))
    of = np.concatenate(found.truth.of_detection)
    kinds = np.array([kind for look in found.looks for kind in look.kinds])
    true = dict(zip(road.features.feature_id.tolist(), road.features.kinds, strict=True))
    wrong = [kind != true[number] for kind, number in zip(kinds[of > 0], of[of > 0].tolist(), strict=True)]
    assert np.mean(wrong) == pytest.approx(0.3, abs=0.05)
    assert (of == 0).sum() / len(found.looks) == pytest.approx(1.0, abs=0.1)
    assert (of > 0).sum() == (found.truth.in_view[:, road.features.rows("normal", "new")]).sum(), "nothing hidden"


def test_lane_markings_err_sideways_and_in_heading(lap: RoadDrive) -> None:
    true, noisy = (
        drive_route(lap.route, 1, RoadDriveOptions(lanes=DetectorNoise(level=level, miss_rate=0.0), length_m=1200.0))
        for level in (1e-6, 1.0)
    )
    aside, turn = [], []
    for a, b in zip(true.lane_looks, noisy.lane_looks, strict=True):
        for line, moved in zip(a.polylines, b.polylines, strict=True):
            way = np.arctan2(*(line[-1] - line[0])[::-1]), np.arctan2(*(moved[-1] - moved[0])[::-1])
            turn.append((way[1] - way[0] + np.pi) % (2 * np.pi) - np.pi)
            c, s = np.cos(turn[-1]), np.sin(turn[-1])
            aside.append(moved[0, 1] - s * line[0, 0] - c * line[0, 1])
    assert len(turn) > 2000
    assert np.std(turn) == pytest.approx(radians(2.5), rel=0.05)
    assert np.std(aside) == pytest.approx(1.0, rel=0.05)
    kept = sum(map(len, lap.lane_looks[: len(true.lane_looks)])) / sum(map(len, true.lane_looks))
    assert kept == pytest.approx(0.9, abs=0.02)


def test_lane_markings_without_noise_lie_on_the_map(lap: RoadDrive) -> None:
    true = drive_route(lap.route, 1, RoadDriveOptions(lanes=DetectorNoise(level=1e-6, miss_rate=0.0), length_m=500.0))
    lanes = lap.route.lanes(0.2)
    for index in (0, 200, 400):
        look = true.lane_looks[index]
        pose = np.array([np.interp(look.t_ns, true.truth.t_ns, column) for column in true.truth.poses.T])
        c, s = np.cos(pose[2]), np.sin(pose[2])
        for line in look.polylines:
            xy = pose[:2] + line @ np.array([[c, s], [-s, c]])
            off = [np.linalg.norm(xy[::4, None] - lane[None], axis=2).min(axis=1).max() for lane in lanes]
            assert min(off) < 0.11, "half the distance of the map's points"
            assert np.linalg.norm(line, axis=1).max() <= 80.0
            assert np.abs(np.arctan2(line[:, 1], line[:, 0])).max() <= radians(20.1)


def test_gnss_errs_slowly_and_by_what_it_says() -> None:
    route = streetlight_motorway(12, straight=True, length_m=2500.0)
    errors = [drive_route(route, seed, RoadDriveOptions(gnss_hz=5)) for seed in (1, 2, 3)]
    steps = []
    for found in errors:
        true = np.stack([np.interp(found.gnss.t_ns, found.truth.t_ns, c) for c in found.truth.poses[:, :2].T], axis=1)
        steps.append(found.gnss.xy_m - true)
    off = np.concatenate(steps)
    assert off.std() == pytest.approx(errors[0].gnss.sigma_m, rel=0.35)
    white = np.concatenate([np.diff(step, axis=0) for step in steps]).std() / np.sqrt(2)
    assert white == pytest.approx(ROAD_ERRORS.gnss_white_m, rel=0.1)
    assert road_errors(5.0).gnss_m == pytest.approx(2 * ROAD_ERRORS.gnss_m)


def test_a_constant_error_of_the_gnss_differs_from_drive_to_drive() -> None:
    route = streetlight_motorway(12, straight=True, length_m=600.0)
    quiet = replace(ROAD_ERRORS, gnss_m=0.0, gnss_white_m=0.0)
    means = []
    for seed in range(12):
        found = drive_route(route, seed, RoadDriveOptions(errors=quiet, gnss_bias_m=3.0))
        true = np.stack([np.interp(found.gnss.t_ns, found.truth.t_ns, c) for c in found.truth.poses[:, :2].T], axis=1)
        assert np.ptp(found.gnss.xy_m - true, axis=0).max() < 0.01
        means.append((found.gnss.xy_m - true)[0])
    assert np.std(means) == pytest.approx(3.0, rel=0.4)


def test_trucks_are_passed_on_the_next_lane(road: Route) -> None:
    rng = np.random.default_rng(5)
    motion = RoadMotion(road, Cruise.drawn(rng, 25.0, 33.0), 0.0, 5000.0)
    boxes = drawn_boxes(road, RoadTraffic(truck_spacing_m=150.0), motion, rng)
    motion.keep_to(lanes_taken(motion, boxes))
    t_s = np.arange(0.0, motion.duration_s, 0.1)
    trucks = np.flatnonzero(boxes.lane == 0)
    ahead = boxes.way_m[trucks] + boxes.speed_mps[trucks] * t_s[:, None] - motion.way_m(t_s)[:, None]
    beside = np.abs(ahead) < 0.5 * (16.5 + 4.5)
    left = motion.left_m(t_s) - road.lane_left_m[0]
    assert beside.any(axis=1).sum() > 20
    assert (left[beside.any(axis=1)] > 3.0).all()
    assert (left < 0.3).any(), "back on the right lane between trucks"


def test_events_come_in_time_order(drive: RoadDrive) -> None:
    events = list(drive.events())
    times = [t for t, _, _ in events]
    assert times == sorted(times)
    counts = {name: sum(1 for _, kind, _ in events if kind == name) for name in ("motion", "gnss", "look", "lanes")}
    assert counts["motion"] == len(drive.motion.t_ns)
    assert (counts["look"], counts["lanes"]) == (len(drive.looks), len(drive.lane_looks))
    assert counts["gnss"] == len(drive.gnss.t_ns)


def test_a_stretch_of_a_road_and_several_laps_can_be_driven(road: Route) -> None:
    part = drive_route(road, 1, RoadDriveOptions(start_m=1000.0, length_m=500.0))
    start, end = road.line.at(np.array([1000.0, 1500.0]))[0]
    assert np.linalg.norm(part.truth.poses[0, :2] - start) < 10.0
    assert np.linalg.norm(part.truth.poses[-1, :2] - end) < 10.0
    track = test_track(11)
    laps = drive_route(track, 1, RoadDriveOptions(length_m=2.5 * track.length_m))
    assert np.ptp(laps.truth.poses[:, 2]) > 4.0 * np.pi


@pytest.mark.parametrize(
    "make",
    [
        lambda: DetectorNoise(level=0.0),
        lambda: DetectorNoise(miss_rate=1.0),
        lambda: DetectorNoise(false_alarms=-1.0),
        lambda: RoadDriveOptions(gnss_hz=0),
        lambda: RoadDriveOptions(gnss_bias_m=-1.0),
        lambda: RoadDriveOptions(length_m=1.0),
        lambda: RoadTraffic(truck_spacing_m=1.0),
        lambda: CameraView("camera", 7.0, 80.0, 15, 1.3, 0.01),
        lambda: drive_route(test_track(11), -1),
        lambda: drive_route(motorway(11, length_m=5000.0), 1, RoadDriveOptions(start_m=4000.0, length_m=1001.0)),
        lambda: drive_route(motorway(11, length_m=5000.0), 1, RoadDriveOptions(start_m=5000.0)),
    ],
)
def test_drives_that_cannot_be_are_refused(make: object) -> None:
    with pytest.raises((RoadError, DriveSimError)):
        make()  # type: ignore[operator]


def test_the_command_draws_a_road(tmp_path: Path) -> None:
    png = tmp_path / "road.png"
    result = CliRunner().invoke(sim, ["road", "picture", "streetlights-straight", str(png)])
    assert result.exit_code == 0, result.output
    assert png.read_bytes()[:4] == b"\x89PNG"
    assert "5000 m, 2040 looks" in result.output
