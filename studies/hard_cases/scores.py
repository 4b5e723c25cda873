"""What poses of a hard case are worth: errors, wrong and called good, right and called bad, NEES."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import radians
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from studies.hard_cases.localising import HEALTHS, CaseRun, Poses

WRONG_M: Final = 0.44
WRONG_RAD: Final = radians(0.5)
"""A pose that is farther off, horizontally or in heading, is wrong (GND, Table 4)."""
_AXES: Final = ("longitudinal_m", "lateral_m", "heading_deg")


def joined(parts: Sequence[Poses]) -> Poses:
    """Return the poses of several runs as one series."""
    columns = ("t_ns", "error", "covariance", "health")
    return Poses(*(np.concatenate([getattr(part, name) for part in parts]) for name in columns))


def is_wrong(poses: Poses) -> NDArray[np.bool_]:
    """Return which poses (N,) are wrong."""
    off_m = np.hypot(poses.error[:, 0], poses.error[:, 1])
    return np.asarray((off_m > WRONG_M) | (np.abs(poses.error[:, 2]) > WRONG_RAD))


def row_of(poses: Poses, scans: int) -> dict[str, Any]:
    """Return the figures of poses, of a drive or of several, that gave so many scans.

    Errors count all poses that were not called lost, NEES those called good, `right_called_bad` every pose that was
    right.
    """
    wrong, good = is_wrong(poses), poses.health == HEALTHS.index("good")
    given = poses.health != HEALTHS.index("lost")
    return {
        **_quantiles(poses.error[given]),
        "wrong_called_good": int(np.count_nonzero(wrong & good)),
        "wrong_called_good_share": _share(wrong & good, given),
        "right_called_bad": _share(~wrong & ~good, np.ones_like(wrong)),
        "right_called_bad_poses": int(np.count_nonzero(~wrong & ~good)),
        "poses": int(np.count_nonzero(given)),
        "good_poses": int(np.count_nonzero(good)),
        "scans": scans,
        "nees": nees_of(poses, good),
        "nees_all": nees_of(poses, given),
        "p95_good": {name: value and value["p95"] for name, value in _quantiles(poses.error[good]).items()},
    }


def _share(part: NDArray[np.bool_], whole: NDArray[np.bool_]) -> float:
    return int(part.sum()) / max(int(whole.sum()), 1)


def _quantiles(error: F64) -> dict[str, dict[str, float] | None]:
    if not len(error):
        return dict.fromkeys(_AXES)
    size = np.abs(error) * np.array([1.0, 1.0, np.degrees(1.0)])
    return {
        name: {"p95": float(np.quantile(size[:, k], 0.95)), "max": float(size[:, k].max())}
        for k, name in enumerate(_AXES)
    }


def nees_of(poses: Poses, chosen: NDArray[np.bool_]) -> dict[str, float | int] | None:
    """Return the normalised estimation error squared over its degrees of freedom, mean over the chosen poses.

    Of the place (2 degrees of freedom), of the heading (1) and of both together (3); 1 is honest, more is too sure.
    None where no pose has a covariance (Bar-Shalom, Estimation with Applications to Tracking and Navigation, 5.4.2).
    """
    known = chosen & np.isfinite(poses.covariance).all(axis=(1, 2))
    if not known.any():
        return None
    error, covariance = poses.error[known], poses.covariance[known]
    place = _quadratic(error[:, :2], covariance[:, :2, :2]) / 2.0
    heading = error[:, 2] ** 2 / covariance[:, 2, 2]
    joint = _quadratic(error, covariance) / 3.0
    means = {name: float(value.mean()) for name, value in (("place", place), ("heading", heading), ("joint", joint))}
    return {**means, "poses": int(known.sum())}


def _quadratic(error: F64, covariance: F64) -> F64:
    """Squared length (N,) of errors (N, D) in units of their covariances (N, D, D)."""
    found: F64 = np.einsum("nd,nd->n", error, np.linalg.solve(covariance, error[:, :, None])[:, :, 0])
    return found


# --- of a case -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CaseResult:
    """What came of a task: runs with and without submaps, seconds of CPU of simulator and of both runs."""

    with_submaps: CaseRun
    without_submaps: CaseRun
    seconds: dict[str, float]


def sensor_figures(results: Mapping[int, CaseResult]) -> dict[str, Any]:
    """Return the figures of one case and sensor: all seeds together, the worst, and each."""
    whole = _rows([result.with_submaps for result in results.values()])
    without = _rows([result.without_submaps for result in results.values()])
    seeds = [{"seed": seed, **_seed_figures(result)} for seed, result in results.items()]
    return {
        **whole,
        "without_submaps": without,
        "submaps_worse_by": _worse_by(whole["refined"], without["refined"]),
        "worst_seed": max(seeds, key=_badness)["seed"],
        "seeds": seeds,
        "cpu_s": sum(sum(result.seconds.values()) for result in results.values()) / len(results),
    }


def _seed_figures(result: CaseResult) -> dict[str, Any]:
    clock = result.with_submaps.clock
    return {
        **_rows([result.with_submaps]),
        "without_submaps": _rows([result.without_submaps]),
        "time_offset": clock and asdict(clock),
        "cpu_s": result.seconds,
    }


def _rows(runs: Sequence[CaseRun]) -> dict[str, Any]:
    scans = sum(run.scans for run in runs)
    return {
        "refined": row_of(joined([run.refined for run in runs]), scans),
        "online": row_of(joined([run.online for run in runs]), scans),
    }


def _worse_by(with_submaps: Mapping[str, Any], without: Mapping[str, Any]) -> dict[str, float] | None:
    """By how much the 95 % error with submaps is larger than without; None where either has no pose."""
    if with_submaps[_AXES[0]] is None or without[_AXES[0]] is None:
        return None
    return {name: with_submaps[name]["p95"] - without[name]["p95"] for name in _AXES}


def _badness(row: Mapping[str, Any]) -> tuple[float, ...]:
    """What makes a seed the worst: wrong poses called good first, then errors."""
    wrong = row["refined"]["wrong_called_good"] + row["online"]["wrong_called_good"]
    refined = row["refined"]
    error = max((refined[name]["p95"] for name in _AXES if refined[name] is not None), default=float("inf"))
    return float(wrong), float(refined["right_called_bad"]), error
