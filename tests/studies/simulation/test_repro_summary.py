"""What the JSON of several worlds says: each world below `by_seed`, their means above."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gnd.fleet_sim.truth import LEVELS
from studies.simulation.options import RunOptions
from studies.simulation.result import VehicleResult
from studies.simulation.scores import STALE, Scored, SimulationOutcome, WorldOutcome, summary_of
from studies.simulation.worlds import WorldFiles

CHANGES = ("new", "modified", "deleted")
STATS: dict[str, Any] = {
    "scans": 10,
    "scans_used": 10,
    "scans_uncertain": 0,
    "points": 5,
    "moving_points": 1,
    "changed_voxels": 3,
    "way_m": 50.0,
    "poses": None,
    "segmentation": {},
}


def scored(right: int, wrong: int, kept: int, parked: int) -> Scored:
    """In each class so many voxels right, so many taken for the next one; `kept` of 100 are observable."""
    whole = right * np.eye(5, dtype=np.int64) + wrong * np.roll(np.eye(5, dtype=np.int64), 1, axis=1)
    levels = {"all": whole, "observable": whole * kept // 100, "scored": whole * kept // 200}
    assert set(levels) == set(LEVELS)
    where = {"false_on_parking": parked, "false_seasonal": 0, "false_elsewhere": 2}
    return Scored({level: levels[level] for level in LEVELS}, where)


def world(seed: int, right: int, parked: int) -> WorldOutcome:
    """One VLP-16 and one HDL-32E of which the second is always right."""
    drives = [VehicleResult(f"v-{s}", s, (), np.zeros(0, np.int64), {}, STATS) for s in ("vlp16", "hdl32e")]
    single = {
        STALE: scored(0, 400, 50, 0),
        "v-vlp16": scored(right, 400 - right, 50, 9),
        "v-hdl32e": scored(400, 0, 50, 0),
    }
    fleet = {1: scored(right, 400 - right, 50, 9), 2: scored(400, 0, 50, parked)}
    return WorldOutcome(
        seed, WorldFiles(Path(), "surveyed"), tuple(drives), (), (1, 2), single, fleet, ([7, 8], [7, 9]), {}
    )


def test_several_worlds_are_told_one_by_one_and_as_their_mean() -> None:
    options = RunOptions(seeds=(3, 4), vehicles=(1, 2), sensors=("vlp16", "hdl32e"), parking=0.35)
    found = summary_of(SimulationOutcome(options, (world(3, 200, 4), world(4, 400, 8)), {"total": 1.0}))
    assert found["seeds"] == [3, 4]
    assert found["parameters"]["parking"] == 0.35
    assert set(found["by_seed"]) == {"3", "4"}
    for one in (found, *found["by_seed"].values()):
        for stage in (*one["single"].values(), *one["fleet"].values()):
            assert set(stage["f1"]) == {"observable", "all", "scored"}
            assert set(stage["false_per_1000"]) == set(CHANGES)
        assert one["kept"] == {"observable": dict.fromkeys(CHANGES, 50.0), "scored": dict.fromkeys(CHANGES, 25.0)}
        assert set(one["false_per_1000"]) == set(CHANGES)
        assert one["fleet"]["2"]["f1"]["observable"] == 100.0
    half, whole = (found["by_seed"][seed]["single"]["vlp16"]["f1"]["observable"] for seed in ("3", "4"))
    assert (half, whole) == (pytest.approx(50.0), pytest.approx(100.0))
    assert found["single"]["vlp16"]["f1"]["observable"] == pytest.approx(75.0)
    assert found["single"]["hdl32e"]["f1"]["observable"] == 100.0
    assert [found["by_seed"][seed]["false_on_parking"] for seed in ("3", "4")] == [4, 8]
    assert found["false_on_parking"] == 6.0
