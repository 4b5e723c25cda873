"""Mounts that were forgotten are found again within what they are said to be known; what cannot be seen is refused."""

import dataclasses

import numpy as np
import pytest
from sweep_testing import drive_of, mounted_otherwise, recording_of, scans_of, truth_of

from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_from_R_t, exp_so3, log_so3
from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import read_header
from gnd.vehicle_agent.importer import prepared
from gnd.vehicle_agent.importers.mount import (
    GroundSeen,
    MountRefused,
    YawSeen,
    ground_of,
    ground_of_scans,
    yaw_of_track,
)
from gnd.vehicle_agent.importers.mounting import angles_of, levelled, with_mount


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A drive of 70 m that begins and ends in motion."""
    return drive_of(tmp_path_factory.mktemp("mount") / "drive.mcap", scans=60)


def mount_of(path, roll_deg, pitch_deg, yaw_deg):
    """A LiDAR at the place of the drive's, turned."""
    R = exp_so3([0, np.radians(pitch_deg), 0]) @ exp_so3([np.radians(roll_deg), 0, 0])
    return T_from_R_t(R @ exp_so3([0, 0, np.radians(yaw_deg)]), read_header(path).T_vehicle_lidar[:3, 3])


@pytest.mark.slow
@pytest.mark.parametrize("angles_deg", [(0.0, 0.0, 0.0), (1.5, -2.0, 40.0), (-3.0, 1.0, -90.97)])
def test_a_forgotten_mount_is_found(drive, angles_deg):
    truth = mount_of(drive, *angles_deg)
    change = mounted_otherwise(drive, truth)
    recording, track = prepared(recording_of(drive, change, T_vehicle_lidar=np.eye(4), mount="assumed"))
    sigma, found = recording.mount_sigma, recording.T_vehicle_lidar
    assert recording.mount == "estimated"
    assert found[2, 3] == pytest.approx(truth[2, 3], abs=min(0.05, 3.0 * sigma.height_m))
    off = np.abs(np.array(angles_of(found[:3, :3])) - angles_of(truth[:3, :3]))
    assert (off < 3.0 * np.array(sigma[1:])).all(), (np.degrees(off), np.degrees(sigma[1:]))
    assert (np.degrees(off) < 0.6).all()
    assert any("mount estimated from the scans: LiDAR 1." in note for note in recording.notes)
    way = track.T_dst_vehicle[-1, :3, 3] - track.T_dst_vehicle[0, :3, 3]
    assert abs(np.degrees(np.arctan2(way[1], way[0]))) < 10.0  # it drives where it looks


def track_of(T):
    return Trajectory(np.arange(len(T), dtype=np.int64) * 100_000_000, T)


def way_of(n=40, step_m=1.0, turn_rad=0.0, crab_rad=0.0):
    T = np.tile(np.eye(4), (n, 1, 1))
    step = T_from_R_t(exp_so3([0, 0, turn_rad]), [step_m * np.cos(crab_rad), step_m * np.sin(crab_rad), 0.0])
    for k in range(1, n):
        T[k] = T[k - 1] @ step
    return T


@pytest.mark.parametrize("yaw_deg", [0.0, 30.0, -90.97, 179.5])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_yaw_from_driving_straight(yaw_deg, direction):
    """Course in the LiDAR's axes is the negative of its yaw; the last third is driven backwards."""
    T = way_of(40, 1.0, 0.0, -np.radians(yaw_deg))
    back = way_of(14, -1.0, 0.0, -np.radians(yaw_deg))
    T = np.concatenate([T, T[-1] @ back[1:]]) if direction < 0 else T
    seen = yaw_of_track(T)
    assert isinstance(seen, YawSeen)
    assert abs(np.angle(np.exp(1j * (seen.yaw_rad - np.radians(yaw_deg))))) < 1e-6
    assert seen.sigma_rad >= np.radians(0.1)


def test_yaw_is_refused_where_nothing_tells_it():
    assert "0 m driven straight" in yaw_of_track(np.tile(np.eye(4), (50, 1, 1))).reason
    assert "driven straight" in yaw_of_track(way_of(30, 1.0, 0.1)).reason  # a roundabout
    to_and_fro = np.concatenate([way_of(30), way_of(30)[::-1]])
    assert "which way is forward" in yaw_of_track(to_and_fro).reason
    rng = np.random.default_rng(1)
    sliding = way_of(60)
    sliding[:, 1, 3] += np.cumsum(rng.normal(0, 0.5, 60))
    assert isinstance(yaw_of_track(sliding), MountRefused)


def plane(height_m, normal, n=6000, reach_m=12.0, seed=0):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-reach_m, reach_m, (n, 2))
    z = -(height_m + xy @ normal[:2]) / normal[2]
    return np.column_stack([xy, z]) + rng.normal(0, 0.01, (n, 3))


