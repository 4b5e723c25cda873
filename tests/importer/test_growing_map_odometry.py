"""LiDAR odometry where it is hard: few rings, no motion given, and rings that look the same after every step."""

from pathlib import Path

import numpy as np
import pytest

from gnd.fleet_sim.drives import DriveConfig, simulate_drive
from gnd.fleet_sim.street import street
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse
from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import load_track, read_drive, read_header
from gnd.vehicle_agent.importer import no_progress
from gnd.vehicle_agent.importers.lidar_odometry import _lies_as_a_line, lidar_odometry
from gnd.vehicle_agent.importers.recording import Recording, RecordingAnchor


def recording_of(path: Path) -> Recording:
    """The scans of a drive, and nothing else of it."""
    header, scans = read_header(path), [item for item in read_drive(path) if isinstance(item, Scan)]
    anchor = RecordingAnchor(
        np.degrees(header.anchor.lat_rad), np.degrees(header.anchor.lon_rad), header.anchor.height_m
    )
    t_ns = np.array([scan.t_ns for scan in scans])
    return Recording(path.stem, header.sensor_model, "", header.T_vehicle_lidar, t_ns, scans.__getitem__, anchor)


def test_sixteen_rings_without_any_motion_given(tmp_path):
    """1.2 m a scan along a street: matching rings with rings would say that the vehicle stands."""
    config = DriveConfig("car", "VLP-16", "after", seed=2, cruise_mps=12.0, scans=25)
    path = simulate_drive(street(1), config, tmp_path / "drive.mcap")
    track = lidar_odometry(recording_of(path), no_progress)
    truth = Trajectory(*load_track(path).reference).at(track.t_ns)
    truth = T_inverse(truth[0]) @ truth
    assert np.linalg.norm(truth[-1, :3, 3]) > 24.0
    error_m = np.linalg.norm((T_inverse(truth) @ track.T_dst_vehicle)[:, :3, 3], axis=1)
    assert error_m.max() < 0.5


@pytest.mark.parametrize(
    ("cov", "line"),
    [
        ((0.08, 0.0, 0.0, 0.0004, 0.0, 0.0004), True),  # one ring on the ground
        ((0.08, 0.0, 0.0, 0.06, 0.0, 0.0004), False),  # the ground
        ((0.0004, 0.0, 0.0, 0.0004, 0.0, 0.08), False),  # a post
        ((0.06, 0.0, 0.0, 0.0004, 0.0, 0.05), False),  # a wall
    ],
)
def test_what_counts_as_a_single_ring(cov, line):
    one = Gaussians(
        np.zeros(1, np.int32), np.full(1, 50, np.int32), np.full(1, 25, np.int32), np.zeros((1, 3), np.float32),
        np.array([cov], np.float32),
    )  # fmt: skip
    assert _lies_as_a_line(one).tolist() == [line]
