"""Drives over courses: company keeps its place, clocks differ by what was asked, sensors err as they should."""

from dataclasses import replace
from math import radians

import numpy as np
import pytest

from gnd.fleet_sim.courses.company import car, keeping, lagging, lorry, movers_of, passing, van
from gnd.fleet_sim.courses.course import DrivenCourse
from gnd.fleet_sim.courses.drive import CourseConfig, CourseDrive
from gnd.fleet_sim.courses.faults import Faults
from gnd.fleet_sim.courses.places import PLACES, place_of
from gnd.fleet_sim.courses.ride import cruise, lively
from gnd.fleet_sim.courses.survey import survey_points
from gnd.fleet_sim.drives import EPOCH_NS, PERFECT
from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.street_before import PAVEMENT_M
from gnd.gnd_map.se3 import T_inverse, log_so3
from gnd.schemas.drive import GnssFix, MotionSample, ReferencePose, Scan

SCANS = 12


@pytest.fixture(scope="module")
def place():
    return place_of("street", 5)


def course(place, **what):
    return DrivenCourse(place, lively(np.random.default_rng(2), 9.0, 140.0), **what)


def drive(place, seed=1, scans=SCANS, sensor="VLP-16", errors=PERFECT, **what):
    return CourseDrive(course(place, **what), CourseConfig(sensor, seed, errors, scans))


def of(kind, items):
    return [item for item in items if isinstance(item, kind)]


def seconds(items):
    return np.array([item.t_ns - EPOCH_NS for item in items]) * 1e-9


# --- company -----------------------------------------------------------------------------------------------------


def in_vehicle_frame(simulation, mover, t_s):
    """Middle of a mover on the ground (K, 3) in the frame of the vehicle that measures."""
    world = simulation.motion.world
    at = simulation.movers.at(t_s)[mover][:, :3]
    T = T_inverse(simulation.motion.T_map_vehicle(t_s))
    return np.einsum("kij,kj->ki", T[:, :3, :3], world.map_of_street(at)) + T[:, :3, 3]


@pytest.mark.parametrize("name", ["street", "hill"])
def test_a_van_that_keeps_pace_stays_at_its_place_in_the_vehicle_frame(name):
    simulation = drive(place_of(name, 5), company=(keeping(van(), 16.0), keeping(lorry(), -14.0, 3.5)), scans=100)
    t_s = np.linspace(0.2, 9.5, 60)
    ahead, behind = (in_vehicle_frame(simulation, k, t_s) for k in range(2))
    assert ahead[:, 0] == pytest.approx(16.0, abs=0.25)
    assert behind[:, 0] == pytest.approx(-14.0, abs=0.25)
    assert np.abs(ahead[:, 1]).max() < 0.5
    assert behind[:, 1] == pytest.approx(3.5, abs=0.5)


def test_every_scan_sees_the_rear_of_the_van_at_the_same_range(place):
    items = list(drive(place, company=(keeping(van(), 16.0),)).items())
    for scan in of(Scan, items):
        x, y, z = scan.points_m.T.astype(float)
        rear = (np.abs(y) < 0.9) & (x > 5.0) & (x < 13.0) & (z > -1.2)
        assert rear.sum() > 50
        assert np.median(x[rear]) == pytest.approx(16.0 - 2.8 - 1.2, abs=0.1)
    empty = of(Scan, drive(place).items())[0].points_m
    assert not ((np.abs(empty[:, 1]) < 0.9) & (empty[:, 0] > 5) & (empty[:, 0] < 13) & (empty[:, 2] > -1.2)).any()


def test_a_queue_moves_off_one_after_the_other(place):
    simulation = drive(place, company=(lagging(car(1), 10.0, -0.5), lagging(car(2), -10.0, 0.5)), scans=100)
    t_s = np.linspace(1.0, 8.0, 50)
    way = simulation.motion.ride.way_m
    x = simulation.movers.at(t_s)[:, :, 0]
    line = simulation.motion.path
    assert x[0] == pytest.approx(line.at(way(t_s + 0.5) + 10.0)[0][:, 0], abs=0.05)
    assert x[1] == pytest.approx(line.at(way(t_s - 0.5) - 10.0)[0][:, 0], abs=0.05)


def test_oncoming_traffic_comes_towards_the_vehicle_in_the_other_lane(place):
    simulation = drive(place, company=(passing(car(3), 80.0, -8.0, 3.5),), scans=60)
    state = simulation.movers.at(np.array([0.0, 2.0]))[0]
    assert state[1, 0] - state[0, 0] == pytest.approx(-16.0, abs=0.2)
    assert state[:, 1] == pytest.approx(1.75, abs=0.3)
    assert np.cos(state[:, 3]) == pytest.approx(-1.0, abs=0.02)


