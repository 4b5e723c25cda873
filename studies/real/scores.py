"""Rounds into numbers and tables: false changes and their causes, precision and recall where objects were inserted."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.classes import CHANGED, ChangeClass
from gnd.gnd_map.gaussian import full_matrices
from gnd.vehicle_agent.detect.records import planar_normals
from gnd.vehicle_agent.local_map import LocalMap
from studies.frame.tables import Sheet, fixed, sheet
from studies.real.drive import FoundVoxels, local_map_of
from studies.real.rounds import Round

CAUSES: Final[dict[str, str]] = {
    "mover": "a third of its points lies on what motion segmentation calls moving",
    "edge of a surface": "the map just missed it: 5 to 19 sub-cells, on the plane of a planar neighbour",
    "map just missed it": "5 to 19 sub-cells in the map's half, on no neighbour's plane",
    "map did not see it": "fewer than 5 sub-cells in the map's half",
    "far": "more than 25 m from the track",
    "thin in the map": "20 to 30 sub-cells in the map's half",
    "rough": "no plane: leaves, posts, corners",
    "other": "",
}
MOVING_SHARE: Final = 1 / 3
FAR_M: Final = 25.0
THIN_CELLS: Final = 30
WEAK_CELLS: Final = 5
ON_PLANE_M: Final = 0.15
ROUGH: Final = 0.1
"""Smallest variance over the largest from which a Gaussian is rough."""

_AROUND: Final = np.array([step for step in product((-1, 0, 1), repeat=3) if any(step)])


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """The map as surfaces: window and its origin, means (M, 3), normals (M, 3; zeros: no plane), roughness (M,)."""

    index: NDArray[np.int32]
    origin_g: NDArray[np.int64]
    mean_m: NDArray[np.float64]
    normal: NDArray[np.float64]
    roughness: NDArray[np.float64]

    @classmethod
    def of(cls, local_map: LocalMap) -> "Surfaces":
        """From a map window."""
        cov = full_matrices(local_map.cov_m2)
        values = np.linalg.eigvalsh(cov) if len(cov) else np.ones((0, 3))
        normal = planar_normals(cov)
        roughness = values[:, 0] / np.maximum(values[:, 2], 1e-9)
        return cls(local_map.index, local_map.window_origin_g, local_map.mean_map_m, normal, roughness)

    def rows(self, g: NDArray[np.int64]) -> NDArray[np.int64]:
        """(K,) rows of the Gaussians at grid coordinates (K, 3), -1 where there is none."""
        at = g - self.origin_g
        inside = ((at >= 0) & (at < self.index.shape)).all(axis=1)
        row = np.full(len(g), -1, np.int64)
        row[inside] = self.index[tuple(at[inside].T)]
        return np.maximum(row, -1)

    def extended_to(self, g: NDArray[np.int64], mean_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(K,) whether a planar Gaussian around a voxel, extended, meets its mean within `ON_PLANE_M`."""
        met = np.zeros(len(g), np.bool_)
        for step in _AROUND:
            row = self.rows(g + step)
            normal = self.normal[row] if len(self.normal) else np.zeros((len(g), 3))
            off_m = np.abs(((mean_m - self.mean_m[row]) * normal).sum(axis=1)) if len(normal) else np.zeros(0)
            met |= (row >= 0) & normal.any(axis=1) & (off_m <= ON_PLANE_M)
        return met

    def rough_at(self, g: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(K,) whether the map's Gaussian there is rough."""
        row = self.rows(g)
        return (row >= 0) & (self.roughness[row] >= ROUGH)


def cause_of(one: Round, rows: NDArray[np.int64]) -> list[str]:
    """The cause of each of the reported voxels `rows` (K,) of the untouched drive."""
    if not len(rows):
        return []
    u = one.untouched
    keys, mean = u.found.keys[rows], u.found.mean_m[rows]
    surfaces = Surfaces.of(local_map_of(one.scene, u.tiles))
    mapped, in_map = u.mapped.cells_at(keys), u.found.in_map[rows]
    distance = np.linalg.norm(one.scene.positions_m[:, None, :2] - mean[None, :, :2], axis=2).min(axis=0)
    weak = ~in_map & (mapped >= WEAK_CELLS)
    conditions = [
        u.moving.count_at(keys) >= MOVING_SHARE * np.maximum(u.driven.count_at(keys), 1),
        weak & surfaces.extended_to(u.found.g[rows], mean),
        weak,
        ~in_map,
        distance > FAR_M,
        in_map & (mapped < THIN_CELLS),
        surfaces.rough_at(u.found.g[rows]),
    ]
    names = list(CAUSES)
    first = np.select(conditions, range(len(conditions)), len(names) - 1)
    return [names[int(i)] for i in first]


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


def untouched_scores(found: Sequence[FoundVoxels]) -> dict[str, Any]:
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
        claimed = found.where(change) & ~np.isin(found.keys, truth.ignored)
        right = np.isin(found.keys[claimed], wider)
        true, hit = true + len(wanted), hit + int(np.isin(wanted, found.keys[claimed]).sum())
        reported += int(claimed.sum()) - int((right & ~np.isin(found.keys[claimed], wanted)).sum())
        near += int((~right & _near_objects(r, found.mean_m[claimed])).sum())
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
    return [head, false, _causes_sheet(found["untouched"]["causes"]), _inserted(found["inserted"])]


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


def _causes_sheet(causes: dict[str, dict[str, int]]) -> Sheet:
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
