"""Tracks that are wrong although every number can be read: each kind is found, and a right one is let through."""

from dataclasses import replace

import numpy as np
import pytest

from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_from_R_t, exp_so3
from gnd.schemas.drive import GnssFix, MotionSample
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.cleaning import RawScan
from gnd.vehicle_agent.importers.recording import Recording, RecordingAnchor
from gnd.vehicle_agent.importers.suspicions import check_track, suspicious_scans

ANCHOR = RecordingAnchor(35.6586, 139.7454, 40.0)
START = 1_700_000_000_000_000_000
N, SPEED, RATE = 300, 8.0, 0.08
SIGMA_M = 0.5


def curve() -> Trajectory:
    """30 s at 8 m/s through a left bend, then a right one."""
    t_s = 0.1 * np.arange(N)
    rate = np.where(t_s < 12.0, RATE, -0.5 * RATE)
    yaw = np.cumsum(rate) * 0.1
    p = np.cumsum(np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(N)]), axis=0) * SPEED * 0.1
    R = exp_so3(np.column_stack([np.zeros((N, 2)), yaw]))
    return Trajectory(START + np.round(t_s * 1e9).astype(np.int64), T_from_R_t(R, p))


def fixes(track: Trajectory, late_ns: int = 0) -> tuple[GnssFix, ...]:
    rng = np.random.default_rng(3)
    p = track.T_dst_vehicle[::10, :3, 3] + rng.normal(0.0, SIGMA_M, (len(track.t_ns[::10]), 3))
    lat, lon, height = ANCHOR.frame.geodetic_from_enu(p)
    rows = zip(track.t_ns[::10] + late_ns, lat, lon, height, strict=True)
    return tuple(GnssFix(int(t), float(a), float(o), float(h), SIGMA_M) for t, a, o, h in rows)


def recording(way: Trajectory, **known) -> Recording:
    empty = RawScan(START, np.zeros((0, 3), np.float32), np.zeros(0, np.uint32))
    return Recording("drive", "test", "a test", np.eye(4), way.t_ns, lambda _: empty, ANCHOR, **known)


def scaled(track: Trajectory, axes) -> Trajectory:
    T = track.T_dst_vehicle.copy()
    T[:, :3, 3] *= axes
    return Trajectory(track.t_ns, T)


def test_a_right_track_says_nothing():
    track = curve()
    rates = np.gradient(np.unwrap(np.arctan2(track.T_dst_vehicle[:, 1, 0], track.T_dst_vehicle[:, 0, 0])), 0.1)
    motion = tuple(MotionSample(int(t), SPEED, float(w)) for t, w in zip(track.t_ns, rates, strict=True))
    assert check_track(recording(track, gnss=fixes(track), motion=motion), track) == ()


@pytest.mark.parametrize(("factor", "unit"), [(1 / 0.3048, "ft"), (100.0, "cm"), (1000.0, "mm")])
def test_other_units(factor, unit):
    track = curve()
    with pytest.raises(ImportDriveError, match=f"the coordinates count {unit}; give --units {unit}"):
        check_track(recording(track, gnss=fixes(track)), scaled(track, factor))


def test_another_scale_that_is_no_unit():
    track = curve()
    with pytest.raises(ImportDriveError, match=r"went 1\.5\d times as far as by the fixes: other units"):
        check_track(recording(track, gnss=fixes(track)), scaled(track, 1.55))


def test_mirrored_axes_against_the_fixes():
    track = curve()
    with pytest.raises(ImportDriveError, match="axes of the points or poses has the wrong sign"):
        check_track(recording(track, gnss=fixes(track)), scaled(track, [1.0, -1.0, 1.0]))


def test_mirrored_axes_against_the_yaw_rate():
    track = curve()
    rates = np.where(np.arange(N) < 120, -RATE, 0.5 * RATE)
    motion = tuple(MotionSample(int(t), SPEED, float(w)) for t, w in zip(track.t_ns, rates, strict=True))
    with pytest.raises(ImportDriveError, match=r"turn against the measured yaw rate \(correlation -0\.9\d|-1\.00"):
        check_track(recording(track, motion=motion), track)


@pytest.mark.parametrize(("late_s", "what"), [(18, "GPS time less UTC"), (-18, "GPS time less UTC")])
def test_fixes_of_another_clock(late_s, what):
    track = curve()
    wrong = recording(track, gnss=fixes(track, late_s * 1_000_000_000), track=track)
    with pytest.raises(ImportDriveError, match=what):
        check_track(wrong, track)


def test_poses_of_another_place():
    track = curve()
    there = Trajectory(
        track.t_ns, track.T_dst_vehicle + T_from_R_t(np.zeros((3, 3)), [900.0, 0.0, 0.0]) * [[1], [1], [1], [0]]
    )
    with pytest.raises(ImportDriveError, match=r"poses lie 9\d\d\.\d m \(median\) from the GNSS fixes"):
        check_track(recording(track, gnss=fixes(track), track=there), there)
    found = check_track(recording(track, gnss=fixes(track)), there)  # LiDAR odometry laid badly: a warning
    assert found[0].startswith("warning: the track lies 9")


def test_two_million_points_are_named():
    many = RawScan(START, np.ones((2_000_000, 3), np.float32), np.zeros(2_000_000, np.uint32))
    notes = suspicious_scans(replace(recording(curve()), read=lambda _: many))
    assert notes[0] == "warning: scan 0 has 2000000 points: is it a sweep, or a piece of a map?"
    more = RawScan(START, np.ones((4_000_001, 3), np.float32), np.zeros(4_000_001, np.uint32))
    with pytest.raises(ImportDriveError, match="4000001 points, 4000000 at most"):
        suspicious_scans(replace(recording(curve()), read=lambda _: more))
