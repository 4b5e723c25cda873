"""Rows of a study as the tests of its tables and pictures need them."""

from typing import Any

from studies.localisation_study import series as reference
from studies.localisation_study.summary import ROWS, update_ratio

START = {"trials": 40, "right": 39, "right_share": 0.975, "never_good": 1, "wrong_called_good": 0}


def row(lon: float, lat: float, heading: float, *, longest: float = 2.0) -> dict[str, Any]:
    errors = zip(reference.QUANTITIES, (lon, lat, heading), strict=True)
    found: dict[str, Any] = {name: {"p95": value, "max": longest * value} for name, value in errors}
    return found | {"poses": 330, "scans": 340, "coverage": 330 / 340, "good_share": 1.0, "wrong_called_good": 0}


def no_pose() -> dict[str, Any]:
    found: dict[str, Any] = dict.fromkeys(reference.QUANTITIES)
    return found | {"poses": 0, "scans": 340, "coverage": 0.0, "good_share": 0.0, "wrong_called_good": 0}


def sensor(**rows: dict[str, Any]) -> dict[str, Any]:
    found = {name: row(0.01, 0.01, 0.02) for name in ROWS} | rows
    found["update_ratio"] = update_ratio(found)
    found["reinitialisation"] = START | {"good_after_s": {"p50": 0.2, "p95": 1.0}}
    return found


def result(**sensors: dict[str, Any]) -> dict[str, Any]:
    world = {"length_m": 300.0, "edits": {"kept": 300, "added": 20, "removed": 10}, "changed_share": 0.21}
    return {**sensors, "seeds": {"1": {"world": world}, "2": {"world": world}}}
