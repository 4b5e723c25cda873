"""The time offset between the LiDAR's clock and that of wheels and gyro, found while driving.

Way and turn of a scan-to-scan step need no motion sensor. Wheel speed and yaw rate, integrated between the same two
times, differ from them by the offset times what speed and yaw rate changed by. So a vehicle that brakes, accelerates or
turns makes the offset observable; one that drives on evenly does not, and then it does no harm.

A window of steps is fitted at once, by Gauss and Newton, for offset, its rate, and what else such differences could
come from: wheel scale, the tyres' slip under acceleration, gyro bias. Neighbouring steps share the error of the scan
between them, with opposite signs. Steps that leave the window leave what they knew of the offset behind; it fades.
"""

from collections import deque
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.jit import bare
from gnd.vehicle_agent.localise.odometry import ClockModel, MotionBuffer
from gnd.vehicle_agent.localise.scan_odometry import ScanStep

ClockDoubt = Literal["none", "large", "unsure", "drifting", "jumped"]

PRIOR_S: Final = 0.04
"""One sigma of the offset before anything is known."""
RATE_PRIOR: Final = 5e-4
"""One sigma of its rate: half a millisecond in a second, far more than two crystals differ by."""
MOST_RATE: Final = 4.5 * RATE_PRIOR
"""Of a clock that is followed: 2.25 ms in a second. A larger rate contradicts what the fit takes for granted."""
MOST_S: Final = 0.1
"""A larger offset is none of a clock that is meant to be the same."""
SEARCH_S: Final = 0.3
LARGE_S: Final = 0.07
KNOWN_S: Final = 0.01
WINDOW_NS: Final = 30_000_000_000
BLOCK_NS: Final = 10_000_000_000
"""So much leaves the window at once."""
LAST_NS: Final = 5_000_000_000
"""So much at the window's end is asked whether the clock has jumped; and so long a clock that did is doubted."""
JUMP_S: Final = 0.02
"""A smaller jump is followed as drift is."""
EVERY_NS: Final = 500_000_000
SLIP_REACHES_NS: Final = 300_000_000
"""The largest offset, and what speeds are averaged over."""
LEAST_STEPS: Final = 8
WALK_S: Final = 3e-4
RATE_WALK: Final = 1e-5
"""How much more uncertain offset and rate become in a root second, beyond what the rate explains."""
FLOOR_S: Final = 5e-4
SHARED: Final = -0.375
"""Correlation of neighbouring steps: 3/4 of a step's variance are the errors of its two scans (decision 0086)."""
GROWN: Final = 1.5
"""By which a sigma of the fit is grown for what the steps of a stretch share, such as drift of the rolling map."""
OUTLIER: Final = 4.0
LEAST_TRUE: Final = 0.3
"""A smaller share of the changes of speed or yaw rate that is no noise counts as none."""
MEDIAN_OF_SQUARE: Final = 0.455
"""Of a normal variable of variance 1."""
_HALF_S: Final = 0.15  # speed and yaw rate at a time are means over twice this: their noise is no acceleration
_PRIOR_SIGMA: Final = np.array([PRIOR_S, RATE_PRIOR, 0.05, 1e-3, 0.01])
"""Of offset [s], rate, wheel scale, slip [s²/m: share of the speed for each m/s²], gyro bias [rad/s]."""
_PRIOR_MEAN: Final = np.array([0.0, 0.0, 1.0, 0.0, 0.0])


@dataclass(frozen=True, slots=True)
class ClockEstimate:
    """What is known of the clock: stamps of wheels and gyro are `offset_s` later than those of the LiDAR, at `at_ns`
    of the LiDAR's clock, growing by `rate`; one sigma each; `doubt`: why it is not to be relied on.
    """

    at_ns: int
    offset_s: float = 0.0
    offset_sigma_s: float = PRIOR_S
    rate: float = 0.0
    rate_sigma: float = RATE_PRIOR
    doubt: ClockDoubt = "none"

    def __post_init__(self) -> None:
        if not (np.isfinite([self.offset_s, self.rate]).all() and min(self.offset_sigma_s, self.rate_sigma) > 0):
            raise ValueError(f"finite values and positive sigmas are required, got {self}")


