"""Drives with every sensor: rates, mounts, empty scans, and memory that does not grow with the drive."""

import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sim_worlds import small_world

from gnd.fleet_sim.drives import EPOCH_NS, PERFECT, DriveConfig, DriveSimulation, simulate_drive
from gnd.fleet_sim.sensors import MODELS
from gnd.fleet_sim.traffic import Traffic
from gnd.fleet_sim.world import World
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.schemas.drive import ReferencePose, Scan
from gnd.schemas.drive_mcap import load_track, read_drive, read_header

BASE = DriveConfig(vehicle="v-1", sensor="VLP-16", seed=3, scans=3, errors=PERFECT, traffic=Traffic.urban())


@pytest.mark.parametrize("name", MODELS)
def test_a_drive_with_each_sensor_is_written_and_read_and_lies_on_the_street(
    street_1: World, tmp_path: Path, name: str
) -> None:
    config = replace(BASE, sensor=name, car_share=0.0)
    path = simulate_drive(street_1, config, tmp_path / "drive.mcap")
    header, track = read_header(path), load_track(path).reference
    assert header.sensor_model == name
    np.testing.assert_allclose(header.T_vehicle_lidar[:3, 3], MODELS[name].mount_m)
    poses = Trajectory(track.t_ns, track.T_map_vehicle)
    scans = [item for item in read_drive(path) if isinstance(item, Scan)]
    assert [scan.t_ns for scan in scans] == [EPOCH_NS + k * MODELS[name].period_ns for k in range(3)]
    for scan in scans:
        points = deskew(scan.points_m, scan.t_offset_ns, scan.t_ns, poses, header.T_vehicle_lidar, scan.t_ns)
        T = poses.at(scan.t_ns)
        street = street_1.street_of_map(points @ T[:3, :3].T + T[:3, 3])
        assert np.all(street[:, 2] > -1.2), "nothing lies under the road, but for noise"
        facade = (np.abs(street[:, 1]) > 9.0) & (np.abs(street[:, 1]) < 12.0)
        assert facade.sum() > 20, "every sensor sees the buildings"


def test_the_scala_scans_25_times_a_second_to_the_end_of_the_street(street_1: World) -> None:
    fast, slow = (DriveSimulation(street_1, replace(BASE, sensor=s, scans=None)) for s in ("Scala", "VLP-16"))
    assert abs(fast.scans - 2.5 * slow.scans) < 3.0
    poses = list(DriveSimulation(street_1, replace(BASE, sensor="Scala")).items())
    assert max(p.t_ns for p in poses if isinstance(p, ReferencePose)) > EPOCH_NS + 3 * 40_000_000


def test_the_height_of_the_mount_can_be_given() -> None:
    assert replace(BASE, sensor="Scala").T_vehicle_lidar[2, 3] == 0.6
    assert replace(BASE, sensor="Scala", mount_height_m=1.1).T_vehicle_lidar[:3, 3].tolist() == [3.6, 0.0, 1.1]
    assert BASE.T_vehicle_lidar[:3, 3].tolist() == [1.2, 0.0, 1.9]


def test_scans_in_which_nothing_was_seen_are_written_and_read(tmp_path: Path) -> None:
    """A Scala on a mast looks over everything."""
    config = replace(BASE, sensor="Scala", mount_height_m=60.0, traffic=Traffic(), car_share=0.0)
    labels: list[int] = []
    simulation = DriveSimulation(small_world(), config)
    seen = [item for item in simulation.items(lambda _, moving: labels.append(len(moving))) if isinstance(item, Scan)]
    assert [len(scan) for scan in seen] == labels == [0, 0, 0]
    path = simulate_drive(small_world(), config, tmp_path / "empty.mcap")
    read = [item for item in read_drive(path) if isinstance(item, Scan)]
    assert [len(scan) for scan in read] == [0, 0, 0]
    assert [scan.t_ns for scan in read] == [scan.t_ns for scan in seen]


def test_memory_does_not_grow_with_the_drive(street_1: World) -> None:
    """Scans of an HDL-64E have about 2 MB; after the first few, the most that is held at once stays as it is."""
    items = DriveSimulation(street_1, replace(BASE, sensor="HDL-64E", scans=12)).items()
    tracemalloc.start()
    try:
        peaks = []
        for _ in (scan for scan in items if isinstance(scan, Scan)):
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.reset_peak()
    finally:
        tracemalloc.stop()
    assert max(peaks[6:]) < 1.2 * max(peaks[1:6])
    assert max(peaks) < 120e6
