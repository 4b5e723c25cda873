"""The study of lanes on a short street: the whole way from rays to edits, and what goes wrong when a sensor does."""

import pytest

from studies.frame.errors import RealDataError
from studies.lanes_study.driving import LaneTask, lane_drive
from studies.lanes_study.figures import draw_street
from studies.lanes_study.merging import outcome_of
from studies.lanes_study.real import kitti_paint, repeatability


@pytest.fixture(scope="module")
def task():
    return LaneTask(12, length_m=100.0)


@pytest.fixture(scope="module")
def drives(task):
    return [lane_drive(task, vehicle) for vehicle in range(3)]


@pytest.mark.slow
def test_borders_are_mapped_and_changes_become_edits(task, drives):
    found = outcome_of([task], [drives], [1, 3])
    assert found["layer"]["1"]["recall"] == 0.0  # one drive publishes nothing
    layer, edits = found["layer"]["3"], found["edits"]["3"]
    assert layer["recall"] > 0.9
    assert layer["precision"] > 0.9
    assert layer["lateral_m_p50"] < 0.06
    assert edits["wrong"] == []
    assert edits["found"] >= edits["changes"] - 1


@pytest.mark.slow
def test_the_street_is_drawn(task, drives, tmp_path):
    assert draw_street(task, drives, tmp_path / "street.png").stat().st_size > 20_000


@pytest.mark.slow
def test_a_wet_road_ends_in_silence(task):
    drive = lane_drive(LaneTask(task.seed, length_m=100.0, wet=True, sensor="VLP-16"), 0)
    absent = [
        seen for one in drive.with_map for tile in one.tiles for seen in tile.seen if seen.existence.state == "absent"
    ]
    # the camera still sees; what it sees is told, and nothing that the LiDAR misses is denied for that alone
    assert len(absent) <= 12


def test_paint_of_a_real_street_repeats(shared_data):
    found, even, odd = repeatability(kitti_paint(shared_data / "kitti00_start16"))
    assert found["way_m"] == pytest.approx(12.9, abs=0.5)
    assert len(even) + len(odd) < 12  # a residential street without painted lanes: next to nothing is taken for paint


def test_a_folder_without_scans_is_refused(tmp_path):
    with pytest.raises(RealDataError, match="0 scans"):
        kitti_paint(tmp_path)


@pytest.mark.slow
def test_a_camera_that_is_off_is_found_out_by_the_lidar(task, drives):
    off = lane_drive(LaneTask(task.seed, length_m=100.0, camera_off_m=0.25), 0)
    assert off.counts["camera_off_m"] - drives[0].counts["camera_off_m"] == pytest.approx(0.25, abs=0.04)
    there = [
        seen for one in off.with_map for tile in one.tiles for seen in tile.seen if seen.existence.state == "exist"
    ]
    assert len(there) >= 20