def test_nobody_is_no_movers(place):
    assert movers_of((), drive(place).motion) is None


# --- clocks ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("offset_s", [-0.05, 0.0, 0.02])
def test_stamps_of_motion_samples_are_shifted_against_the_truth(place, offset_s):
    simulation = drive(place, scans=80, faults=Faults(clock_s=offset_s))
    samples = simulation._motion_samples()
    speed, yaw_rate = simulation.motion.speed_and_yaw_rate(seconds(samples) - offset_s)
    assert [s.speed_mps for s in samples] == pytest.approx(speed.tolist(), abs=1e-6)
    assert [s.yaw_rate_radps for s in samples] == pytest.approx(yaw_rate.tolist(), abs=1e-6)
    unshifted, _ = simulation.motion.speed_and_yaw_rate(seconds(samples))
    assert (np.abs(speed - unshifted).max() > 0.01) == (offset_s != 0.0)


def test_a_clock_that_drifts_is_off_by_more_and_more(place):
    simulation = drive(place, scans=100, faults=Faults(clock_s=0.01, clock_drift=0.002))
    found = seconds(simulation._motion_samples())
    steady = seconds(drive(place, scans=100)._motion_samples())
    late = found - steady
    assert late[steady <= 0] == pytest.approx(0.01, abs=1e-8)
    assert late[-1] == pytest.approx(0.01 + 0.002 * steady[-1], abs=1e-8)


def test_stamps_of_scans_can_be_late_against_all_else(place):
    late, right = (list(drive(place, faults=Faults(scan_clock_s=s)).items()) for s in (0.05, 0.0))
    for a, b in zip(of(Scan, late), of(Scan, right), strict=True):
        assert a.t_ns - b.t_ns == 50_000_000
        assert np.array_equal(a.points_m, b.points_m)
    assert [m.t_ns for m in of(MotionSample, late)] == [m.t_ns for m in of(MotionSample, right)]


@pytest.mark.parametrize("faults", [Faults(), Faults(clock_s=-0.05), Faults(scan_clock_s=0.05)])
def test_items_come_in_the_order_of_their_stamps(place, faults):
    stamps = [item.t_ns for item in drive(place, faults=faults).items()]
    assert stamps == sorted(stamps)


# --- wheels, satellites, mount, window ---------------------------------------------------------------------------


def test_wheels_tell_too_much_and_slip(place):
    simulation = drive(place, scans=150, faults=Faults(wheel_scale=0.03, slips_per_min=12.0, slip=0.3))
    samples = simulation._motion_samples()
    true, _ = simulation.motion.speed_and_yaw_rate(seconds(samples))
    factor = np.array([s.speed_mps for s in samples]) / true
    assert np.median(factor) == pytest.approx(1.03, abs=1e-6)
    slips = np.abs(factor / 1.03 - 1.0) > 0.1
    assert 0.02 < slips.mean() < 0.3
    assert np.abs(factor[slips] / 1.03 - 1.0) == pytest.approx(0.3, abs=1e-6)


def test_a_gyro_bias_is_added(place):
    a, b = (drive(place, faults=Faults(gyro_bias_radps=x))._motion_samples() for x in (0.01, 0.0))
    off = [x.yaw_rate_radps - y.yaw_rate_radps for x, y in zip(a, b, strict=True)]
    assert off == pytest.approx([0.01] * len(off))


def gnss_off_m(simulation, place):
    fixes = simulation._gnss_fixes()
    where = place.world.frame.enu_from_geodetic(*np.array([(f.lat_rad, f.lon_rad, f.height_m) for f in fixes]).T)
    true = simulation.motion.T_map_vehicle(seconds(fixes))[:, :3, 3]
    return fixes, np.linalg.norm(np.asarray(where) - true, axis=1)


def test_the_position_jumps_by_thirty_metres_and_comes_back(place):
    jumping = Faults(gnss_jump_m=30.0, gnss_jumps_per_min=12.0)
    _, off_m = gnss_off_m(drive(place, scans=150, faults=jumping), place)
    far = off_m > 1.0
    assert 0.2 < far.mean() < 0.8
    assert off_m[far] == pytest.approx(30.0, abs=0.01)
    assert off_m[~far] == pytest.approx(0.0, abs=0.01)


