"""Rounds into numbers and tables: false changes and their causes, precision and recall where objects were inserted."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import full_matrices
from gnd.vehicle_agent.detect.records import planar_normals
from gnd.vehicle_agent.local_map import LocalMap
from studies.frame.tables import Sheet, fixed, sheet
from studies.real.bands import CHANGE_NAMES, DISTANCES_M, bands_of, bands_sheet, distance_m, inserted_sheet, inside
from studies.real.drive import FoundVoxels, local_map_of
from studies.real.rounds import Round
from studies.real.scene import centres_m

CAUSES: Final[dict[str, str]] = {
    "mover": "a third of its points lies on what motion segmentation calls moving",
    "edge of a surface": "the map just missed it: 5 to 19 sub-cells, on the plane of a planar neighbour",
    "map just missed it": "5 to 19 sub-cells in the map's half, on no neighbour's plane",
    "map did not see it": "fewer than 5 sub-cells in the map's half",
    "permeable": "leaves, fences: most rays of the map's half passed the map's Gaussian, too",
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
        _permeable(u.mapping, keys),
        distance > FAR_M,
        in_map & (mapped < THIN_CELLS),
        surfaces.rough_at(u.found.g[rows]),
    ]
    names = list(CAUSES)
    first = np.select(conditions, range(len(conditions)), len(names) - 1)
    return [names[int(i)] for i in first]


def _permeable(mapping: FoundVoxels, keys: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(K,) whether more rays of the map's half passed through its own Gaussian than ended there."""
    row = mapping.rows(keys)
    return (row >= 0) & mapping.in_map[row] & (mapping.passes[row] > mapping.hits[row])


I64 = NDArray[np.int64]
NEAR_M: Final = 3.0
"""Precision is also told for voxels within this distance of an inserted object."""


