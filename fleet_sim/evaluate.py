"""How well a map, or a set of reported changes, agrees with the truth (GND, section 6.3, Eq. 18).

F1 is the macro average over five classes (normal, new, modified, deleted, empty), in percent, at three levels of voxels
(`truth.LEVELS`), of which *observable* leads; beside it stands the macro average over the three classes of change.
Predictions are about the same voxels as the truth; what they say elsewhere is not counted.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import EvaluationError
from gnd.fleet_sim.truth import CHANGES, LEVELS, Level, Truth
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import diff
from gnd.gnd_map.tile_id import TileId

Tiles = Mapping[TileId, Gaussians]
I32 = NDArray[np.int32]
BoolArray = NDArray[np.bool_]
ClassArray = NDArray[np.uint8]

CLASSES: Final = tuple(c for c in ChangeClass if c is not ChangeClass.UNMEASURED)


@dataclass(frozen=True, slots=True)
class ClassScore:
    """Precision, recall and F1 of one class, in percent; 0 where there is nothing to divide by."""

    precision: float
    recall: float
    f1: float


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """The comparison at one level.

    Attributes:
        level: which voxels count.
        confusion: int64 (5, 5), rows: true class, columns: predicted class, in the order of `CLASSES`.
    """

    level: Level
    confusion: NDArray[np.int64]

    @property
    def classes(self) -> dict[str, ClassScore]:
        """The score of each class, by lower-case name."""
        hits = np.diag(self.confusion).astype(float)
        precision = 100.0 * hits / np.maximum(self.confusion.sum(axis=0), 1)
        recall = 100.0 * hits / np.maximum(self.confusion.sum(axis=1), 1)
        f1 = 2.0 * precision * recall / np.maximum(precision + recall, 1e-12)  # Eq. (18)
        rows = zip(CLASSES, precision.tolist(), recall.tolist(), f1.tolist(), strict=True)
        return {c.name.lower(): ClassScore(p, r, f) for c, p, r, f in rows}

    @property
    def macro_f1(self) -> float:
        """Mean F1 of the five classes, in percent."""
        return float(np.mean([score.f1 for score in self.classes.values()]))

    @property
    def changes_f1(self) -> float:
        """Mean F1 of the three classes of change, in percent: what "normal" and "empty" hide."""
        classes = self.classes
        return float(np.mean([classes[c.name.lower()].f1 for c in CHANGES]))

    @property
    def false_changes(self) -> dict[str, int]:
        """Number of unchanged voxels (normal or empty) that are called new, modified or deleted, by that name."""
        unchanged = self.confusion[[int(ChangeClass.NORMAL), int(ChangeClass.EMPTY)]].sum(axis=0)
        return {c.name.lower(): int(unchanged[c]) for c in CHANGES}

    @property
    def false_per_1000(self) -> dict[str, float]:
        """False changes of 1,000 voxels that hold a Gaussian before or after, by the class that they are called."""
        holding = int(self.confusion.sum() - self.confusion[int(ChangeClass.EMPTY)].sum())
        return {name: 1000.0 * count / max(holding, 1) for name, count in self.false_changes.items()}

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain numbers, for JSON."""
        classes = {
            name: {"precision": round(s.precision, 2), "recall": round(s.recall, 2), "f1": round(s.f1, 2)}
            for name, s in self.classes.items()
        }
        means = {"macro_f1": round(self.macro_f1, 2), "changes_f1": round(self.changes_f1, 2)}
        return {**means, "classes": classes, "confusion": self.confusion.tolist()}


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """A prediction compared with the truth.

    Attributes:
        predicted: uint8 (V,), the predicted class of each voxel of the truth.
        scores: one score a level.
    """

    predicted: ClassArray
    scores: Mapping[Level, Score]

    @property
    def kept(self) -> dict[Level, dict[str, float]]:
        """What each level keeps of the true changes, see `kept_changes`."""
        return kept_changes({level: score.confusion for level, score in self.scores.items()})

    def f1(self, level: Level = "observable") -> float:
        """Return the macro F1 at a level, in percent."""
        return self.scores[level].macro_f1

    def as_dict(self) -> dict[str, Any]:
        """Return all scores as plain numbers, for JSON."""
        return {level: score.as_dict() for level, score in self.scores.items()}


