"""Table 1 and Figure 9 of the paper: how signs were classified, and how far off the new ones are.

Every sign of the route counts. A new sign to which no estimate belongs is unclassified; an estimate to which no new
sign belongs is false, which the paper's table has no place for: it stands beside.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from studies.feature_study.averages import distances_plain
from studies.feature_study.honesty import Honesty
from studies.feature_study.matching import RADIUS_M, Matching, match_one_to_one
from studies.slamcu_study.reference import PREDICTED, TRUE_CLASSES
from studies.slamcu_study.verdicts import DELETED, NEW, NORMAL, U8, SignTruth

UNCLASSIFIED = PREDICTED.index("unclassified")


@dataclass(frozen=True, slots=True, eq=False)
class SignScore:
    """How well signs were classified and placed.

    Attributes:
        confusion: int64 (3, 4), rows `TRUE_CLASSES`, columns `PREDICTED`.
        sign: int64 (P,), indices of the new signs that were found.
        error_m: float64 (P, 2), estimated minus true position, map frame.
        estimate: int64 (P,), index of each one's estimate.
        honesty: of the P covariances.
        false_new: int64, indices of estimates without a new sign.
        near_known: how many of these lie within the radius of a sign of the map.
    """

    confusion: I64
    sign: I64
    error_m: F64
    estimate: I64
    honesty: Honesty | None
    false_new: I64
    near_known: int

    @property
    def distance_m(self) -> F64:
        """(P,) errors."""
        return np.asarray(np.linalg.norm(self.error_m, axis=1))

    def plain_errors(self) -> dict[str, Any]:
        """Return mean, standard deviation and more of the errors, and what was missed or false."""
        return distances_plain(self.distance_m) | {"missed": self.missed, "false": len(self.false_new)}

    @property
    def missed(self) -> int:
        """New signs without an estimate."""
        return int(self.confusion[NEW].sum()) - len(self.sign)


def score(
    truth: SignTruth,
    known: tuple[I64, U8],
    new: tuple[F64, F64],
    radius_m: float = RADIUS_M,
) -> SignScore:
    """Return how well a drive, or a map, tells the signs.

    Args:
        truth: all signs of the route.
        known: feature ids (K,) of the signs of the map that was driven with, and their classes (K,), indices of
            `PREDICTED`.
        new: positions (J, 2) [m] and covariances (J, 2, 2) [m^2] of those new features that are said to exist.
        radius_m: the farthest an estimate may lie from its sign.
    """
    confusion = np.zeros((len(TRUE_CLASSES), len(PREDICTED)), np.int64)
    for true_class in (NORMAL, DELETED):
        predicted = _predicted(truth.feature_id[truth.of(true_class)], *known)
        confusion[true_class] = np.bincount(predicted, minlength=len(PREDICTED))
    signs, (xy_m, cov_m2) = truth.of(NEW), new
    matching = match_one_to_one(xy_m, truth.xy_m[signs], radius_m)
    confusion[NEW, PREDICTED.index("new")] = len(matching.true)
    confusion[NEW, UNCLASSIFIED] = len(matching.missed)
    return _placed(truth, confusion, matching, (signs, xy_m, cov_m2), radius_m)


def _placed(
    truth: SignTruth, confusion: I64, matching: Matching, new: tuple[I64, F64, F64], radius_m: float
) -> SignScore:
    signs, xy_m, cov_m2 = new
    sign = signs[matching.true]
    error_m = xy_m[matching.estimate] - truth.xy_m[sign]
    honesty = Honesty.of(error_m, cov_m2[matching.estimate])
    near = _near(xy_m[matching.false], truth.xy_m[truth.true_class != NEW], radius_m)
    return SignScore(confusion, sign, error_m, matching.estimate, honesty, matching.false, near)


def _predicted(feature_ids: I64, known_id: I64, predicted: U8) -> I64:
    """(N,) what the drive says of signs of the map; unclassified what it does not mention."""
    said = dict(zip(known_id.tolist(), predicted.tolist(), strict=True))
    return np.array([said.get(one, UNCLASSIFIED) for one in feature_ids.tolist()], np.int64)


def _near(xy_m: F64, others_m: F64, radius_m: float) -> int:
    """How many of (N, 2) lie within the radius of one of (M, 2)."""
    apart = np.linalg.norm(xy_m[:, None, :] - others_m[None, :, :], axis=2)
    return int(np.count_nonzero((apart < radius_m).any(axis=1)))


def accuracy_of(confusion: I64 | F64) -> dict[str, float | None]:
    """Return percent right of each class and of all; None of a class that the route has none of."""
    right, there = np.array([confusion[i, i] for i in range(len(TRUE_CLASSES))]), confusion.sum(axis=1)
    by_class = {name: 100.0 * float(right[i] / there[i]) if there[i] else None for i, name in enumerate(TRUE_CLASSES)}
    return by_class | {"overall": 100.0 * float(right.sum() / there.sum()) if there.sum() else None}