def summary_of(rounds: Sequence[Round]) -> dict[str, Any]:
    """Everything as plain numbers, pooled over the rounds."""
    return {
        "untouched": untouched_scores([r.untouched.found for r in rounds]) | {"causes": _causes(rounds)},
        "untouched_seen": untouched_scores([r.untouched.found.within(r.untouched.seen) for r in rounds])
        | {"by": bands_of(rounds)},
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


@dataclass(frozen=True, slots=True, eq=False)
class _Judged:
    """One class of one round, voxel by voxel: those that are true, and those that are claimed and count.

    wanted: keys (T,) that are true. hit: (T,) whether each is claimed. false, of claimed voxels that are not true,
    (F,) each: `wrong_m` where they lie, `near` an object, `seen` by the map's half.
    """

    wanted: I64
    hit: NDArray[np.bool_]
    wanted_m: NDArray[np.float64]
    wrong_m: NDArray[np.float64]
    near: NDArray[np.bool_]
    seen: NDArray[np.bool_]


def _judged(one: Round, change: ChangeClass) -> _Judged:
    found, truth = one.inserted.found, one.inserted.truth
    wanted = truth.new if change is ChangeClass.NEW else truth.measured
    right = truth.new if change is ChangeClass.NEW else truth.deleted
    claimed = found.where(change) & ~np.isin(found.keys, truth.ignored)
    wrong = found.take(np.asarray(claimed & ~np.isin(found.keys, right)))
    return _Judged(
        wanted=wanted,
        hit=np.isin(wanted, found.keys[claimed]),
        wanted_m=centres_m(one.scene.grid_frame, wanted),
        wrong_m=wrong.mean_m,
        near=_near_objects(one, wrong.mean_m),
        seen=np.isin(wrong.keys, one.inserted.seen),
    )


def _class_scores(rounds: Sequence[Round], change: ChangeClass) -> dict[str, Any]:
    judged = [_judged(r, change) for r in rounds]
    true, hit = sum(len(j.wanted) for j in judged), sum(int(j.hit.sum()) for j in judged)
    false = sum(len(j.seen) for j in judged)
    near, seen = sum(int(j.near.sum()) for j in judged), sum(int(j.seen.sum()) for j in judged)
    return {
        "true": true,
        "found": hit,
        "recall": _rate(hit, true, 1.0),
        "precision": _rate(hit, hit + false if true else 0, 1.0),
        "precision_near_objects": _rate(hit, hit + near if true else 0, 1.0),
        "precision_seen": _rate(hit, hit + seen if true else 0, 1.0),
        "false": false,
        "false_seen": seen,
        "by_distance": {name: _in_band(rounds, judged, span) for name, span in DISTANCES_M.items()},
    }


def _in_band(rounds: Sequence[Round], judged: Sequence[_Judged], span: tuple[float, float]) -> dict[str, Any]:
    """Recall and precision in one band of distance; false ones only where both halves had looked."""
    true = hit = false = 0
    for r, j in zip(rounds, judged, strict=True):
        from_m = r.untouched.driven_from_m
        here = inside(distance_m(from_m, j.wanted_m), span)
        true, hit = true + int(here.sum()), hit + int((here & j.hit).sum())
        false += int((inside(distance_m(from_m, j.wrong_m), span) & j.seen).sum())
    return {
        "true": true,
        "found": hit,
        "recall": _rate(hit, true, 1.0),
        "false": false,
        "precision": _rate(hit, hit + false, 1.0),
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
    untouched, inserted = found["untouched"], found["inserted"]
    tables = [head, _false_changes(untouched, found["untouched_seen"]), _causes_sheet(untouched["causes"])]
    tables.append(bands_sheet(found["untouched_seen"]["by"]))
    return [*tables, _inserted(inserted), inserted_sheet(inserted)]


def _false_changes(untouched: dict[str, Any], seen: dict[str, Any]) -> Sheet:
    columns = ("voxels", "a 1,000 observed", "a 1,000 Gaussians", "observed in both", "a 1,000 in both")
    table = sheet("Nothing changed: reported nevertheless", "", *columns)
    gaussians = max(untouched["observed_gaussian"], 1)
    for name, n in untouched["false"].items():
        rates = fixed(untouched["false_per_1000_by_class"][name]), f"{1000 * n / gaussians:.2f}"
        table.add(name, f"{n:,}", *rates, f"{seen['false'][name]:,}", fixed(seen["false_per_1000_by_class"][name]))
    total, both = sum(untouched["false"].values()), sum(seen["false"].values())
    rates = fixed(untouched["false_per_1000"]), fixed(untouched["false_per_1000_gaussian"])
    table.add("all", f"{total:,}", *rates, f"{both:,}", fixed(seen["false_per_1000"]), style="bold")
    table.add("observed", f"{untouched['observed']:,}", f"{untouched['observed_gaussian']:,} Gaussians", "",
              f"{seen['observed']:,}", f"{seen['observed_gaussian']:,} Gaussians")  # fmt: skip
    table.notes.append(
        f"Observed in both: {fixed(seen['false_per_1000_gaussian'])} of 1,000 Gaussians. The map's half never looked at"
        f" {total - both:,} of the {total:,} voxels: the map cannot know of them"
    )
    return table


def _causes_sheet(causes: dict[str, dict[str, int]]) -> Sheet:
    table = sheet("Why", "first that holds", *causes)
    for cause, meaning in CAUSES.items():
        numbers = [counts[cause] for counts in causes.values()]
        if any(numbers):
            table.add(f"{cause}: {meaning}" if meaning else cause, *map(str, numbers))
    return table


def _inserted(inserted: dict[str, Any]) -> Sheet:
    places = ("precision", "observed in both", "within 3 m of objects")
    table = sheet("Objects inserted", "", "objects", "voxels", "recall", *places)
    for name in ("new", "deleted"):
        one = inserted[name]
        keys = ("recall", "precision", "precision_seen", "precision_near_objects")
        shares = ("–" if one[key] is None else f"{one[key]:.1%}" for key in keys)
        table.add(name, str(inserted["objects"][name]), str(one["true"]), *shares)
    return table
