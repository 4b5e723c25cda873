"""What this run reached of what was set out."""

from collections.abc import Mapping
from typing import Any

from gnd.fleet_sim.sensors import SHORT_NAMES
from studies.localisation_study import reference
from studies.localisation_study.options import looks_around
from studies.localisation_study.reference import QUANTITIES, STATISTICS, Limit


def sensors_of(found: Mapping[str, Any]) -> list[str]:
    """Return the sensors of a result."""
    return [name for name in found if name in SHORT_NAMES]


def within(row: Mapping[str, Any], limit: Limit, *statistics: str) -> bool:
    """Return whether a row's errors lie within a limit; a row without poses does not."""
    if row[QUANTITIES[0]] is None:
        return False
    return all(
        row[quantity][statistic] <= getattr(limit, statistic)[i]
        for i, quantity in enumerate(QUANTITIES)
        for statistic in statistics or STATISTICS
    )


def targets_of(found: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return for each sensor which targets it meets, and the ratio of errors after the update to those on a fresh map.

    Args:
        found: rows of each sensor by name.
    """
    return {sensor: _of_sensor(sensor, found[sensor]) for sensor in sensors_of(found)}


def _of_sensor(sensor: str, rows: Mapping[str, Any]) -> dict[str, Any]:
    around = looks_around(sensor)
    must = reference.MUST_TURNING if around else reference.MUST_WINDOW
    aim = reference.AIM_TURNING if around else reference.AIM_WINDOW
    ratio = rows["update_ratio"]
    with_submap = rows["with_submap"]
    targets: dict[str, Any] = {
        "with_submap": {"must": within(with_submap, must), "aim": within(with_submap, aim)},
        "paper_limits": {name: within(row, reference.PAPER_LIMITS) for name, row in _error_rows(rows).items()},
        "ford_local": {name: within(row, reference.FORD_LOCAL) for name, row in _error_rows(rows).items()},
        "after_update": {"ratio": ratio, "must": ratio is not None and _not_worse(ratio)},
    }
    starts = rows.get("reinitialisation")
    if starts:
        safe = starts["wrong_called_good"] == 0
        targets["reinitialisation"] = {
            "must": safe and starts["right_share"] >= reference.MUST_REINITIALISED,
            "aim": safe and starts["right_share"] >= reference.AIM_REINITIALISED,
        }
    return targets


def _error_rows(rows: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    return {name: row for name, row in rows.items() if isinstance(row, Mapping) and "coverage" in row}


def update_ratio(rows: Mapping[str, Any]) -> dict[str, float] | None:
    """Return by quantity the online 95 % error on the updated map over that on the fresh map; None without poses."""
    after, fresh = rows["after_update"], rows["fresh"]
    if after[QUANTITIES[0]] is None or fresh[QUANTITIES[0]] is None:
        return None
    return {q: round(after[q]["p95"] / max(fresh[q]["p95"], 1e-9), 4) for q in QUANTITIES}


def _not_worse(ratio: Mapping[str, float]) -> bool:
    return all(value <= reference.MUST_UPDATE_RATIO for value in ratio.values())
