"""What one drive found out about the signs of its route, and what the truth says of them; kept as one file."""

from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from studies.localisation_study.kept import Kept, read_arrays, write_arrays
from studies.simulation.errors import FolderError
from studies.slamcu_study.reference import TRUE_CLASSES

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
    """What one drive says, and how it came about. K signs of its map, J new features, N true signs, S steps, Q points.

    Attributes:
        known_id: int64 (K,).
        known_predicted: uint8 (K,), index of `PREDICTED`.
        known_conflict: float64 (K,), share of the masses that Dempster's normalisation threw away.
        new_xy_m: float64 (J, 2), map frame.
        new_cov_m2: float64 (J, 2, 2).
        new_exists: bool (J,), whether the drive says that the feature is there; else it has too little evidence.
        new_conflict: float64 (J,).
        step_ms: float64 (S,), time of each step.
        pose_error: float64 (S, 3), along and across the true heading [m], heading [rad].
        pose_chi2: float64 (S,), squared Mahalanobis distance of the place from the true one, 2 degrees of freedom.
        pose_said_lost: bool (S,), looks of a stretch of which the vehicle says nothing, for it was lost.
        lost: float64 (L, 6), stretches that it found to have told wrong: from, until [s], off [m], statistic of the
            test that failed, verdicts taken back, whether it told the stretch anew.
        pose_part_m: float64 (N, 2), what the error of the pose moved each sign by, mean over the looks at it [m]; nan
            for signs never looked at.
        visible, occluded: int64 (N,), looks at each sign that was in view, free and hidden.
        no_evidence: looks at signs of the map that were left out as hidden.
        trace_sign: int64 (Q,), index of the true sign whose masses are told; only of deleted and new signs.
        trace_s: float64 (Q,), seconds since the drive began.
        trace_masses: float64 (Q, 3), exist, absent, unknown.
    """

    known_id: I64
    known_predicted: U8
    known_conflict: F64
    new_xy_m: F64
    new_cov_m2: F64
    new_exists: NDArray[np.bool_]
    new_conflict: F64
    step_ms: F64
    pose_error: F64
    pose_chi2: F64
    pose_said_lost: NDArray[np.bool_]
    lost: F64
    pose_part_m: F64
    visible: I64
    occluded: I64
    no_evidence: int
    trace_sign: I64
    trace_s: F64
    trace_masses: F64


_COLUMNS: Final = tuple(field.name for field in fields(Verdicts))


def write_verdicts(found: Verdicts, truth: SignTruth, kept: Kept) -> None:
    """Write a drive's verdicts with the truth; the file appears complete or not at all."""
    arrays: dict[str, Any] = {name: getattr(found, name) for name in _COLUMNS}
    arrays |= {f"true_{field.name}": getattr(truth, field.name) for field in fields(SignTruth)}
    write_arrays(kept, {"classes": list(TRUE_CLASSES)}, {name: np.asarray(value) for name, value in arrays.items()})


def read_verdicts(kept: Kept) -> tuple[Verdicts, SignTruth]:
    """Read a drive's verdicts and the truth.

    Raises:
        FolderError: they are missing or damaged.
    """
    _, arrays = read_arrays(kept)
    try:
        truth = SignTruth(**{field.name: arrays[f"true_{field.name}"] for field in fields(SignTruth)})
        return Verdicts(**{name: arrays[name] for name in _COLUMNS}), truth
    except KeyError as error:
        raise FolderError(f"{kept.path} is damaged: it lacks {error}; delete it and start again") from error
