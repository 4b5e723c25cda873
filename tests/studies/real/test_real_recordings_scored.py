"""Recordings of real sensors, scored: floors below what is reached (docs/evaluation_real.md)."""

from pathlib import Path

import pytest

from gnd.vehicle_agent.importer import no_progress
from studies.real.study import RealOptions, reproduce_real

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("folder", "at_most", "recall_new", "false_per_1000"),
    [("kitti00_start16", 16, 0.85, 1.0), ("radiate_fog", 40, 0.75, 1.0), ("kitti_raw_0060", 20, 0.8, 4.0)],
)
def test_recordings_of_real_sensors(
    shared_data: Path, folder: str, at_most: int, recall_new: float, false_per_1000: float
) -> None:
    if not (shared_data / folder).is_dir():
        pytest.skip(f"{folder} is not there")
    options = RealOptions(shared_data / folder, rounds=1, objects=8, at_most=at_most)
    found = reproduce_real(options, no_progress)
    inserted, untouched = found["inserted"], found["untouched"]
    assert inserted["new"]["true"] >= 5
    assert inserted["deleted"]["true"] >= 5
    assert inserted["new"]["recall"] >= recall_new
    assert inserted["deleted"]["recall"] >= 0.85
    assert inserted["new"]["precision_near_objects"] >= 0.75
    assert untouched["false_per_1000"] <= false_per_1000
