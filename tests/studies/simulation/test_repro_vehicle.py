from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gnd.fleet_sim.drives import DriveSimulation, simulate_drive
from gnd.fleet_sim.street import StreetOptions
from gnd.fleet_sim.world import read_world
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.se3 import log_so3
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport
from gnd.schemas.drive import DriveHeader, ReferencePose, Scan
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.vehicle_agent.local_map import LocalMap
from studies.frame.folder import StudyFolder
from studies.simulation.base_map import read_base
from studies.simulation.options import MethodParameters, PoseSource, RunOptions
from studies.simulation.poses import TIME_CONSTANT_S, FromReference
from studies.simulation.result import VehicleResult, VoxelRows
from studies.simulation.streams import as_recorded
from studies.simulation.vehicle import VehicleTask, drive
from studies.simulation.worlds import WorldFiles, vehicle_tasks, world_files

Finished = tuple[Path, dict[str, Any]]


@pytest.fixture(scope="module")
def world(finished: Finished) -> tuple[WorldFiles, VehicleTask]:
    """The files of the world, and the first vehicle's work."""
    options = RunOptions((5,), StreetOptions(100.0, "wangsimni"), (1,), ("rs16",), traffic=False, scans=30, pcd=False)
    files = world_files(StudyFolder(finished[0]), 5, options)
    return files, vehicle_tasks(options, 5, files)[0]


def run(task: VehicleTask, header: DriveHeader, items: Any) -> VehicleResult:
    return drive(header, items, read_base(task.base), VoxelRows.read(task.voxels), task)


def simulated(task: VehicleTask) -> VehicleResult:
    simulation = DriveSimulation(read_world(task.world), task.drive)
    return run(task, simulation.header(), map(as_recorded, simulation.items()))


@pytest.mark.parametrize(("poses", "scans"), [("noisy:4cm:0.08deg", 20), ("estimated", 30)])
def test_streaming_and_mcap_give_identical_reports(
    world: tuple[WorldFiles, VehicleTask], tmp_path: Path, poses: str, scans: int
) -> None:
    task = replace(world[1], poses=PoseSource.parse(poses), drive=replace(world[1].drive, scans=scans))
    path = simulate_drive(read_world(task.world), task.drive, tmp_path / "drive.mcap")
    assert read_header(path) == DriveSimulation(read_world(task.world), task.drive).header()
    from_file = run(task, read_header(path), read_drive(path))
    streamed = simulated(task)
    assert streamed.reports == from_file.reports
    assert len(streamed.reports) > 0
    assert all(np.array_equal(streamed.evidence[name], column) for name, column in from_file.evidence.items())


def test_reports_are_what_a_vehicle_uploads(world: tuple[WorldFiles, VehicleTask]) -> None:
    result = simulated(world[1])
    report = ChangeReport.decode(result.reports[0])
    assert (report.vehicle, report.sensor_model, report.layer) == ("vehicle-00", "RS-LiDAR-16", "ndt")
    base = read_base(world[1].base)
    assert all(change.base_sha == base.shas.get(change.tile, b"") for change in report.tiles)
    assert sum(len(change.changed) for change in report.tiles) == result.stats["changed_voxels"]


def test_parameters_reach_the_detector(world: tuple[WorldFiles, VehicleTask]) -> None:
    strict = MethodParameters().with_changes(["detect.new_cells=200"])
    new = [simulated(replace(world[1], method=m)).stats["classes"]["new"] for m in (MethodParameters(), strict)]
    assert new[1] < new[0] / 2


def still(n: int) -> tuple[DriveHeader, LocalMap, list[ReferencePose | Scan]]:
    """A vehicle that stands, `n` reference poses at 100 Hz and a scan every half second."""
    frame = LocalFrame(0.6, 2.2, 30.0)
    tile = TileId.from_geodetic(frame.lat_rad, frame.lon_rad)
    header = DriveHeader("still", "still", "VLP-16", frame, np.eye(4))
    points = np.array([[10.0, 0.0, 0.0]], np.float32)
    items: list[ReferencePose | Scan] = []
    for k in range(n):
        items.append(ReferencePose(k * 10_000_000, np.eye(4)))
        if k % 50 == 0:
            items.append(Scan(k * 10_000_000, points, np.zeros(1, np.uint32)))
    return header, LocalMap(GridFrame.around(frame, [tile])), items


def test_noise_of_poses_has_its_sigmas_and_time_constant() -> None:
    header, local_map, items = still(40_000)
    poses = FromReference(header, local_map, PoseSource.parse("noisy:4cm:0.08deg"), 7)
    T = np.array([scan.estimate.T_map_vehicle for item in items for scan in poses.push(item)])
    assert len(T) > 790
    offset, turn = T[:, :3, 3], np.degrees(log_so3(T[:, :3, :3]))
    assert offset.std(axis=0) == pytest.approx([0.04, 0.04, 0.02], rel=0.2)
    assert turn.std(axis=0) == pytest.approx([0.04, 0.04, 0.08], rel=0.2)
    x = np.concatenate([offset, turn], axis=1) / np.array([0.04, 0.04, 0.02, 0.04, 0.04, 0.08])
    for lag in (1, 4):  # of 0.5 s
        assert np.mean(x[:-lag] * x[lag:]) == pytest.approx(np.exp(-0.5 * lag / TIME_CONSTANT_S), abs=0.12)


def test_true_poses_are_the_reference(world: tuple[WorldFiles, VehicleTask]) -> None:
    result = simulated(replace(world[1], poses=PoseSource.parse("true"), drive=replace(world[1].drive, scans=5)))
    assert result.stats["poses"]["lateral_max_m"] < 1e-4
    assert result.stats["poses"]["heading_max_deg"] < 1e-3