def kept_changes(confusion: Mapping[Level, NDArray[np.int64]]) -> dict[Level, dict[str, float]]:
    """Return the share of the true changes of each class that each level but "all" keeps, percent; of none: 100.

    Args:
        confusion: matrices (5, 5) of all levels, rows true.
    """
    true = {level: matrix.sum(axis=1) for level, matrix in confusion.items()}
    return {
        level: {c.name.lower(): 100.0 * float(row[c] / true["all"][c]) if true["all"][c] else 100.0 for c in CHANGES}
        for level, row in true.items()
        if level != "all"
    }


def evaluate(truth: Truth, predicted: ClassArray) -> Evaluation:
    """Compare predicted classes with the truth.

    Args:
        truth: V voxels.
        predicted: uint8 (V,), classes NORMAL to EMPTY in the order of the truth's voxels.

    Raises:
        EvaluationError: wrong length, or a class outside the five.
    """
    if predicted.shape != (len(truth),):
        raise EvaluationError(f"the truth has {len(truth)} voxels, the prediction has shape {predicted.shape}")
    if len(predicted) and predicted.max() >= len(CLASSES):
        raise EvaluationError(f"the prediction holds class {predicted.max()}, the last is {len(CLASSES) - 1}")
    return Evaluation(predicted, {level: _score(truth, predicted, level) for level in LEVELS})


def _score(truth: Truth, predicted: ClassArray, level: Level) -> Score:
    mask, n = truth.mask(level), len(CLASSES)
    pairs = truth.change_class[mask].astype(np.int64) * n + predicted[mask]
    return Score(level, np.bincount(pairs, minlength=n * n).reshape(n, n))


def evaluate_maps(truth: Truth, base: Tiles, final: Tiles) -> Evaluation:
    """Compare what became of a base map with the truth.

    A voxel of both maps is normal when its Gaussian is the same to the bit, else modified; in one map only it is new or
    deleted. The stale map is `evaluate_maps(truth, base, base)`.
    """
    return evaluate(truth, classes_of_maps(truth, base, final))


def classes_of_maps(truth: Truth, base: Tiles, final: Tiles) -> ClassArray:
    """Return the classes, uint8 (V,), that two maps assign to the truth's voxels."""
    predicted = np.full(len(truth), int(ChangeClass.EMPTY), dtype=np.uint8)
    for tile in sorted(set(base) | set(final)):
        old, new = base.get(tile, Gaussians.empty()), final.get(tile, Gaussians.empty())
        delta = diff(old, new)
        put = delta.put.voxel_id
        _assign(truth, predicted, tile, new.voxel_id, ChangeClass.NORMAL)
        _assign(truth, predicted, tile, np.intersect1d(put, old.voxel_id), ChangeClass.MODIFIED)
        _assign(truth, predicted, tile, np.setdiff1d(put, old.voxel_id), ChangeClass.NEW)
        _assign(truth, predicted, tile, delta.removed, ChangeClass.DELETED)
    return predicted


def false_elsewhere(truth: Truth, base: Tiles, final: Tiles, inside: Callable[[TileId, I32], BoolArray]) -> int:
    """Return how many voxels a map has got of which the truth has none: no ray of the dense scan ever touched them.

    Args:
        truth: of the world.
        base: the map before.
        final: the map after.
        inside: which voxels (K,) of a tile count, bool (K,).
    """
    count = 0
    for tile, new in final.items():
        old = base.get(tile, Gaussians.empty())
        put = np.setdiff1d(new.voxel_id, old.voxel_id)
        put = put[voxel_rows(truth, tile, put) < 0]
        count += int(inside(tile, put).sum())
    return count


def _assign(
    truth: Truth, predicted: ClassArray, tile: TileId, voxel_id: NDArray[np.int32], change_class: ChangeClass
) -> None:
    at = voxel_rows(truth, tile, voxel_id)
    predicted[at[at >= 0]] = int(change_class)


def voxel_rows(truth: Truth, tile: TileId, voxel_id: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the rows of the truth that hold voxels (K,) of a tile, int64 (K,), -1 where it has none."""
    low, high = np.searchsorted(truth.morton, [tile.morton, tile.morton + 1])
    inside = truth.voxel_id[low:high]
    at = np.searchsorted(inside, voxel_id)
    found = at < len(inside)
    found[found] = inside[at[found]] == voxel_id[found]
    return np.where(found, low + at, -1)
