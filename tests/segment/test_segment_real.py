"""A junction scanned by an HDL-64E (KITTI raw, 78 scans): what drives goes, what is parked stays.

The places were found by looking at pictures of the scans from above: x along the road, y to the left, metres, in the
frame of the first scan. The vehicle rolls up behind a standing car; another car and a long lorry follow.
"""

from pathlib import Path

import numpy as np
import pytest

from gnd.vehicle_agent.importer import open_recording
from gnd.vehicle_agent.segment import MotionSegmenter, SegmentedScan
from studies.moving_objects import refined_scans, segmented

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

PARKED = (
    (-24.0, -21.0, 2.0, 5.0),
    (-8.0, -3.0, 2.0, 5.0),
    (0.5, 4.0, 2.0, 5.0),
    (5.0, 9.5, 2.0, 5.0),
    (12.0, 15.5, 2.0, 5.0),
)
HEDGE = (-20.0, 20.0, -18.0, -11.0)
FOLLOWING_CAR, LORRY = (-10.0, -4.5, -1.2, 1.2), (-21.5, -3.8, -5.5, -2.4)
"""Where they are in scan 23."""


@pytest.fixture(scope="module")
def junction(shared_data: Path) -> list[SegmentedScan]:
    folder = shared_data / "kitti_raw_0060"
    if not folder.is_dir():
        pytest.skip(f"no recording {folder.name}")
    return segmented(folder)


def within(found: SegmentedScan, box: tuple[float, float, float, float]) -> np.ndarray:
    """Whether the points over a rectangle, 0.5 to 3 m above the road, are called moving."""
    x, y, z = found.scan.points_map_m.T
    return found.moving[(x > box[0]) & (x < box[1]) & (y > box[2]) & (y < box[3]) & (z > 0.5) & (z < 3.0)]


def test_what_drives_is_removed(junction: list[SegmentedScan]) -> None:
    for box, least in ((FOLLOWING_CAR, 500), (LORRY, 2000)):
        called = within(junction[23], box)
        assert len(called) > least
        assert called.mean() > 0.95


def test_parked_cars_and_the_hedge_are_kept(junction: list[SegmentedScan]) -> None:
    for box in (*PARKED, HEDGE):
        called = np.concatenate([within(scan, box) for scan in junction[12:]])
        assert len(called) > 3000
        assert called.mean() < 0.005


def test_where_little_moves_little_is_called_moving(shared_data: Path) -> None:
    """KITTI 00: a residential street without traffic."""
    segmenter = MotionSegmenter()
    scans = refined_scans(open_recording("kitti", shared_data / "kitti00_start16"))
    found = [done for scan in scans for done in segmenter.push(scan)] + list(segmenter.flush())
    assert np.mean([scan.moving.mean() for scan in found]) < 0.003
