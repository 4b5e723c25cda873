"""The same run with poses of several sources: what each loses against the first."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from gnd.fleet_sim.truth import LEVELS
from studies.simulation.errors import OptionError
from studies.simulation.folder import RunFolder
from studies.simulation.pose_source import PoseSource
from studies.simulation.targets import target_single

MUST_LOSE_AT_MOST: Final = 1.0
"""Points of macro F1 that detection with the vehicles' own poses may lose against true poses."""
_DIGITS: Final = 4

Row = Mapping[str, float]


def pose_sources(text: str) -> tuple[PoseSource, ...]:
    """Read pose sources with commas between; the first is what the others are compared with.

    Raises:
        OptionError: one of them cannot be read, or comes twice.
    """
    found = tuple(PoseSource.parse(part.strip()) for part in text.split(","))
    if len(set(map(str, found))) != len(found):
        raise OptionError(f"--poses {text}: each source of poses once")
    return found


def folder_of(root: Path, source: PoseSource) -> Path:
    """Return the folder of one source's run within that of the comparison: a run of its own."""
    return root / str(source).replace(":", "-")


def share_worlds(of: Path, to: Path) -> None:
    """Copy the worlds of one run into another that has none of them yet: street, truth, base map, not the vehicles.

    Raises:
        FolderError: the other folder holds something else.
    """
    RunFolder.begun(to)
    for world in of.glob("seed-*"):
        partial = to / f".{world.name}.part"
        if not (to / world.name).exists():
            shutil.rmtree(partial, ignore_errors=True)
            shutil.copytree(world, partial, ignore=shutil.ignore_patterns("vehicles", "drives")).rename(to / world.name)


def rows_of(found: Mapping[str, Any]) -> dict[str, Row]:
    """Return macro F1 by level of every row of a finished run's table: single drives by sensor, fleets by number."""
    rows: dict[str, Row] = {f"single.{sensor}": stage["f1"] for sensor, stage in found["single"].items()}
    target = target_single(found)
    if target is not None:
        rows["single"] = target
    return rows | {f"fleet.{n}": stage["f1"] for n, stage in found["fleet"].items()}


def comparison_of(runs: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return all runs beside each other.

    Args:
        runs: the JSON of each run by the name of its source of poses; the first is compared with.

    Returns:
        `poses.<name>`: the run; `loss.<name>.<row>.<level>`: points of F1 that it loses against the first, negative
        where it gains; `worst.<name>`: the largest loss among scored voxels, its row, and whether it is small enough.
    """
    against, *others = runs
    exact = rows_of(runs[against])
    loss = {name: _losses(exact, rows_of(runs[name])) for name in others}
    return {
        "against": against,
        "poses": dict(runs),
        "loss": loss,
        "worst": {name: worst_of(rows) for name, rows in loss.items()},
    }


def _losses(exact: Mapping[str, Row], other: Mapping[str, Row]) -> dict[str, dict[str, float]]:
    return {
        row: {level: round(exact[row][level] - other[row][level], _DIGITS) for level in LEVELS}
        for row in exact
        if row in other
    }


def worst_of(loss: Mapping[str, Row]) -> dict[str, Any]:
    """Return the row that loses most among scored voxels, its points, and whether it meets `MUST_LOSE_AT_MOST`."""
    row = max(loss, key=lambda name: loss[name]["scored"])
    points = loss[row]["scored"]
    return {"row": row, "loss": points, "must": MUST_LOSE_AT_MOST, "met": points <= MUST_LOSE_AT_MOST}
