"""Drives whose headers tell another mount than they were driven with."""

from math import radians
from pathlib import Path

import numpy as np
import pytest

from gnd.deploy.errors import DeployError
from gnd.deploy.fleet_config import FleetConfig
from gnd.deploy.mounts import with_wrong_mounts
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import exp_so3
from gnd.schemas.drive import DriveHeader, GnssFix, MotionSample, Scan
from gnd.schemas.drive_mcap import DriveWriter, read_drive, read_header

T_VEHICLE_LIDAR = np.eye(4)
T_VEHICLE_LIDAR[:3, :3] = exp_so3(np.array([0.1, 0.0, 0.0]))
T_VEHICLE_LIDAR[:3, 3] = 1.2, 0.0, 1.9


def write_drive(at: Path) -> Path:
    header = DriveHeader("d", "car-1", "VLP-16", LocalFrame(0.9, 0.1, 0.0), T_VEHICLE_LIDAR, "made by a test")
    points = np.random.default_rng(0).uniform(-9, 9, (200, 3)).astype(np.float32)
    with DriveWriter(at, header) as writer:
        writer.add(MotionSample(10**9, 9.0, 0.1))
        writer.add(GnssFix(10**9 + 1, 0.9, 0.1, 0.0, 1.0))
        writer.add(Scan(10**9 + 2, points, np.zeros(200, np.uint32)))
    return at


def test_the_copy_tells_a_turned_mount_and_measures_the_same(tmp_path: Path) -> None:
    drives = [write_drive(tmp_path / name) for name in ("a.mcap", "b.mcap")]
    same, turned = with_wrong_mounts(drives, {1: radians(0.5)}, tmp_path / "copies")
    assert same == drives[0]
    T = read_header(turned).T_vehicle_lidar
    np.testing.assert_allclose(T[:3, 3], T_VEHICLE_LIDAR[:3, 3])
    turn = T[:3, :3] @ T_VEHICLE_LIDAR[:3, :3].T
    np.testing.assert_allclose(turn, exp_so3(np.array([0.0, 0.0, radians(0.5)])), atol=1e-12)
    before, after = list(read_drive(drives[1])), list(read_drive(turned))
    assert [type(item) for item in before] == [type(item) for item in after]
    np.testing.assert_array_equal(before[-1].points_m, after[-1].points_m)


def test_a_vehicle_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DeployError, match="no vehicle 2: the run has 1"):
        with_wrong_mounts([write_drive(tmp_path / "a.mcap")], {2: 0.01}, tmp_path / "copies")


@pytest.mark.parametrize(
    ("text", "reason"),
    [("3", "VEHICLE:DEGREES"), ("3:x", "VEHICLE:DEGREES"), ("8:1", "there are 8"), ("3:21", "at most 20")],
)
def test_nonsense_is_refused(text: str, reason: str) -> None:
    with pytest.raises(DeployError, match=reason):
        FleetConfig(wrong_mounts=(text,))


def test_degrees_become_radians() -> None:
    assert FleetConfig(wrong_mounts=("3:0.5", "0:-1")).wrong_mounts_rad == {3: radians(0.5), 0: radians(-1.0)}
