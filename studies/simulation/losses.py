"""The voxels that cost F1: by true class, predicted class and cause, with what they cost."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.evaluate import CLASSES, ClassArray, Score, classes_of_maps
from gnd.fleet_sim.truth import Level, Truth
from gnd.gnd_map.arrays import I64
from gnd.gnd_map.classes import ChangeClass
from studies.simulation.base_map import BaseMap
from studies.simulation.causes import RIGHT, UNSEEN, Causes, causes, columns_at
from studies.simulation.cloud import map_of_one, merged_map
from studies.simulation.method import MethodParameters
from studies.simulation.result import VehicleResult

BASE_DIFFERS: Final = "the base map differs from the truth's"
MARGINAL: Final = "marginal in the truth"
TOO_FAR: Final = "hardly observable"
POSES: Final = "right with true poses"


@dataclass(frozen=True, slots=True)
class Loss:
    """One kind of error at one level.

    Attributes:
        true, predicted: names of the classes.
        voxels: how many.
        f1: what macro F1 would gain, in points, were they right.
        by_cause: how many voxels by cause, the most frequent first.
    """

    true: str
    predicted: str
    voxels: float
    f1: float
    by_cause: Mapping[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """What errors are looked for in: a world with its truth, base map and vehicles."""

    truth: Truth
    base: BaseMap
    vehicles: Sequence[VehicleResult]
    method: MethodParameters
    exact: "Case | None" = None
    """The same world and fleet with true poses: what is right there is wrong here because of the poses."""

    def in_base(self) -> NDArray[np.bool_]:
        """Return which voxels of the truth hold a Gaussian in the base map, bool (V,)."""
        return np.asarray(classes_of_maps(self.truth, self.base.tiles, self.base.tiles) == ChangeClass.NORMAL)


def single_losses(case: Case, vehicle: VehicleResult, level: Level) -> list[Loss]:
    """Return what costs F1 in the map of one vehicle alone."""
    predicted = predicted_by(case, [vehicle])
    rows = _wrong(case.truth, predicted, level)
    found = causes(case.truth.change_class[rows], columns_at(vehicle, rows), case.method.detect)
    same = [v for v in case.exact.vehicles if v.vehicle == vehicle.vehicle] if case.exact else []
    exact = predicted_by(case.exact, same) if case.exact else None
    return _losses(case, predicted, rows, found, level, exact)


def fleet_losses(case: Case, n: int, level: Level) -> list[Loss]:
    """Return what costs F1 in the merged map of the first n vehicles."""
    vehicles = case.vehicles[:n]
    predicted = predicted_by(case, vehicles, merge=True)
    rows = _wrong(case.truth, predicted, level)
    true = case.truth.change_class[rows]
    each = np.stack([causes(true, columns_at(vehicle, rows), case.method.detect) for vehicle in vehicles])
    said = np.stack([columns_at(vehicle, rows)["change_class"] for vehicle in vehicles])
    exact = predicted_by(case.exact, case.exact.vehicles[:n], merge=True) if case.exact else None
    return _losses(case, predicted, rows, _vote_causes(true, said, each, case.method.merge.xi), level, exact)


def predicted_by(case: Case, vehicles: Sequence[VehicleResult], *, merge: bool = False) -> ClassArray:
    """Return the class, uint8 (V,), of each voxel after the vehicles' reports, merged or of one vehicle alone."""
    bodies = [body for vehicle in vehicles for body in vehicle.reports]
    final = merged_map(case.base, bodies, case.method.merge) if merge else map_of_one(case.base, bodies)
    return classes_of_maps(case.truth, case.base.tiles, final)


def _vote_causes(true: NDArray[np.uint8], said: NDArray[np.int32], each: Causes, xi: float) -> Causes:
    """How the votes (vehicles, R) fell, with the commonest cause among those that did not say what is true."""
    spoke = said != int(ChangeClass.UNMEASURED)
    right, votes = (said == true).sum(axis=0), spoke.sum(axis=0)
    found = []
    for r in range(len(true)):
        why = Counter(c for c in each[:, r].tolist() if c not in (RIGHT, UNSEEN)).most_common(1)
        detail = f" ({why[0][0]})" if why else ""
        found.append(_pattern(int(right[r]), int(votes[r]), xi, set(each[:, r].tolist())) + detail)
    return np.array(found or [""], dtype=np.str_)[: len(found)]


