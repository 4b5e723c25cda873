"""Rounds into numbers: false changes where nothing changed, precision and recall where objects were inserted."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.classes import CHANGED, ChangeClass
from studies.real.causes import CAUSES, cause_of
from studies.real.drive import Found
from studies.real.rounds import Round

I64 = NDArray[np.int64]
CHANGE_NAMES: Final = {c: c.name.lower() for c in CHANGED}
NEAR_M: Final = 3.0
"""Precision is also told for voxels within this distance of an inserted object."""


def summary_of(rounds: Sequence[Round]) -> dict[str, Any]:
    """Everything as plain numbers, pooled over the rounds."""
    return {
        "untouched": untouched_scores([r.untouched.found for r in rounds]) | {"causes": _causes(rounds)},
        "untouched_seen": untouched_scores([r.untouched.found.within(r.untouched.seen) for r in rounds]),
        "inserted": inserted_scores(rounds),
        "scans_driven": sum(r.untouched.found.scans_used for r in rounds),
        "map_gaussians": sum(len(g) for r in rounds for g in r.untouched.tiles.values()),
    }


def untouched_scores(found: Sequence[Found]) -> dict[str, Any]:
    """False changes: how many, of which class, and for how many voxels that were observed."""
    observed = sum(int((f.change_class != ChangeClass.UNMEASURED).sum()) for f in found)
    of_map = sum(int(((f.change_class != ChangeClass.UNMEASURED) & f.in_map).sum()) for f in found)
    false = {name: sum(int(f.where(c).sum()) for f in found) for c, name in CHANGE_NAMES.items()}
    gaussians = of_map + false["new"]
    return {
        "observed": observed,
        "observed_gaussian": gaussians,
        "observed_empty": observed - gaussians,
        "false": false,
        "false_per_1000": _rate(sum(false.values()), observed, 1000.0),
        "false_per_1000_gaussian": _rate(sum(false.values()), gaussians, 1000.0),
        "false_per_1000_by_class": {name: _rate(n, observed, 1000.0) for name, n in false.items()},
    }


def inserted_scores(rounds: Sequence[Round]) -> dict[str, Any]:
    """New and deleted, voxel by voxel."""
    return {
        "objects": {
            "new": sum(len(r.inserted.new) for r in rounds),
            "deleted": sum(len(r.inserted.gone) for r in rounds),
        },
        "new": _class_scores(rounds, ChangeClass.NEW),
        "deleted": _class_scores(rounds, ChangeClass.DELETED),
    }


def _class_scores(rounds: Sequence[Round], change: ChangeClass) -> dict[str, Any]:
    true = hit = reported = near = 0
    for r in rounds:
        found, truth = r.inserted.found, r.inserted.truth
        wanted = truth.new if change is ChangeClass.NEW else truth.measured
        wider = truth.new if change is ChangeClass.NEW else truth.deleted
        says = found.where(change) & ~np.isin(found.keys, truth.ignored)
        right = np.isin(found.keys[says], wider)
        true, hit = true + len(wanted), hit + int(np.isin(wanted, found.keys[says]).sum())
        reported += int(says.sum()) - int((right & ~np.isin(found.keys[says], wanted)).sum())
        near += int((~right & _near_objects(r, found.mean_m[says])).sum())
    return {
        "true": true,
        "found": hit,
        "recall": _rate(hit, true, 1.0),
        "precision": _rate(hit, reported if true else 0, 1.0),
        "precision_near_objects": _rate(hit, hit + near if true else 0, 1.0),
        "false": reported - hit,
    }


def _near_objects(one: Round, mean_m: NDArray[np.float64]) -> NDArray[np.bool_]:
    near = np.zeros(len(mean_m), np.bool_)
    for placed in (*one.inserted.new, *one.inserted.gone):
        distance = np.hypot(mean_m[:, 0] - placed.shape.x_m, mean_m[:, 1] - placed.shape.y_m)
        near |= distance < placed.radius_m + NEAR_M
    return near


def _causes(rounds: Sequence[Round]) -> dict[str, dict[str, int]]:
    """How many false changes of each class have which cause."""
    counts = {name: dict.fromkeys(CAUSES, 0) for name in CHANGE_NAMES.values()}
    for r in rounds:
        for change, name in CHANGE_NAMES.items():
            for cause in cause_of(r, np.flatnonzero(r.untouched.found.where(change))):
                counts[name][cause] += 1
    return counts


def _rate(n: float, of: float, unit: float) -> float | None:
    """None where there is nothing to divide by."""
    return round(unit * n / of, 4) if of else None