def test_ground_of_one_scan_among_roofs_and_walls():
    R = exp_so3([0, np.radians(2.0), 0]) @ exp_so3([np.radians(-1.0), 0, 0])
    normal = R.T @ [0.0, 0.0, 1.0]
    wall = np.random.default_rng(1).uniform((-10, 5, -1.5), (10, 5.1, 4), (8000, 3))
    roof = np.random.default_rng(2).uniform((2, -4, -0.4), (6, -2, -0.38), (4000, 3))
    seen = ground_of(np.concatenate([plane(1.8, normal), wall, roof]))
    assert isinstance(seen, GroundSeen)
    assert seen.height_m == pytest.approx(1.8, abs=0.01)
    np.testing.assert_allclose(np.degrees([seen.roll_rad, seen.pitch_rad]), [-1.0, 2.0], atol=0.1)


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.zeros((0, 3)), "0 places"),
        (np.random.default_rng(0).uniform((-10, 5, -1.5), (10, 5.1, 4), (8000, 3)), "0 places"),
        (plane(8.0, np.array([0, 0, 1.0])), "lies 8.00 m below"),
        (np.random.default_rng(0).uniform((-9, -9, -3), (9, 9, 3), (9000, 3)), "places"),
        (plane(1.5, np.array([0.6, 0.0, 0.8])), "plane"),
    ],
)
def test_no_ground_is_refused(points, reason):
    seen = ground_of(points)
    assert isinstance(seen, MountRefused)
    assert reason in seen.reason


def test_scans_that_disagree_are_refused():
    seen = [GroundSeen(height, 0.0, 0.0) for height in (1.0, 1.4, 1.8, 2.2, 2.6, 3.0)]
    assert "agree" in ground_of_scans(seen).reason
    assert "1 of 2 scans" in ground_of_scans([seen[0], MountRefused("nothing")]).reason
    assert ground_of_scans([GroundSeen(1.7, 0.0, 0.0)] * 5 + seen[:2]).height_m == 1.7


def without_ground(scan: Scan) -> Scan:
    high = scan.points_m[:, 2] > -0.5
    return Scan(scan.t_ns, np.ascontiguousarray(scan.points_m[high]), scan.t_offset_ns[high])


def test_a_recording_without_ground_keeps_its_mount_and_says_so(drive):
    recording = levelled(recording_of(drive, without_ground, T_vehicle_lidar=np.eye(4), mount="assumed"))
    assert recording.mount == "assumed"
    assert recording.mount_sigma is None
    np.testing.assert_array_equal(recording.T_vehicle_lidar, np.eye(4))
    assert "mount not given and not found" in recording.notes[0]


def test_a_vehicle_that_stands_gives_height_but_no_yaw(drive):
    recording = levelled(recording_of(drive, lambda scan: scan, T_vehicle_lidar=np.eye(4), mount="assumed"))
    stands = track_of(np.tile(np.eye(4), (50, 1, 1)))
    found, track = with_mount(recording, stands)
    assert found.mount == "estimated"
    assert found.mount_sigma.yaw_rad == np.inf
    assert found.T_vehicle_lidar[2, 3] == pytest.approx(1.9, abs=0.05)
    assert "yaw is not known" in found.notes[-1]
    np.testing.assert_array_equal(track.T_dst_vehicle, stands.T_dst_vehicle)


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        ((0.0, 0.0, 0.0, 0.0), None),
        ((0.3, 0.0, 0.0, 0.0), "height"),
        ((0.0, 2.0, 0.0, 0.0), "roll"),
        ((0.0, 0.0, -2.0, 0.0), "pitch"),
        ((0.0, 0.0, 0.0, 2.0), "yaw"),
    ],
)
def test_a_given_mount_that_is_wrong_is_warned_of(drive, wrong, word):
    """The header is wrong by that much; poses of the LiDAR are the true ones."""
    truth, header = truth_of(drive), read_header(drive).T_vehicle_lidar
    height, *angles = wrong
    told = mount_of(drive, *angles)
    told[2, 3] += height
    recording = recording_of(drive, lambda scan: scan, T_vehicle_lidar=told)
    t_ns = np.array([scan.t_ns for scan in scans_of(drive)])
    track = Trajectory(t_ns, truth.at(t_ns) @ header @ np.linalg.inv(told))
    notes = with_mount(recording, track)[0].notes
    assert len(notes) == (word is not None)
    if word:
        assert f"{word} " in notes[0]
        assert "given mount does not fit" in notes[0]


def test_angles_of_a_mount_are_those_it_was_made_of():
    for roll, pitch, yaw in np.random.default_rng(0).uniform(-0.3, 0.3, (20, 3)):
        R = exp_so3([0, pitch, 0]) @ exp_so3([roll, 0, 0]) @ exp_so3([0, 0, 5 * yaw])
        np.testing.assert_allclose(angles_of(R), [roll, pitch, 5 * yaw], atol=1e-9)
        assert np.linalg.norm(log_so3(R)) > 0.0


def test_an_own_track_follows_the_mount(drive):
    """Poses of a recording are the LiDAR's: they stay where they are, and the vehicle is on the ground beneath."""
    truth, header = truth_of(drive), read_header(drive).T_vehicle_lidar
    t_ns = np.array([scan.t_ns for scan in scans_of(drive)])
    lidar = truth.at(t_ns) @ header
    track = Trajectory(t_ns, lidar)
    recording = recording_of(drive, lambda scan: scan, T_vehicle_lidar=np.eye(4), mount="assumed", track=track)
    found, moved = prepared(recording)
    np.testing.assert_allclose(moved.T_dst_vehicle @ found.T_vehicle_lidar, lidar, atol=1e-9)
    np.testing.assert_allclose(moved.T_dst_vehicle[:, 2, 3], truth.at(t_ns)[:, 2, 3], atol=0.06)
    assert dataclasses.asdict(found)["mount"] == "estimated"