def _pattern(right: int, votes: int, xi: float, each: set[str]) -> str:
    if each == {UNSEEN}:
        return "observed by nobody"
    if votes == 0:
        return "nobody decides"
    if right > xi * votes:
        return "outvoted in the cloud though most are right"
    return "votes split" if right >= (1 - xi) * votes else "most say something else"


def _wrong(truth: Truth, predicted: ClassArray, level: Level) -> I64:
    return np.flatnonzero(truth.mask(level) & (predicted != truth.change_class))


def _losses(
    case: Case, predicted: ClassArray, rows: I64, found: Causes, level: Level, exact: ClassArray | None
) -> list[Loss]:
    truth, true = case.truth, case.truth.change_class[rows]
    names = _with_circumstances(case, rows, found, exact)
    mask = truth.mask(level)
    n = len(CLASSES)
    confusion = np.bincount(truth.change_class[mask].astype(np.int64) * n + predicted[mask], minlength=n * n)
    confusion = confusion.reshape(n, n)
    groups = []
    for t, p in sorted({(int(a), int(b)) for a, b in zip(true, predicted[rows], strict=True)}):
        of_group = names[(true == t) & (predicted[rows] == p)]
        by_cause = {str(name): float(k) for name, k in Counter(of_group.tolist()).most_common()}
        name = [CLASSES[i].name.lower() for i in (t, p)]
        groups.append(Loss(name[0], name[1], float(len(of_group)), _gain(confusion, t, p, level), by_cause))
    return sorted(groups, key=lambda loss: -loss.f1)


def _with_circumstances(case: Case, rows: I64, found: Causes, exact: ClassArray | None) -> Causes:
    """Causes with what the truth, the base map and a run with true poses say about the voxels."""
    if not len(rows):
        return found
    truth, true = case.truth, case.truth.change_class[rows]
    was_there = np.isin(true, (ChangeClass.NORMAL, ChangeClass.MODIFIED, ChangeClass.DELETED))
    if exact is not None:
        found = np.where(exact[rows] == true, np.char.add(f"{POSES}; ", found), found)
    names = np.where(truth.observable[rows], found, np.char.add(f"{TOO_FAR}; ", found))
    names = np.where(truth.clear[rows], names, np.char.add(f"{MARGINAL}; ", found))
    return np.where(was_there == case.in_base()[rows], names, BASE_DIFFERS)


def _gain(confusion: NDArray[np.int64], t: int, p: int, level: Level) -> float:
    """Macro F1 with the errors (t, p) put right, less macro F1 as it is."""
    right = confusion.copy()
    right[t, t] += right[t, p]
    right[t, p] = 0
    return Score(level, right).macro_f1 - Score(level, confusion).macro_f1


def mean_losses(many: Sequence[Sequence[Loss]]) -> list[Loss]:
    """Return the mean of several analyses: worlds, or vehicles of one sensor."""
    kinds = sorted({(loss.true, loss.predicted) for losses in many for loss in losses})
    found = []
    for true, predicted in kinds:
        same = [loss for losses in many for loss in losses if (loss.true, loss.predicted) == (true, predicted)]
        by_cause: Counter[str] = Counter()
        for loss in same:
            by_cause.update(loss.by_cause)
        means = {cause: round(k / len(many), 1) for cause, k in by_cause.most_common()}
        voxels, gain = (sum(getattr(loss, name) for loss in same) / len(many) for name in ("voxels", "f1"))
        found.append(Loss(true, predicted, round(voxels, 1), round(gain, 3), means))
    return sorted(found, key=lambda loss: -loss.f1)


def plain(losses: Sequence[Loss]) -> list[dict[str, Any]]:
    """Return losses as plain values."""
    return [
        {"true": x.true, "predicted": x.predicted, "voxels": x.voxels, "f1": x.f1, "by_cause": dict(x.by_cause)}
        for x in losses
    ]