@dataclass(frozen=True, slots=True)
class ClockStep:
    """Forward way [m] and turn [rad] between two times of the LiDAR's clock, by scans, with one sigma each."""

    first_ns: int
    last_ns: int
    forward_m: float
    yaw_rad: float
    forward_sigma_m: float
    yaw_sigma_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class MotionSignal:
    """Speed and yaw rate as measured, N samples, and their integrals; time in seconds after some moment.

    Attributes:
        t_s, speed_mps, yaw_rate_radps: (N,).
        way_m, turn_rad: (N,) since the first sample, straight lines between the samples.
        period_s: between two samples.
        variance: (2,) of the noise of speed and yaw rate, from neighbouring samples.
    """

    t_s: F64
    speed_mps: F64
    yaw_rate_radps: F64
    way_m: F64
    turn_rad: F64
    period_s: float
    variance: F64

    @classmethod
    def of(cls, t_s: F64, speed_mps: F64, yaw_rate_radps: F64) -> "MotionSignal":
        """From samples (N,) in time order."""
        second = np.diff(np.stack([speed_mps, yaw_rate_radps], axis=1), 2, axis=0)
        variance = np.median(second**2, axis=0) / (6.0 * MEDIAN_OF_SQUARE)
        way_m, turn_rad = _running_integral(t_s, speed_mps), _running_integral(t_s, yaw_rate_radps)
        return cls(t_s, speed_mps, yaw_rate_radps, way_m, turn_rad, float(np.median(np.diff(t_s))), variance)

    def integrals(self, at_s: F64) -> tuple[F64, F64]:
        """Way [m] and turn [rad] since the first sample at times (M,); the ends are continued level."""
        way_m, turn_rad = np.empty(len(at_s)), np.empty(len(at_s))
        integrals_at(self.t_s, self.speed_mps, self.yaw_rate_radps, self.way_m, self.turn_rad, at_s, way_m, turn_rad)
        return way_m, turn_rad

    def rates(self, at_s: F64) -> tuple[F64, F64]:
        """Speed [m/s] and yaw rate [rad/s] at times (M,), means over `2 * _HALF_S`."""
        after, before = self.integrals(at_s + _HALF_S), self.integrals(at_s - _HALF_S)
        return (after[0] - before[0]) / (2 * _HALF_S), (after[1] - before[1]) / (2 * _HALF_S)

    def noise_of_changes(self, step_s: float) -> F64:
        """(2,) variances that noise alone gives the changes of `rates` over a step."""
        window, out = 2.0 * _HALF_S / self.period_s, min(step_s, 2.0 * _HALF_S) / self.period_s
        return np.asarray(2.0 * out / window**2 * self.variance)


@dataclass(frozen=True, slots=True, eq=False)
class OffsetPrior:
    """What is known beforehand: (offset [s], rate) at `at_ns` of the LiDAR's clock, with covariance (2, 2)."""

    at_ns: int
    values: F64
    covariance: F64

    def later(self, at_ns: int) -> "OffsetPrior":
        """The same at another time."""
        dt_s = (at_ns - self.at_ns) * 1e-9
        F = np.array([[1.0, dt_s], [0.0, 1.0]])
        grown = np.diag([WALK_S**2, RATE_WALK**2]) * abs(dt_s)
        return OffsetPrior(at_ns, F @ self.values, F @ self.covariance @ F.T + grown)


def nothing_known(at_ns: int) -> OffsetPrior:
    """The prior before anything is known."""
    return OffsetPrior(at_ns, np.zeros(2), np.diag([PRIOR_S**2, RATE_PRIOR**2]))


@dataclass(frozen=True, slots=True, eq=False)
class ClockFit:
    """Offset at the window's end, rate, scale, slip and bias (5,), their covariance (5, 5), and for each step whether
    its way and its turn took part (N, 2).
    """

    values: F64
    covariance: F64
    used: NDArray[np.bool_]

    @property
    def offset(self) -> tuple[float, float]:
        """Offset at the window's end and one sigma [s]."""
        return float(self.values[0]), float(np.hypot(np.sqrt(self.covariance[0, 0]), FLOOR_S))


