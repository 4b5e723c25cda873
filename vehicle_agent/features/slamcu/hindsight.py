"""Where the vehicle was, by wheels, gyro and GNSS alone, with the fixes that came later.

The GNSS's slow error hides metres from a filter that looks back only. Fixes of the minutes before and after, tied by
wheels and gyro, average it: 0.5 m along the road and 1 m across, where the filter (`blind.py`) has 1.6 m. That is
sure enough to find out, though not while it happens, that a gantry was read a lane off. Fixed-interval smoother of
Rauch, Tung and Striebel (1965), over the steps from fix to fix of the blind filter.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.slamcu.blind import BlindBelief, BlindFilter
from gnd.vehicle_agent.features.slamcu.noise import GNSS_INTERVAL_S

LASTING_M: Final = 0.5
"""What a GNSS may be off by all the while (ionosphere, the antenna's place), each axis."""
TOO_SURE: Final = 2.0
"""The particles' covariance is too small by this: associations are taken for certain, and resampling forgets. Of the
drives of seeds 100 to 144, as the next two."""
SIGN_M: Final = 0.3
"""And by this, each axis: errors that stay with a sign, however often it is measured."""
ELSEWHERE: Final = 0.2
"""Share of places that are those of other signs: more than are (a few in a hundred), for these are what is never to be
called sure."""
ELSEWHERE_M: Final = 4.0
"""Sigma of how far off those are, each axis: a lane."""
AROUND_S: Final = 2.0
"""A pose is compared with a fix at most so far away."""
GATE: Final = 13.8
"""χ² of 2 degrees of freedom, one in 1,000: a question costs time only."""
GATE_SURE: Final = 18.4
"""One in 10,000."""
LEAST_S: Final = 2.0
"""A shorter contradiction is none: a sign at the edge of view turns the place for a moment."""
CORRELATED_S: Final = 20.0
"""So far apart hindsight is independent for two poses: the GNSS's slow error, and the way between signs."""
MOST_EACH: Final = 15.0


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """Where the vehicle was at K fixes.

    Attributes:
        t_s: float64 (K,), time of the drive, ascending.
        mean: float64 (K, 3), x, y [m], heading [rad].
        cov: float64 (K, 3, 3).
    """

    t_s: F64
    mean: F64
    cov: F64

    def __len__(self) -> int:
        return len(self.t_s)


@dataclass(frozen=True, slots=True, eq=False)
class _Step:
    """From one fix to the next: what was expected, by which transition, and what was believed with the fix."""

    t_s: float
    F: F64
    expected: BlindBelief
    believed: BlindBelief


class Hindsight:
    """A blind filter that remembers.

    Args:
        first: the belief at the start.
    """

    def __init__(self, first: BlindBelief) -> None:
        self._blind = BlindFilter(first)
        self._steps: list[_Step] = []
        self.now_s = 0.0
        self._fix_s: float | None = None

    def predict(self, dt_s: float, speed_mps: float, yaw_rate_radps: float) -> None:
        """The vehicle drove on."""
        self._blind.predict(dt_s, speed_mps, yaw_rate_radps)
        self.now_s += dt_s

    def fix(self, xy_m: F64, sigma_m: float) -> None:
        """Take a fix (2,); as `Slamcu.gnss`, not more often than every `GNSS_INTERVAL_S`."""
        since_s = GNSS_INTERVAL_S if self._fix_s is None else self.now_s - self._fix_s
        if since_s + 1e-6 < GNSS_INTERVAL_S:
            return
        self._fix_s = self.now_s
        self._blind.fix(xy_m, sigma_m, since_s)
        expected, F = self._blind.expected
        self._steps.append(_Step(self.now_s, F, expected, self._blind.belief))

    def smoothed(self, from_s: float = 0.0) -> Smoothed:
        """The places at the fixes since `from_s`, by all that is known now."""
        steps = [step for step in self._steps if step.t_s >= from_s]
        if not steps:
            return Smoothed(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)))
        mean, cov = steps[-1].believed.mean, steps[-1].believed.cov
        means, covs = [mean], [cov]
        for step, after in zip(steps[-2::-1], steps[:0:-1], strict=True):
            gain = np.linalg.solve(after.expected.cov, after.F @ step.believed.cov).T
            mean = step.believed.mean + gain @ (mean - after.expected.mean)
            cov = step.believed.cov + gain @ (cov - after.expected.cov) @ gain.T
            means.append(mean)
            covs.append(cov)
        return Smoothed(
            np.array([step.t_s for step in steps]), np.array(means[::-1])[:, :3], np.array(covs[::-1])[:, :3, :3]
        )


def apart_from(t_s: F64, pose: F64, cov: F64, smoothed: Smoothed) -> tuple[F64, F64, F64]:
    """How far poses are from hindsight's.

    The difference is taken at each fix, and interpolated for the poses between and next to fixes: wheels and gyro give
    the way of either. Far from any fix it is 0.

    Args:
        t_s: (S,) times, ascending.
        pose: (S, 3).
        cov: (S, 3, 3).
        smoothed: with at least one fix.

    Returns:
        off_m (S, 2) pose minus hindsight; total_m2 (S, 2, 2) its covariance; squared (S,) Mahalanobis distance.
    """
    at_s = smoothed.t_s
    inside = (at_s >= t_s[0] - AROUND_S) & (at_s <= t_s[-1] + AROUND_S)
    total = held(cov)[:, :2, :2] + LASTING_M**2 * np.eye(2)
    if not inside.any():
        return np.zeros((len(t_s), 2)), total, np.zeros(len(t_s))
    at_s, mean = at_s[inside], smoothed.mean[inside, :2]
    there = np.column_stack([interpolated(at_s, t_s, pose[:, axis]) for axis in (0, 1)]) - mean
    ahead = np.searchsorted(at_s, t_s).clip(0, len(at_s) - 1)
    behind = np.maximum(ahead - 1, 0)
    near = np.where(t_s - at_s[behind] < np.abs(at_s[ahead] - t_s), behind, ahead)
    is_near = np.abs(at_s[near] - t_s) <= AROUND_S
    off = np.column_stack([np.interp(t_s, at_s, there[:, axis]) for axis in (0, 1)]) * is_near[:, None]
    total = total + smoothed.cov[inside][near, :2, :2]
    return off, total, np.einsum("si,si->s", off, np.linalg.solve(total, off[..., None])[..., 0])


