"""The signs of a route: what one drive found out, what the cloud made of it, the truth, and the paper's results."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from studies.frame.targets import Target

TRUE_CLASSES: Final = ("normal", "deleted", "new")
PREDICTED: Final = ("normal", "deleted", "new", "unclassified")

PAPER_CONFUSION: Final = ((54, 1, 0, 0), (0, 9, 0, 0), (0, 0, 36, 3))
"""Table 1: rows true, columns predicted."""
PAPER_ACCURACY: Final = {"normal": 98.0, "deleted": 100.0, "new": 92.0, "overall": 96.12}
PAPER_POSITION_M: Final = {"mean": 0.8, "std": 0.9}
"""Section 6.4, Figure 9."""
PAPER_STEP_MS: Final = 30.39
"""Section 6.1: mean, Core i5-4670."""
PAPER_LAMBDA: Final = 0.9
PAPER_LAMBDA_HD: Final = 0.95
"""Section 6.2."""

FULL: Final = "full"
VARIANTS: Final[Mapping[str, str]] = {
    FULL: "as it is",
    "no_occlusion": "hidden signs counted as unseen",
    "no_rbpf": "pose of GNSS and dead reckoning",
    "lidar": "pose of the LiDAR localiser",
    "eq_17": "signs of the map weigh at each look, Eq. 17",
}
"""The first is the method; the others show what matters."""

TARGETS: Final = (
    Target("accuracy, normal", "accuracy.normal", "%", "98", 98.0, 98.0, larger=True),
    Target("accuracy, deleted", "accuracy.deleted", "%", "100", 100.0, 100.0, larger=True),
    Target("accuracy, new", "accuracy.new", "%", "92", 92.0, 92.0, larger=True),
    Target("accuracy, overall", "accuracy.overall", "%", "96.12", 96.12, 99.0, larger=True),
    Target("position of new signs, one drive", "position_error_m.mean", "m", "0.8", 0.8, 0.4),
    Target("position of new signs, merged", "position_error_10_m.mean", "m", "", 0.3, 0.15),
    Target("one step, median", "step_ms_median", "ms", "30.39", 10.0, 2.0),
)


U8 = NDArray[np.uint8]
NORMAL, DELETED, NEW = range(3)
EXIST, ABSENT, UNKNOWN = range(3)
"""Columns of masses."""


@dataclass(frozen=True, slots=True, eq=False)
class SignTruth:
    """All N signs of a route, seen or not.

    Attributes:
        feature_id: int64 (N,); of a new sign the map knows nothing.
        xy_m: float64 (N, 2), map frame.
        true_class: uint8 (N,), index of `TRUE_CLASSES`.
    """

    feature_id: I64
    xy_m: F64
    true_class: U8

    def of(self, true_class: int) -> I64:
        """Return the indices of the signs of a class."""
        return np.flatnonzero(self.true_class == true_class).astype(np.int64)

    def take(self, rows: NDArray[np.bool_]) -> "SignTruth":
        """Return some of the signs, bool (N,)."""
        return SignTruth(self.feature_id[rows], self.xy_m[rows], self.true_class[rows])


@dataclass(frozen=True, slots=True, eq=False)
class Verdicts:
    """What one drive reports, and how it came about: K signs of its map, J new ones, N true signs, S steps, Q points.

    Attributes:
        known_id: int64 (K,).
        known_predicted: uint8 (K,), index of `PREDICTED`.
        new_xy_m: float64 (J, 2), map frame.
        new_cov_m2: float64 (J, 2, 2).
        step_ms: float64 (S,), time of each step.
        pose_error: float64 (S, 3), along and across the true heading [m], heading [rad].
        pose_chi2: float64 (S,), squared Mahalanobis distance of the place from the true one, 2 degrees of freedom.
        pose_given_up: bool (S,), looks of stretches that the vehicle has given up.
        lost: float64 (L, 6), stretches on which it found itself lost: from, until [s], off [m], statistic of the
            test that failed, verdicts taken back, whether the stretch was estimated anew.
        visible, occluded: int64 (N,), looks at each sign that was in view, free and hidden.
        trace_sign: int64 (Q,), index of the true sign whose masses these are; only of deleted and new signs.
        trace_masses: float64 (Q, 3), exist, absent, unknown.
    """

    known_id: I64
    known_predicted: U8
    new_xy_m: F64
    new_cov_m2: F64
    step_ms: F64
    pose_error: F64
    pose_chi2: F64
    pose_given_up: NDArray[np.bool_]
    lost: F64
    visible: I64
    occluded: I64
    trace_sign: I64
    trace_masses: F64


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredSigns:
    """Where signs of the map are by one drive alone, or by a map: K of them.

    Attributes:
        feature_id: int64 (K,).
        xy_m: float64 (K, 2), map frame.
        cov_m2: float64 (K, 2, 2).
    """

    feature_id: I64
    xy_m: F64
    cov_m2: F64


@dataclass(frozen=True, slots=True, eq=False)
class MergedSigns:
    """The layer that the cloud publishes after all drives.

    Attributes:
        known_id: int64 (K,), signs of the map before that are still published.
        new_xy_m: float64 (J, 2), published signs that the map before had not, map frame.
        new_cov_m2: float64 (J, 2, 2).
        known: where the K signs are published.
    """

    known_id: I64
    new_xy_m: F64
    new_cov_m2: F64
    known: MeasuredSigns


@dataclass(frozen=True, slots=True, eq=False)
class SlamcuSeed:
    """What came of one route.

    Attributes:
        seed: of the route.
        truth: its signs.
        variants: verdicts of the first vehicle, by variant.
        drives: verdicts of each vehicle; the first as in `variants`.
        merged: by number of vehicles.
        measured: signs of the map as each vehicle measured them by itself.
    """

    seed: int
    truth: SignTruth
    variants: Mapping[str, Verdicts]
    drives: tuple[Verdicts, ...]
    merged: Mapping[int, MergedSigns]
    measured: tuple[MeasuredSigns, ...]

    @property
    def first(self) -> Verdicts:
        """The paper's one drive."""
        return self.variants[FULL]