class ClockEstimator:
    """Feeds on scan-to-scan steps in time order, and on the samples of a `MotionBuffer`, which it sets the clock of."""

    def __init__(self, motion: MotionBuffer) -> None:
        self._motion = motion
        self._steps: deque[ClockStep] = deque()
        self._solved_ns = 0
        self._old: OffsetPrior | None = None  # what left the window knew
        self._unsteady: tuple[int, ClockDoubt] = (-LAST_NS, "none")  # when the clock drifted or jumped
        self.estimate = ClockEstimate(0)

    def see(self, first_ns: int, last_ns: int, seen: ScanStep | None) -> None:
        """Take the motion between two scans by the scans, if it is known; now and then, set the clock."""
        if seen is not None and last_ns > first_ns:
            sigma = np.sqrt(np.diag(seen.covariance))
            T = seen.T_before_now
            yaw = float(np.arctan2(T[1, 0], T[0, 0]))
            if not seen.slipping:
                self.push(ClockStep(first_ns, last_ns, float(T[0, 3]), yaw, float(sigma[3]), float(sigma[2])))
        self.update(last_ns)

    def see_slip(self, t_ns: int) -> None:
        """The wheels slip at a time: steps that such samples could belong to, whatever the offset, are left out."""
        while self._steps and self._steps[-1].last_ns > t_ns - SLIP_REACHES_NS:
            self._steps.pop()

    def push(self, step: ClockStep) -> None:
        """Take a step; one that is not later than the one before makes all begin anew."""
        if self._steps and step.first_ns < self._steps[-1].first_ns:
            self.forget()
        self._steps.append(step)

    def forget(self) -> None:
        """All stamps begin anew."""
        self._steps.clear()
        self._old, self._solved_ns, self._unsteady = None, 0, (-LAST_NS, "none")
        self.estimate = ClockEstimate(0)
        self._motion.clock = ClockModel()

    def update(self, now_ns: int) -> None:
        """Fit the window anew when half a second has passed since."""
        if now_ns - self._solved_ns < EVERY_NS or not self._steps:
            return
        self._solved_ns = now_ns
        self._leave(now_ns - WINDOW_NS)
        known = self._covered()
        if len(known) < LEAST_STEPS:
            return
        signal = self._signal(known[0].first_ns)
        fit = fit_clock(known, signal, known[0].first_ns, self._prior(known[-1].last_ns))
        self._tell(fit, known, self._jumped(fit, known, signal))

    def _covered(self) -> list[ClockStep]:
        """The steps that the samples reach, whatever the offset."""
        reach_ns = round(MOST_S * 1e9)
        last_ns = self._motion.last_stamp_ns - reach_ns if len(self._motion) else 0
        return [step for step in self._steps if step.last_ns <= last_ns]

    def _signal(self, zero_ns: int) -> MotionSignal:
        t_ns, speed, yaw_rate = self._motion.samples(zero_ns - 2 * round(SEARCH_S * 1e9))
        return MotionSignal.of(np.asarray((t_ns - zero_ns) * 1e-9, np.float64), speed, yaw_rate)

    def _prior(self, at_ns: int) -> OffsetPrior:
        known = None if self._old is None else self._old.later(at_ns)
        return nothing_known(at_ns) if known is None or known.covariance[0, 0] > PRIOR_S**2 else known

    def _leave(self, before_ns: int) -> None:
        """Blocks of steps that are too old go; their estimate of the offset is kept."""
        while self._steps and self._steps[0].last_ns < before_ns - BLOCK_NS:
            end_ns = self._steps[0].first_ns + BLOCK_NS
            block: list[ClockStep] = []
            while self._steps and self._steps[0].last_ns <= end_ns:
                block.append(self._steps.popleft())
            if not block:
                block.append(self._steps.popleft())
            self._keep(block)

    def _keep(self, block: list[ClockStep]) -> None:
        if len(block) < LEAST_STEPS:
            return
        at_ns = block[-1].last_ns
        fit = fit_clock(block, self._signal(block[0].first_ns), block[0].first_ns, self._prior(at_ns))
        self._old = OffsetPrior(at_ns, fit.values[:2], fit.covariance[:2, :2])

    def _jumped(self, fit: ClockFit, known: list[ClockStep], signal: MotionSignal) -> bool:
        """True when the last steps alone give another offset than the whole window; the rest of it goes then."""
        last = [step for step in known if step.first_ns >= known[-1].last_ns - LAST_NS]
        if len(last) < LEAST_STEPS or len(last) == len(known):
            return False
        zero_ns = known[0].first_ns
        alone = fit_clock(last, signal, zero_ns, nothing_known(last[-1].last_ns))
        (value, sigma), (whole, whole_sigma) = alone.offset, fit.offset
        if abs(value - whole) < max(JUMP_S, 4.0 * np.hypot(sigma, whole_sigma)):
            return False
        self._steps = deque(last)
        self._old = None
        return True

    def _tell(self, fit: ClockFit, known: list[ClockStep], jumped: bool) -> None:
        (offset, sigma), at_ns = fit.offset, known[-1].last_ns
        rate, rate_sigma = float(fit.values[1]), float(np.sqrt(fit.covariance[1, 1]))
        if jumped or abs(rate) > MOST_RATE:
            self._unsteady = (at_ns, "jumped" if jumped else "drifting")
        doubt = self._doubt(at_ns, offset, sigma)
        self.estimate = ClockEstimate(at_ns, offset, sigma, rate, rate_sigma, doubt)
        self._motion.clock = ClockModel(at_ns, offset, rate)

    def _doubt(self, at_ns: int, offset_s: float, sigma_s: float) -> ClockDoubt:
        if abs(offset_s) > MOST_S:
            return "large"
        since_ns, doubt = self._unsteady
        if at_ns - since_ns < LAST_NS:
            return doubt
        return "unsure" if sigma_s > KNOWN_S and abs(offset_s) - sigma_s > LARGE_S else "none"


