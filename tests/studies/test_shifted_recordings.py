"""Recordings of real sensors driven over the map of their other half: from wrong poses nothing is reported."""

from pathlib import Path

import numpy as np
import pytest

from gnd.gnd_map.accumulate import N_MIN_CELLS, VoxelAccumulator
from gnd.gnd_map.se3 import T_inverse, exp_so3, transform
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.vehicle_agent.config import ReportParameters
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.importer import no_progress, open_recording
from gnd.vehicle_agent.importers.detect_format import format_of
from gnd.vehicle_agent.importers.recording import NOMINAL
from gnd.vehicle_agent.link.outbox import Outbox
from gnd.vehicle_agent.localise.estimates import PoseEstimate, RefinedScan
from gnd.vehicle_agent.packed_rays import PlacedRays
from gnd.vehicle_agent.report.reporter import Identity, Reporter
from gnd.vehicle_agent.segment.parameters import SegmentParameters
from gnd.vehicle_agent.segment.segmenter import SegmentedScan
from studies.real.drive import local_map_of, segmented
from studies.real.scene import RecordedScene, in_range, load, place

pytestmark = pytest.mark.slow

WHO = Identity("vehicle-7", "drive-7", "real", "ndt", software="test 1")


def shift(x_m: float = 0.0, y_m: float = 0.0, yaw_deg: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = exp_so3(np.array([0.0, 0.0, np.radians(yaw_deg)]))
    T[:2, 3] = x_m, y_m
    return T


def moved(one: SegmentedScan, error: np.ndarray) -> SegmentedScan:
    """The scan as a localiser places it that is off by `error`, in the vehicle's axes, and does not know."""
    scan, T = one.scan, one.scan.estimate.T_map_vehicle
    M = T @ error @ T_inverse(T)
    pose = PoseEstimate(scan.t_ns, T @ error, 0.02, 0.001, 0.9, "good")
    refined = RefinedScan(
        scan.t_ns, PlacedRays(transform(M, scan.points_map_m), transform(M, scan.origins_map_m)), pose
    )
    return SegmentedScan(refined, one.moving)


def told(
    folder: Path, scene: RecordedScene, tiles: dict, scans: list[SegmentedScan]
) -> tuple[Reporter, list[TileChange]]:
    folder.mkdir()
    outbox = Outbox(folder / "outbox.sqlite")
    reporter = Reporter(ChangeDetector(local_map_of(scene, tiles)), outbox, WHO, scans[0].scan.t_ns, ReportParameters())
    for one in scans:
        reporter.add_scan(one)
    reporter.report_all(100.0)
    return reporter, [c for x in outbox.due(0, limit=1000) for c in ChangeReport.decode(x.body).tiles]


@pytest.mark.parametrize(("folder", "at_most"), [("kitti00_start16", 16), ("radiate_fog", 24)])
def test_a_recording_from_wrong_poses_reports_nothing_but_its_shift(
    shared_data: Path, tmp_path: Path, folder: str, at_most: int
) -> None:
    if not (shared_data / folder).is_dir():
        pytest.skip(f"{folder} is not there")
    kind = format_of(shared_data / folder)
    recording = open_recording(kind, shared_data / folder, NOMINAL if kind == "pcd" else None, None)
    scene = place(load(recording, at_most, no_progress), 0)
    points = VoxelAccumulator(scene.grid_frame)
    for one in segmented(map(scene.refined, scene.scans[::2]), SegmentParameters()):
        points.add(one.scan.points_map_m[in_range(one.scan) & ~one.moving])
    tiles, drive = (
        points.finish(N_MIN_CELLS),
        list(segmented(map(scene.refined, scene.scans[1::2]), SegmentParameters())),
    )

    reporter, right = told(tmp_path / "right", scene, tiles, [moved(one, np.eye(4)) for one in drive])
    observed = sum(len(change.observed) for change in right)
    assert reporter.counts["scans_shifted"] == reporter.counts["tiles_held_back"] == 0
    assert observed > 5000
    assert sum(len(change.changed) for change in right) <= 0.001 * observed

    for name, error in {"10 cm": shift(0.07, 0.07), "50 cm": shift(-0.5), "0.5 deg": shift(yaw_deg=0.5)}.items():
        reporter, wrong = told(tmp_path / name, scene, tiles, [moved(one, error) for one in drive])
        assert sum(len(change.observed) for change in wrong) == 0
        assert reporter.counts["tiles_held_back"] >= 5
        largest = reporter.account()
        assert largest["largest_shift_m"] == pytest.approx(np.hypot(error[0, 3], error[1, 3]), abs=0.04)
        assert largest["largest_turn_deg"] == pytest.approx(np.degrees(np.arctan2(error[1, 0], error[0, 0])), abs=0.12)