def test_no_position_in_an_outage(place):
    fixes, _ = gnss_off_m(drive(place, scans=100, faults=Faults(no_gnss_s=(2.0, 6.0))), place)
    t_s = seconds(fixes)
    assert not ((t_s >= 2.0) & (t_s < 6.0)).any()
    assert (t_s < 2.0).any()
    assert (t_s >= 6.0).any()


def test_the_header_is_wrong_about_the_mount_by_what_was_asked(place):
    right = drive(place).header().T_vehicle_lidar
    wrong = drive(place, faults=Faults(mount_rad=(0.0, 0.0, radians(1.0)))).header().T_vehicle_lidar
    off = T_inverse(right) @ wrong
    assert np.degrees(log_so3(off[:3, :3])) == pytest.approx([0.0, 0.0, 1.0], abs=1e-9)
    assert wrong[:3, 3] == pytest.approx(right[:3, 3])


def test_a_share_of_the_scans_never_arrives(place):
    faults, rng = Faults(missing_share=0.2), np.random.default_rng(0)
    arrives = faults.arrives(500, rng)
    assert arrives[0]
    assert 1.0 - arrives.mean() == pytest.approx(0.2, abs=0.01)
    assert Faults().arrives(50, rng).all()
    items = of(Scan, drive(place, scans=40, faults=faults).items())
    assert 28 <= len(items) <= 32


def test_dirt_gives_near_returns_or_none_in_its_sector_and_leaves_the_rest(place):
    scan = of(Scan, drive(place, scans=1).items())[0]
    faults, middle = Faults(blocked_rad=radians(60.0)), radians(20.0)
    dirty = faults.dirty(scan, middle, np.random.default_rng(0))
    azimuth = np.degrees(np.arctan2(dirty.points_m[:, 1], dirty.points_m[:, 0]))
    range_m = np.linalg.norm(dirty.points_m, axis=1)
    assert not ((azimuth > -9.9) & (azimuth < 19.9)).any()
    near = (azimuth > 20.1) & (azimuth < 49.9)
    assert near.sum() > 100
    assert range_m[near] == pytest.approx(0.3, abs=0.04)
    assert (range_m[~((azimuth > 19.9) & (azimuth < 50.1))] > 0.9).all()
    assert len(dirty.points_m) == len(dirty.t_offset_ns) == len(dirty.ring)
    assert Faults().dirty(scan, middle, np.random.default_rng(0)) is scan


@pytest.mark.parametrize(
    "wrong", [{"missing_share": 0.95}, {"blocked_rad": 7.0}, {"clock_s": 2.0}, {"gnss_jump_m": -1.0}, {"slip": np.nan}]
)
def test_faults_that_cannot_be_are_refused(wrong):
    with pytest.raises(DriveSimError):
        Faults(**wrong)


# --- the whole drive ---------------------------------------------------------------------------------------------


def test_points_of_a_scan_fall_where_the_truth_puts_them(place):
    """Noise-free poses: points of the road, taken to the street frame, lie on the road."""
    simulation = drive(place, scans=3)
    items = list(simulation.items())
    scan, mount = of(Scan, items)[2], np.eye(4)
    mount[:3, 3] = CourseConfig("VLP-16").model.mount_m
    low = scan.points_m[:, 2] < -1.7
    T = simulation.motion.T_map_vehicle(seconds([scan]) + scan.t_offset_ns[low] * 1e-9) @ mount
    points = np.einsum("kij,kj->ki", T[:, :3, :3], scan.points_m[low].astype(float)) + T[:, :3, 3]
    street = place.world.street_of_map(points)
    road = np.abs(street[:, 1]) < 4.0
    assert road.sum() > 300
    assert street[road, 2] == pytest.approx(place.world.road_height_m(street[road, 1]), abs=0.06)


def test_a_drive_is_the_same_each_time_and_another_with_another_seed(place):
    first, again, other = (list(drive(place, seed=s, scans=2).items()) for s in (1, 1, 2))
    assert np.array_equal(of(Scan, first)[1].points_m, of(Scan, again)[1].points_m)
    assert not np.array_equal(of(Scan, first)[1].points_m, of(Scan, other)[1].points_m)
    poses = of(ReferencePose, first)
    assert [p.t_ns for p in of(GnssFix, first)] == [p.t_ns for p in of(GnssFix, again)]
    assert len(poses) > 50