def fit_clock(steps: list[ClockStep], signal: MotionSignal, zero_ns: int, prior: OffsetPrior) -> ClockFit:
    """Offset, its rate, scale, slip and bias that make the samples agree with the steps.

    Args:
        steps: N in time order.
        signal: the samples, by their own clock.
        zero_ns: the stamp that is their time 0.
        prior: of offset and rate at the last step's end.
    """
    first, last = (np.array([getattr(s, name) - zero_ns for s in steps]) * 1e-9 for name in ("first_ns", "last_ns"))
    seen = np.array([[s.forward_m, s.yaw_rad] for s in steps])
    sigma = np.array([[s.forward_sigma_m, s.yaw_sigma_rad] for s in steps])
    joined = np.append(np.abs(first[1:] - last[:-1]) < 1e-6, False)
    mean, known = _PRIOR_MEAN.copy(), np.diag(_PRIOR_SIGMA**-2.0)
    mean[:2], known[:2, :2] = prior.values, np.linalg.inv(prior.covariance)
    false_changes = signal.noise_of_changes(float(np.median(last - first)))
    values, used = mean.copy(), np.ones(seen.shape, np.bool_)
    for turn in range(8):
        rest, J = _residuals(values, first, last, seen, signal)
        J[:, :, :2] *= _believed(J[:, :, 0], false_changes)[:, None]
        noise = sigma * _noise_factor(rest, sigma, used)
        if turn >= 2:
            used = np.abs(rest) < OUTLIER * noise
        information, gradient = known.copy(), known @ (mean - values)
        for k in range(2):
            A, b = _whitened(J[:, k], rest[:, k], noise[:, k], used[:, k], joined)
            information, gradient = information + A / GROWN**2, gradient + b / GROWN**2
        change = np.linalg.solve(information, gradient)
        values = values + change
        values[0] = np.clip(values[0], -SEARCH_S, SEARCH_S)
        if turn >= 4 and abs(change[0]) < 1e-5:
            break
    return ClockFit(values, np.asarray(np.linalg.inv(information), np.float64), used)


def _residuals(values: F64, first: F64, last: F64, seen: F64, signal: MotionSignal) -> tuple[F64, F64]:
    """(N, 2) ways and turns of the steps minus those of the samples, and how the latter change with the values
    (N, 2, 5).
    """
    offset, rate, scale, slip, bias = values
    age_first, age_last = first - last[-1], last - last[-1]
    begin, end = first + offset + rate * age_first, last + offset + rate * age_last
    (way_a, yaw_a), (way_b, yaw_b) = signal.integrals(begin), signal.integrals(end)
    (v_a, w_a), (v_b, w_b) = signal.rates(begin), signal.rates(end)
    way, squares, dt = way_b - way_a, 0.5 * (v_b**2 - v_a**2), last - first
    rest = seen - np.stack([scale * way + slip * squares, yaw_b - yaw_a - bias * dt], axis=1)
    zero = np.zeros_like(way)
    forward = np.stack([scale * (v_b - v_a), scale * (v_b * age_last - v_a * age_first), way, squares, zero], axis=1)
    yaw = np.stack([w_b - w_a, w_b * age_last - w_a * age_first, zero, zero, -dt], axis=1)
    return rest, np.stack([forward, yaw], axis=1)


