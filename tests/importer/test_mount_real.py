"""Mounts of real recordings, forgotten and found again; run with -s for the figures."""

import dataclasses

import numpy as np
import pytest

from gnd.vehicle_agent.importer import open_recording, prepared
from gnd.vehicle_agent.importers.mounting import angles_of
from gnd.vehicle_agent.importers.recording import Recording


def forgotten(recording: Recording, first: int, last: int) -> Recording:
    """Some scans of a recording that gives neither mount nor motion; times of points are left as they are."""
    deskew = "compensated" if recording.deskew == "none" else recording.deskew
    cut = {"t_ns": recording.t_ns[first:last], "read": lambda i: recording.read(i + first)}
    return dataclasses.replace(
        recording, T_vehicle_lidar=np.eye(4), mount="assumed", deskew=deskew, motion=(), gnss=(), **cut
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("folder", "first", "last", "height_m", "angles_deg"),
    [("radiate_fog", 0, 45, 2.1, (0.0, 1.35, -90.97)), ("kitti_raw_0027", 100, 140, 1.73, (0.0, 0.0, 0.0))],
)
def test_a_forgotten_mount_of_a_real_drive(shared_data, folder, first, last, height_m, angles_deg):
    """To what car makers' drawings are good for: 5 cm, 1° of tilt, half a degree of yaw."""
    found, _ = prepared(forgotten(open_recording("auto", shared_data / folder), first, last))
    print(found.notes[-1])
    assert found.mount == "estimated"
    assert found.T_vehicle_lidar[2, 3] == pytest.approx(height_m, abs=0.05)
    off = np.degrees(angles_of(found.T_vehicle_lidar[:3, :3])) - angles_deg
    assert np.abs(off[:2]).max() < 1.0
    assert abs(off[2]) < 0.5
    assert found.mount_sigma.yaw_rad < np.radians(0.3)
