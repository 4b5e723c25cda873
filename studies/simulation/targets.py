"""Our results beside what we set out to reach."""

from collections.abc import Mapping
from typing import Any

from gnd.fleet_sim.truth import LEVELS
from studies.simulation import reference


def target_single(found: Mapping[str, Any]) -> dict[str, float] | None:
    """Return the mean F1 of one drive over the 16- and 32-layer sensors that drove, by level; None if none did."""
    stages = [found["single"][sensor] for sensor in reference.TARGET_SENSORS if sensor in found["single"]]
    if not stages:
        return None
    return {level: sum(stage["f1"][level] for stage in stages) / len(stages) for level in LEVELS}


def targets_of(found: Mapping[str, Any]) -> dict[str, dict[str, float | bool]]:
    """Return each target that this run can judge: our value, what it must reach and aims at, and whether it does."""
    values: dict[str, float] = {}
    single = target_single(found)
    if single is not None:
        values["single"] = single["scored"]
    for n, stage in found["fleet"].items():
        values[f"fleet.{n}"], values[f"fleet.{n}.all"] = stage["f1"]["scored"], stage["f1"]["all"]
    return {
        name: {"value": round(values[name], 4), "must": must, "aim": reference.AIM[name], "met": values[name] >= must}
        for name, must in reference.MUST.items()
        if name in values
    }