def _believed(changes: F64, false_changes: F64) -> F64:
    """(2,) what to multiply the changes (N, 2) of speed and yaw rate by: noise makes some, which do not count. None are
    believed where most are noise.
    """
    share = 1.0 - false_changes / np.maximum(np.mean(changes**2, axis=0), 1e-12)
    return np.asarray(np.sqrt(np.where(share > LEAST_TRUE, share, 0.0)))


def _noise_factor(rest: F64, sigma: F64, used: NDArray[np.bool_]) -> F64:
    """(2,) by how much ways and turns are noisier than claimed, from the middle of what is left over; at least 0.7."""
    ratio = np.abs(rest) / sigma
    middle = [np.median(ratio[used[:, k], k]) if used[:, k].any() else np.inf for k in range(2)]
    return np.maximum(1.4826 * np.array(middle), 0.7)


def _whitened(J: F64, rest: F64, noise: F64, used: NDArray[np.bool_], joined: NDArray[np.bool_]) -> tuple[F64, F64]:
    """J' C⁻¹ J (5, 5) and J' C⁻¹ r (5,) of the steps used, C tri-diagonal: steps that meet share a scan."""
    at = np.flatnonzero(used)
    if not len(at):
        return np.zeros((5, 5)), np.zeros(5)
    A, r = J[at] / noise[at, None], rest[at] / noise[at]
    shared = np.where((np.diff(at) == 1) & joined[at[:-1]], SHARED, 0.0)
    whitened = np.column_stack([A, r])
    solve_chain(shared, np.ones(len(at)), whitened)
    return A.T @ whitened[:, :5], A.T @ whitened[:, 5]


@bare
def solve_chain(beside: F64, diagonal: F64, columns: F64) -> None:
    """Put C⁻¹ x in the place of the columns x (N, M), C tri-diagonal and positive definite, by Cholesky (LAPACK's pbtrf
    and pbtrs with one band).

    Args:
        beside: (N - 1,) what stands beside C's diagonal.
        diagonal: (N,) its diagonal; the factor's afterwards.
        columns: (N, M), C-contiguous.
    """
    n, m = columns.shape
    for i in range(n):
        if i > 0:
            diagonal[i] -= (beside[i - 1] / diagonal[i - 1]) ** 2
        diagonal[i] = np.sqrt(diagonal[i])
        for k in range(m):
            if i > 0:
                columns[i, k] -= beside[i - 1] / diagonal[i - 1] * columns[i - 1, k]
            columns[i, k] /= diagonal[i]
    for i in range(n - 1, -1, -1):
        for k in range(m):
            if i < n - 1:
                columns[i, k] -= beside[i] / diagonal[i] * columns[i + 1, k]
            columns[i, k] /= diagonal[i]


def _running_integral(t: F64, y: F64) -> F64:
    """(N,) the integral of straight lines through (t, y) (N,) from t[0] on."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (y[1:] + y[:-1]) * np.diff(t))])


@bare
def integrals_at(
    t: F64, speed: F64, yaw_rate: F64, way: F64, turn: F64, at: F64, way_at: F64, turn_at: F64
) -> None:  # fmt: skip
    """Fill `way_at` and `turn_at` (M,) with the integrals of straight lines through speed and yaw rate (N,), from t[0]
    to the times `at` (M,), of which `way` and `turn` (N,) are those to t (N,). The ends are continued level.
    """
    last, k = t.shape[0] - 1, 0
    for m in range(at.shape[0]):
        while k < last - 1 and t[k + 1] <= at[m]:
            k += 1
        while k > 0 and t[k] > at[m]:
            k -= 1
        after, span = min(max(at[m], t[0]), t[last]) - t[k], t[k + 1] - t[k]
        before_s, beyond_s = min(at[m] - t[0], 0.0), max(at[m] - t[last], 0.0)
        half = 0.5 * ((speed[k + 1] - speed[k]) / span)
        way_at[m] = way[k] + speed[k] * after + half * (after * after)
        way_at[m] += beyond_s * speed[last] + before_s * speed[0]
        half = 0.5 * ((yaw_rate[k + 1] - yaw_rate[k]) / span)
        turn_at[m] = turn[k] + yaw_rate[k] * after + half * (after * after)
        turn_at[m] += beyond_s * yaw_rate[last] + before_s * yaw_rate[0]