def interpolated(at_s: F64, t_s: F64, values: F64) -> F64:
    """Values (S,) over t_s, at other times; beyond the ends on the last straight line."""
    if len(t_s) < 2:
        return np.full(len(at_s), values[0])
    row = (np.searchsorted(t_s, at_s) - 1).clip(0, len(t_s) - 2)
    slope = (values[row + 1] - values[row]) / np.maximum(t_s[row + 1] - t_s[row], 1e-9)
    return np.asarray(values[row] + slope * (at_s - t_s[row]))


def elsewhere(off_m: F64, total_m2: F64) -> F64:
    """(S,) probability that a place is another one, of how far it is from hindsight: two Gaussians, one a lane wide."""
    wide = total_m2 + ELSEWHERE_M**2 * np.eye(2)
    logs = []
    for cov in (total_m2, wide):
        squared = np.einsum("si,si->s", off_m, np.linalg.solve(cov, off_m[..., None])[..., 0])
        logs.append(-0.5 * squared - 0.5 * np.log(np.linalg.det(cov)))
    odds = ELSEWHERE / (1.0 - ELSEWHERE) * np.exp(np.minimum(logs[1] - logs[0], 50.0))
    return np.asarray(odds / (1.0 + odds))


def claimed(t_s: F64, pose: F64, cov: F64, smoothed: Smoothed) -> F64:
    """(S, 3, 3) covariances that hold the particles' place and hindsight's: the moments of both, mixed, about the
    particles' pose.
    """
    if not (len(smoothed) and len(t_s)):
        return held(cov)
    off, total, _ = apart_from(t_s, pose, cov, smoothed)
    return mixed(held(cov), off, total)


def mixed(cov: F64, off_m: F64, total_m2: F64) -> F64:
    """(S, 3, 3) covariances about poses that another source has `off_m` elsewhere: `total_m2` is that of both."""
    share = elsewhere(off_m, total_m2)[:, None, None]
    there = total_m2 - cov[:, :2, :2] + off_m[:, :, None] * off_m[:, None, :]
    wide = cov.copy()
    wide[:, :2, :2] = (1.0 - share) * cov[:, :2, :2] + share * there
    return wide


def held(cov: F64) -> F64:
    """(S, 3, 3) what a place of the particles may be off by, of their covariances."""
    wide = cov.copy()
    wide[:, :2, :2] = TOO_SURE * cov[:, :2, :2] + SIGN_M**2 * np.eye(2)
    return wide


def claimed_now(pose: F64, cov: F64, blind: BlindBelief) -> F64:
    """(3, 3) the covariance of a pose (3,) while nothing of what comes is known: held against the blind filter."""
    wide = held(cov[None])
    total = wide[:, :2, :2] + blind.cov[None, :2, :2] + LASTING_M**2 * np.eye(2)
    return np.asarray(mixed(wide, (pose - blind.mean[:3])[None, :2], total)[0])


def stretches(t_s: F64, wrong: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """From and until of runs of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], wrong, [False]]).astype(np.int8)))
    return [(float(t_s[a]), float(t_s[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]


@dataclass(frozen=True, slots=True)
class Contradiction:
    """A stretch whose poses hindsight denies.

    Attributes:
        from_s: time of the drive.
        until_s: its end.
        squared: largest Mahalanobis distance, squared.
        off_m: largest distance.
    """

    from_s: float
    until_s: float
    squared: float
    off_m: float


def contradictions(t_s: F64, pose: F64, cov: F64, smoothed: Smoothed, gate: float = GATE) -> list[Contradiction]:
    """Stretches of a path, (S,), (S, 3), (S, 3, 3), that are beyond the gate for `LEAST_S` or more."""
    if not (len(smoothed) and len(t_s)):
        return []
    off, _, squared = apart_from(t_s, pose, cov, smoothed)
    found = []
    for from_s, until_s in stretches(t_s, squared > gate):
        inside = (t_s >= from_s) & (t_s <= until_s)
        if until_s - from_s >= LEAST_S:
            found.append(
                Contradiction(from_s, until_s, float(squared[inside].max()), float(np.hypot(*off[inside].T).max()))
            )
    return found


def speaks_against(t_s: F64, pose: F64, cov: F64, smoothed: Smoothed) -> float:
    """Cost of a path by hindsight, natural logarithm."""
    if not (len(smoothed) and len(t_s)):
        return 0.0
    _, _, squared = apart_from(t_s, pose, cov, smoothed)
    each = np.clip(0.5 * squared - 2.0, 0.0, MOST_EACH)
    return float((each * np.diff(t_s, prepend=t_s[0])).sum()) / CORRELATED_S
