"""A real recording over the map of its first half: what one vehicle says of other viewpoints is not published."""

from pathlib import Path

import pytest

from studies.real_gate import run


@pytest.mark.slow
def test_of_other_viewpoints_much_is_reported_and_nothing_published_where_the_map_had_looked(shared_data: Path) -> None:
    folder = shared_data / "kitti00_start16"
    if not folder.is_dir():
        pytest.skip("kitti00_start16 is not there")
    found = run(folder, "first-half", "second-half", 16, "reference")
    everything, seen = found["all"], found["seen"]
    assert everything["observed"] > seen["observed"] > 5000
    assert everything["of_1000"]["reported"] > 5.0  # or the gate would have nothing to hold
    assert sum(everything["reported"].values()) > sum(seen["reported"].values())
    assert seen["of_1000"]["published"] <= 1.0
    assert everything["of_1000"]["published"] <= 5.0
    assert sum(found["waiting"].values()) >= sum(everything["reported"].values()) - sum(
        everything["published"].values()
    )