def test_a_drive_without_scans_or_of_an_unknown_sensor_is_refused(place):
    with pytest.raises(DriveSimError, match="at least one scan"):
        drive(place, scans=0)
    with pytest.raises(DriveSimError, match="unknown sensor"):
        CourseConfig("no-such-sensor")


# --- places ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PLACES)
def test_every_place_can_be_driven_from_end_to_end_and_is_the_same_each_time(name):
    place = place_of(name, 7)
    assert place.world == place_of(name, 7).world
    ride = cruise(np.random.default_rng(0), 6.0, min(place.lane.length_m - 2.0, 90.0))
    simulation = CourseDrive(DrivenCourse(place, ride), CourseConfig("VLP-16", 1, PERFECT, 1))
    scan = of(Scan, simulation.items())[0]
    assert len(scan.points_m) > 5000
    ends = place.world.map_of_street(np.zeros((1, 3)))
    assert np.isfinite(ends).all()


@pytest.mark.parametrize("name", PLACES)
def test_no_lane_leads_through_anything(name):
    """A clear way 2 m wide up to 1.9 m: nothing opaque or leafy reaches into it."""
    place = place_of(name, 7)
    way = np.arange(0.0, place.lane.length_m, 0.5)
    sides = np.concatenate([place.lane.beside(way, left) for left in (-1.0, 0.0, 1.0)])
    ground = place.ground.height_m(sides)
    for o in place.world.in_state("after"):
        if o.kind in ("road", "pavement"):
            continue
        for shape in o.shapes:
            x0, y0, x1, y1, _ = shape.bounds()
            bottom = shape.bottom_m if hasattr(shape, "bottom_m") else shape.z_m - shape.radius_m
            inside = (sides[:, 0] > x0) & (sides[:, 0] < x1) & (sides[:, 1] > y0) & (sides[:, 1] < y1)
            assert not (inside & (bottom < ground + 1.9)).any(), o.name
    for leaf in place.foliage.get("after", ()):
        off = np.abs(sides - [leaf.x_m, leaf.y_m]) / [leaf.half_x_m, leaf.half_y_m]
        near = (off.max(axis=1) if leaf.box else np.hypot(*off.T)) < 1.0
        assert not (near & (leaf.z_m - leaf.half_z_m < ground + 1.9)).any()


def test_a_third_is_rebuilt_and_the_state_before_is_that_of_the_street():
    street, rebuilt = place_of("street", 9), place_of("rebuilt", 9)
    assert set(rebuilt.world.shapes("before")) == set(street.world.shapes("before"))
    kept, all_of = (
        [o for o in p.world.objects if o.edit == "kept" and o.kind == "building"] for p in (rebuilt, street)
    )
    share = 1.0 - len(kept) / len(all_of)
    assert 0.1 < share < 0.45
    new = [o for o in rebuilt.world.objects if o.name.startswith("rebuilt building")]
    assert len(new) >= 3


def test_leaves_have_grown_and_trees_are_gone_in_the_avenue():
    avenue = place_of("avenue", 4)
    before, after = avenue.foliage["before"], avenue.foliage["after"]
    crowns = [sum(not leaf.box for leaf in state) for state in (before, after)]
    assert 0 < crowns[0] - crowns[1] < 0.35 * crowns[0]
    assert np.mean([leaf.half_z_m for leaf in after]) > 1.05 * np.mean([leaf.half_z_m for leaf in before])
    assert len([o for o in avenue.world.objects if o.edit == "removed"]) == crowns[0] - crowns[1]


def test_a_map_made_behind_a_van_has_its_ghost_all_along_the_lane():
    followed, street = place_of("followed", 5), place_of("street", 5)
    assert followed.world == street.world
    counts = []
    for place in (followed, street):
        points = place.world.street_of_map(np.concatenate(list(survey_points(place, 20.0))))
        lane = (np.abs(points[:, 1] + 1.75) < 0.8) & (points[:, 2] > 0.8) & (points[:, 2] < 2.3)
        counts.append(int((lane & (np.abs(points[:, 0]) < 60.0)).sum()))
    assert counts[0] > 500
    assert counts[1] < 20


def test_survey_points_lie_on_what_stands_there(place):
    few = replace(place, surveys=place.surveys[:1])
    points = place.world.street_of_map(np.concatenate(list(survey_points(few, 40.0))))
    flat = (np.abs(points[:, 1]) < 4.0) & (points[:, 2] < 0.3)
    assert flat.sum() > 1000
    assert points[flat, 2] == pytest.approx(place.world.road_height_m(points[flat, 1]), abs=0.12 + PAVEMENT_M)
