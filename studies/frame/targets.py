"""Our numbers beside the papers' and what we set out to reach."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from studies.frame.tables import Sheet, sheet


@dataclass(frozen=True, slots=True)
class Target:
    """One row: the value at `path` (with dots) shall be at most `must` (at least, where `larger`)."""

    name: str
    path: str
    unit: str
    paper: str
    must: float
    aim: float
    larger: bool = False

    def is_met(self, value: float, limit: float) -> bool:
        """Return whether a value is good enough."""
        return value >= limit if self.larger else value <= limit


def judged(found: Mapping[str, Any], targets: Sequence[Target]) -> dict[str, dict[str, Any]]:
    """Return each target that a result can judge: our value, the paper's, must and aim, and which of them are met."""
    rows = {}
    for target in targets:
        value = at_path(found, target.path)
        if value is not None:
            rows[target.name] = {
                "value": round(value, 4),
                "unit": target.unit,
                "paper": target.paper,
                "must": target.must,
                "aim": target.aim,
                "larger_is_better": target.larger,
                "met": target.is_met(value, target.must),
                "aim_met": target.is_met(value, target.aim),
            }
    return rows


def at_path(values: Mapping[str, Any], path: str) -> float | None:
    """Return the number at a path with dots between; None where there is none."""
    found: Any = values
    for name in path.split("."):
        found = found.get(name) if isinstance(found, Mapping) else None
    return None if found is None else float(found)


def targets_sheet(rows: Mapping[str, Mapping[str, Any]], title: str) -> Sheet:
    """Return the targets as a table."""
    table = sheet(title, "", "ours", "paper", "must", "aim", "met")
    for name, row in rows.items():
        sign = "≥" if row["larger_is_better"] else "≤"
        met = "aim" if row["aim_met"] else "yes" if row["met"] else "NO"
        limits = (f"{sign} {row[limit]:g}" for limit in ("must", "aim"))
        style = "" if row["met"] else "red"
        table.add(name, f"{row['value']:.3f} {row['unit']}", row["paper"], *limits, met, style=style)
    return table
