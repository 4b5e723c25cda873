"""The result as tables."""

from typing import Any

from studies.frame.tables import Sheet, fixed, sheet
from studies.real.causes import CAUSES


def sheets_of(found: dict[str, Any]) -> list[Sheet]:
    """Return what was measured: false changes, their causes, and what became of the inserted objects."""
    head = Sheet(
        f"{found['recording']}: {found['scans']} scans, {found['scans_driven']} driven in"
        f" {found['options']['rounds']} rounds, {found['runtime_s']} s",
        notes=list(found["left_out"]),
    )
    false, seen = _false_changes(found["untouched"]), found["untouched_seen"]
    false.notes.append(
        f"Where the map's half had looked: {sum(seen['false'].values()):,} of {seen['observed']:,} observed,"
        f" {fixed(seen['false_per_1000'])} of 1,000"
    )
    return [head, false, _causes(found["untouched"]["causes"]), _inserted(found["inserted"])]


def _false_changes(untouched: dict[str, Any]) -> Sheet:
    table = sheet("Nothing changed: reported nevertheless", "", "voxels", "a 1,000 observed", "a 1,000 Gaussians")
    gaussians = max(untouched["observed_gaussian"], 1)
    for name, n in untouched["false"].items():
        table.add(name, f"{n:,}", fixed(untouched["false_per_1000_by_class"][name]), f"{1000 * n / gaussians:.2f}")
    total = sum(untouched["false"].values())
    rates = fixed(untouched["false_per_1000"]), fixed(untouched["false_per_1000_gaussian"])
    table.add("all", f"{total:,}", *rates, style="bold")
    table.add("observed", f"{untouched['observed']:,}", f"{untouched['observed_gaussian']:,} Gaussians", "")
    return table


def _causes(causes: dict[str, dict[str, int]]) -> Sheet:
    table = sheet("Why", "first that holds", *causes)
    for cause, meaning in CAUSES.items():
        numbers = [counts[cause] for counts in causes.values()]
        if any(numbers):
            table.add(f"{cause}: {meaning}" if meaning else cause, *map(str, numbers))
    return table


def _inserted(inserted: dict[str, Any]) -> Sheet:
    table = sheet("Objects inserted", "", "objects", "voxels", "recall", "precision", "precision within 3 m of objects")
    for name in ("new", "deleted"):
        one = inserted[name]
        shares = (
            "–" if one[key] is None else f"{one[key]:.1%}" for key in ("recall", "precision", "precision_near_objects")
        )
        table.add(name, str(inserted["objects"][name]), str(one["true"]), *shares)
    return table
