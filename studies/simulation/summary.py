"""A finished reproduction as plain values: the JSON of `gnd reproduce simulation`."""

import statistics
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from gnd.fleet_sim.evaluate import CLASSES
from gnd.fleet_sim.truth import LEVELS
from gnd.gnd_map.config import to_mapping
from studies.simulation.run import Outcome, WorldOutcome, plain_options
from studies.simulation.scoring import STALE, Scored
from studies.simulation.targets import targets_of

_DIGITS = 4
_OF_A_DRIVE = (
    "scans", "scans_used", "scans_uncertain", "points", "moving_points", "changed_voxels", "way_m", "poses",
    "segmentation",
)  # fmt: skip


def summary_of(outcome: Outcome) -> dict[str, Any]:
    """Return everything as plain values; of several seeds the means, and each below `by_seed`."""
    by_seed = {str(world.seed): _world_summary(world) for world in outcome.worlds}
    found = mean_of(list(by_seed.values()))
    found["targets"] = targets_of(found)
    found["confusion"] = confusion_of(outcome.worlds)
    found["parameters"] = parameters_of(outcome)
    found["seeds"] = list(outcome.options.seeds)
    found["runtime_s"] = {name: round(value, 1) for name, value in outcome.runtime_s.items()}
    if len(by_seed) > 1:
        found["by_seed"] = by_seed
    return found


def parameters_of(outcome: Outcome) -> dict[str, Any]:
    """Return options and method; what decides the numbers."""
    options = plain_options(outcome.options)
    method = to_mapping(outcome.options.method)
    return {**{k: v for k, v in options.items() if k not in ("method", "seeds")}, "method": method}


def _world_summary(world: WorldOutcome) -> dict[str, Any]:
    by_sensor = _by_sensor(world)
    return {
        "stale": _stage([world.single[STALE]]),
        "single": {sensor: _stage([world.single[name] for name in names]) for sensor, names in by_sensor.items()},
        "fleet": {str(n): _stage([scored]) for n, scored in world.fleet.items()},
        "upload_bytes": _uploads(world, by_sensor),
        **({"pcd": _pcd(world, by_sensor)} if world.pcd else {}),
        "drives": {sensor: _drives(world, names) for sensor, names in by_sensor.items()},
    }


def _by_sensor(world: WorldOutcome) -> dict[str, list[str]]:
    """Names of the vehicles of each sensor."""
    found: dict[str, list[str]] = defaultdict(list)
    for vehicle in world.vehicles:
        found[vehicle.sensor].append(vehicle.vehicle)
    return dict(sorted(found.items()))


def _stage(maps: Sequence[Scored]) -> dict[str, Any]:
    """Mean over maps of F1 at the three levels, and of the classes' scores at each."""
    f1 = {level: _mean(scored.f1(level) for scored in maps) for level in LEVELS}
    return {"f1": f1, "classes": {level: mean_of([_classes(scored, level) for scored in maps]) for level in LEVELS}}


def _classes(scored: Scored, level: Any) -> dict[str, Any]:
    return {
        name: {"precision": s.precision, "recall": s.recall, "f1": s.f1}
        for name, s in scored.score(level).classes.items()
    }


def _uploads(world: WorldOutcome, by_sensor: Mapping[str, list[str]]) -> dict[str, Any]:
    """Bytes of the reports: a drive of each sensor, and the first n vehicles together."""
    together, alone = world.sent
    size = {vehicle.vehicle: size for vehicle, size in zip(world.vehicles, alone, strict=True)}
    return {
        "single": {sensor: _mean(float(size[name]) for name in names) for sensor, names in by_sensor.items()},
        "fleet": {str(n): sum(together[:n]) for n in world.fleet},
    }


def _pcd(world: WorldOutcome, by_sensor: Mapping[str, list[str]]) -> dict[str, Any]:
    """The baseline: scores, and bytes of its uploads by codec ("points" is the paper's)."""
    numbers = sorted(n for n in world.pcd if isinstance(n, int))
    size = [vehicle.stats["pcd_bytes"] for vehicle in world.vehicles]
    by_name = {vehicle.vehicle: vehicle.stats["pcd_bytes"] for vehicle in world.vehicles}
    return {
        "single": {sensor: _stage([world.pcd[name] for name in names]) for sensor, names in by_sensor.items()},
        "fleet": {str(n): _stage([world.pcd[n]]) for n in numbers},
        "upload_bytes": {
            "single": {sensor: mean_of([by_name[name] for name in names]) for sensor, names in by_sensor.items()},
            "fleet": {str(n): {codec: sum(one[codec] for one in size[:n]) for codec in size[0]} for n in numbers},
        },
    }


def _drives(world: WorldOutcome, names: Sequence[str]) -> dict[str, Any]:
    """Counts and pose errors, mean over the drives of one sensor."""
    stats = [vehicle.stats for vehicle in world.vehicles if vehicle.vehicle in names]
    return mean_of([{name: s[name] for name in _OF_A_DRIVE if s[name] is not None} for s in stats])


def confusion_of(worlds: Sequence[WorldOutcome]) -> dict[str, Any]:
    """Return the confusion matrices (Table 3), summed over worlds and vehicles: rows true, columns predicted."""
    stages: dict[str, Any] = {
        "classes": [c.name.lower() for c in CLASSES],
        "stale": _summed([world.single[STALE] for world in worlds]),
        "single": {},
        "fleet": {},
    }
    for sensor in sorted({vehicle.sensor for world in worlds for vehicle in world.vehicles}):
        maps = [w.single[v.vehicle] for w in worlds for v in w.vehicles if v.sensor == sensor]
        stages["single"][sensor] = _summed(maps)
    for n in worlds[0].fleet:
        stages["fleet"][str(n)] = _summed([world.fleet[n] for world in worlds])
    return stages


def _summed(maps: Sequence[Scored]) -> dict[str, list[list[int]]]:
    return {level: np.sum([scored.confusion[level] for scored in maps], axis=0).tolist() for level in LEVELS}


def mean_of(many: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the mean of nested tables of numbers, key by key; a key that some lack is the mean over the others."""
    keys = dict.fromkeys(key for one in many for key in one)
    return {key: _mean_value([one[key] for one in many if key in one]) for key in keys}


def _mean_value(values: Sequence[Any]) -> Any:
    if isinstance(values[0], Mapping):
        return mean_of(values)
    return values[0] if len(values) == 1 and isinstance(values[0], int) else _mean(float(value) for value in values)


def _mean(values: Iterable[float]) -> float:
    return round(statistics.fmean(values), _DIGITS)
