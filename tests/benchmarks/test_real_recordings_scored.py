"""The three recordings of real sensors, scored: floors well below what is reached (docs/evaluation_real.md)."""

from pathlib import Path

import pytest

from benchmarks.real.options import RealOptions
from benchmarks.real.run import reproduce_real
from vehicle_agent.importer import no_progress

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("folder", "at_most", "false_per_1000"),
    [("kitti00_start16", 16, 3.0), ("radiate_fog", 40, 3.0), ("kitti_raw_0060", 40, 5.0)],
)
def test_recordings_of_real_sensors(shared_data: Path, folder: str, at_most: int, false_per_1000: float) -> None:
    if not (shared_data / folder).is_dir():
        pytest.skip(f"{folder} is not there")
    options = RealOptions(shared_data / folder, rounds=1, objects=8, at_most=at_most)
    found = reproduce_real(options, None, no_progress)
    inserted, untouched = found["inserted"], found["untouched"]
    assert inserted["new"]["true"] >= 8
    assert inserted["deleted"]["true"] >= 8
    assert inserted["new"]["recall"] >= 0.7
    assert inserted["deleted"]["recall"] >= 0.85
    assert inserted["new"]["precision_near_objects"] >= 0.9
    assert untouched["false_per_1000"] <= false_per_1000
