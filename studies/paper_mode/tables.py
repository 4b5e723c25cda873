"""The tables of paper mode."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from gnd.fleet_sim.truth import LEVELS
from studies.frame.tables import Sheet, fixed, seeds_named, sheet
from studies.paper_mode.figures import PAPER_FLEET_KB_PER_KM, PAPER_KB_PER_KM, PAPER_WITH, PAPER_WITHOUT
from studies.simulation import scores as reference

Found = Mapping[str, Any]
_CHANGES: Final = ("new", "modified", "deleted")


def sheets_of(found: Found, asked: Sequence[int], readings: Sequence[str]) -> list[Sheet]:
    """Return F1 by number of vehicles, classes of the largest fleet, localisation, and uploads."""
    return [_curve(found, asked, readings), _classes(found, max(asked), readings), _poses(found), _upload(found)]


def _curve(found: Found, asked: Sequence[int], readings: Sequence[str]) -> Sheet:
    columns = [f"{name}, {level}" for name in readings for level in LEVELS]
    table = sheet(f"Figure 17: macro F1 in percent, {seeds_named(found['seeds'])}", "vehicles", *columns, "paper")
    paper = {1: reference.SINGLE, **reference.FLEET_READ_OFF, **reference.FLEET}
    stale = [fixed(found[name]["stale"]["f1"][level]) for name in readings for level in LEVELS]
    table.add("stale map", *stale, reference.PAPER_STALE)
    for n in asked:
        values = [fixed(found[name]["fleet"][str(n)]["f1"][level]) for name in readings for level in LEVELS]
        table.add(n, *values, paper.get(n, ""))
    return table


def _classes(found: Found, largest: int, readings: Sequence[str]) -> Sheet:
    columns = [f"{what}, {name}" for name in _CHANGES for what in ("precision", "recall")]
    title = f"Figure 16: the three changes in the map of {largest} vehicles, observable voxels, percent"
    table = sheet(title, "reading", *columns, "false new on parking")
    for name in readings:
        stage = found[name]["fleet"][str(largest)]
        of = stage["classes"]["observable"]
        values = [fixed(of[change][what]) for change in _CHANGES for what in ("precision", "recall")]
        table.add(name, *values, fixed(stage["false_on_parking"], 1))
    return table


def _poses(found: Found) -> Sheet:
    table = sheet("Figure 15: errors of a vehicle after the fleet, 95 % (largest)", "map", "lon m", "lat m", "deg")
    rows = [*found["localisation"].items(), ("paper, with submap", PAPER_WITH), ("paper, without", PAPER_WITHOUT)]
    for name, row in rows:
        pairs = [
            (f"{q}_p95_{u}", f"{q}_max_{u}") for q, u in (("longitudinal", "m"), ("lateral", "m"), ("heading", "deg"))
        ]
        table.add(name, *(f"{row[p95]:.3f} ({row[most]:.3f})" for p95, most in pairs))
    return table


def _upload(found: Found) -> Sheet:
    table = sheet("Figure 23: kB/km up", "reading", "first vehicle", "mean of all", "all together")
    for name, values in found["upload"].items():
        table.add(name, fixed(values[0], 1), fixed(np.mean(values), 1), fixed(sum(values), 0))
    number = len(next(iter(found["upload"].values())))
    together = PAPER_FLEET_KB_PER_KM * number
    table.add("paper", PAPER_KB_PER_KM, fixed(PAPER_FLEET_KB_PER_KM, 1), fixed(together, 0), style="dim")
    return table
