"""Rao-Blackwellised particle filter (SLAMCU, section 5; FastSLAM): poses in particles, features in an EKF per particle.

Beside its pose a particle holds the wheel's scale and the gyro's bias, and the GNSS's slow error as a Kalman filter.

Features whose position is known otherwise (the map's) are measured like new ones. The known position is one more
measurement of the feature, p(m | map), and multiplies the weights once: provisionally while the feature is in view,
for good in `settle`. For a map without errors this equals weighing with Eq. (17) at each measurement; for a real one it
counts the map's error once and not at each look, and what the drive measured by itself stays known.

Resampling draws particles again and again from fewer ancestors, and covariances shrink without reason. So resampled
particles are spread anew by the differences of random pairs, and drawn towards the mean by as much: mean and
covariance of poses, biases and features stay (Liu and West 2001, with pairs in place of a Gaussian kernel).
"""

from collections.abc import Callable, Collection
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.vehicle_agent.features.slamcu import measurement, noise
from gnd.vehicle_agent.features.slamcu.blind import BIAS, GNSS_X, HEADING, SCALE, STANDING_MPS, BlindBelief, X, Y
from gnd.vehicle_agent.features.view import wrapped

Prior = tuple[F64, F64]
"""Position (2,) and covariance (3,) xx, xy, yy."""
FLOOR_PER_M2: Final = 1e-5
"""Density of a map feature's measured position if it is none: one chance in a thousand, somewhere within 100 m^2."""
_RESAMPLE_BELOW: Final = 0.5
"""α of Eq. (20): particles are resampled when their effective number falls below this share of M."""
_JITTER: Final = 0.45
"""h: a resampled particle keeps √(1-h²) of its distance from the mean; h of that of another pair makes up for it.
0 is plain resampling."""
_FLOOR: Final = 4e-4
"""Density, 1/(m·rad), of a measurement that belongs to something else although it was associated: about one false
alarm in fifty looks over 80 m x 40°. It keeps a wrong association from deciding about the particles."""
_MOST_STAGES: Final = 20
"""A likelihood is taken in at most so many steps."""


class ParticleFilter:
    """M particles, each a pose with an EKF of every feature that is being estimated.

    Args:
        particles: M.
        pose0: (3,) x, y [m], heading [rad] at the start.
        cov0: (3, 3) its covariance.
        rng: where chance comes from.

    Attributes:
        state: (7, M) x, y [m], heading [rad], wheel scale, gyro bias [rad/s], slow GNSS error [m].
        log_weight: (M,), not normalised.
        camera: (2, M) errors of the camera: share of all ranges, and its bearing [rad]; zero unless `calibrate` was
            called.
        mean: (F, M, 4) of the features: position [m], and errors of range (share) and bearing [rad] that stay with it.
        cov: (F, M, 10) their covariances, `measurement.PACKED`.
        held: (2,) variances of the errors that stay with a feature, of those that are added.
        priors: F positions known otherwise that are not yet settled, None where there is none.
        provisional: F, whether such a prior weighs the particles already; not where it may be another feature's.
        rng: where chance comes from.
        weighing: whether measurements weigh particles; not where poses are given.
        as_printed: whether a feature of the map weighs particles by Eq. (17) at each look, its place taken as exact, as
            the paper has it; for studies.
    """

    def __init__(self, particles: int, pose0: F64, cov0: F64, rng: np.random.Generator) -> None:
        self.rng, m = rng, particles
        self.offsets = _standard(rng, m)
        self.state = np.zeros((7, m))
        self.place(pose0, cov0)
        if m > 1:
            self.state[SCALE] = noise.SCALE * rng.standard_normal(m)
            self.state[BIAS] = noise.BIAS_RADPS * rng.standard_normal(m)
        self._gnss_var: float | None = None
        self.log_weight = np.zeros(m)
        self.camera, self.held = np.zeros((2, m)), np.zeros(2)
        self.mean = np.zeros((0, m, 4))
        self.cov = np.zeros((0, m, 10))
        self.priors: list[Prior | None] = []
        self.provisional: list[bool] = []
        self.weighing, self.as_printed = True, False

    @property
    def m(self) -> int:
        """Number of particles."""
        return self.state.shape[1]

    @property
    def mu(self) -> F64:
        """(F, M, 2) positions of the features."""
        return self.mean[..., :2]

    @property
    def sigma(self) -> F64:
        """(F, M, 3) covariances of these, xx, xy, yy."""
        return self.cov[..., :3]

    def calibrate(self, sigma: F64) -> None:
        """Estimate errors of the camera, which are drawn with these sigmas (2,): share of ranges, bearing [rad]."""
        if self.m > 1:
            self.camera = sigma[:, None] * self.rng.standard_normal((2, self.m))

    def calibration(self) -> tuple[F64, F64]:
        """Errors of the camera: mean (2,) and covariance (2, 2) of the share of ranges, and of the bearing [rad]."""
        weights = self.weights()
        mean = self.camera @ weights
        off = self.camera - mean[:, None]
        return mean, (off * weights) @ off.T

    def place(self, pose: F64, cov: F64) -> None:
        """Draw the poses around one; each particle keeps its side of it, as errors of a localiser last."""
        values, vectors = np.linalg.eigh(cov)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        self.state[:3] = pose[:, None] + root @ self.offsets

    def seed(self, belief: BlindBelief) -> None:
        """Draw the particles anew from a belief; the GNSS's error stays a Kalman filter in each of them."""
        if self.m == 1:
            self.place(belief.mean[:3], belief.cov[:3, :3])
            return
        if self.camera.any():
            self.camera = self.camera[:, systematic(_normalised(self.log_weight), float(self.rng.random()))]
        self.log_weight = np.zeros(self.m)
        driven = belief.cov[:GNSS_X, :GNSS_X]
        values, vectors = np.linalg.eigh(driven)
        off = (vectors * np.sqrt(np.maximum(values, 0.0))) @ self.rng.standard_normal((GNSS_X, self.m))
        self.state[:GNSS_X] = belief.mean[:GNSS_X, None] + off
        gain = belief.cov[GNSS_X:, :GNSS_X] @ np.linalg.pinv(driven, hermitian=True)
        self.state[GNSS_X:] = belief.mean[GNSS_X:, None] + gain @ off
        rest = belief.cov[GNSS_X:, GNSS_X:] - gain @ belief.cov[:GNSS_X, GNSS_X:]
        self._gnss_var = max(0.5 * float(np.trace(rest)), 1e-6) if belief.cov[GNSS_X, GNSS_X] > 0.0 else None

    def predict(self, dt_s: float, speed_mps: float, yaw_rate_radps: float) -> None:
        """Move every particle as the vehicle moved, with what wheels and gyro may be wrong by. Eq. (12)."""
        if abs(speed_mps) < STANDING_MPS:  # what a standing vehicle's gyro shows is its bias
            return
        root, s = np.sqrt(dt_s), self.state
        if self.m > 1:
            e = self.rng.standard_normal((4, self.m)) * root
            s[SCALE] += noise.SCALE_WALK * e[2]
            s[BIAS] += noise.BIAS_WALK_RADPS * e[3]
            way, turn = noise.SPEED_M * e[0], noise.YAW_RAD * e[1]
        else:
            way, turn = np.zeros(1), np.zeros(1)
        way = way + speed_mps * dt_s * (1.0 + s[SCALE])
        turn = turn + (yaw_rate_radps - s[BIAS]) * dt_s
        middle = s[HEADING] + 0.5 * turn
        s[X] += way * np.cos(middle)
        s[Y] += way * np.sin(middle)
        s[HEADING] += turn

    def gnss(self, xy_m: F64, sigma_m: float, dt_s: float) -> None:
        """Weigh with a fix whose error is slow (Gauss-Markov) and white.

        Args:
            xy_m: (2,).
            sigma_m: of each axis, both together.
            dt_s: since the last fix.
        """
        s, fade = self.state, np.exp(-dt_s / noise.GNSS_CORRELATION_S)
        white, slow = noise.gnss_variances_m2(sigma_m)
        before = slow if self._gnss_var is None else self._gnss_var
        var = before * fade**2 + (1.0 - fade**2) * slow
        s[GNSS_X:] *= fade
        total = var + white
        self._weigh(lambda: -0.5 * self._off(xy_m) / total)
        s = self.state
        s[GNSS_X:] += var / total * (xy_m[:, None] - s[:2] - s[GNSS_X:])
        self._gnss_var = var * (1.0 - var / total)

    def add(self, z: F64, variance: F64, prior: Prior | None = None) -> None:
        """A further feature, at the end, where this measurement puts it."""
        mean, cov = measurement.inverse(self.state[:3], z, variance, self.camera, self.held)
        self.mean, self.cov = np.concatenate([self.mean, mean[None]]), np.concatenate([self.cov, cov[None]])
        self.priors.append(prior)
        self.provisional.append(True)

    def remove(self, slot: int) -> None:
        """Forget a feature."""
        self.mean, self.cov = np.delete(self.mean, slot, axis=0), np.delete(self.cov, slot, axis=0)
        del self.priors[slot], self.provisional[slot]

    def measure(self, slot: int, z: F64, variance: F64, *, weigh: bool) -> None:
        """Update a feature with a measurement, Eq. (16), and the weights, Eq. (18) and (19)."""
        prior = self.priors[slot]
        if weigh and self.as_printed and prior is not None:
            place = prior[0]
            self._weigh(lambda: self._floored(self._of_map(place, z, variance)))  # Eq. (17) in place of (18)
            weigh = False
        updated = self._updated(slot, z, variance)
        if weigh and self._weigh(lambda: self._floored(self._updated(slot, z, variance)[2]), self._floored(updated[2])):
            updated = self._updated(slot, z, variance)  # by other particles
        self.mean[slot], self.cov[slot], _ = updated

    def merge(self, kept: int, other: int) -> None:
        """Two features are one: their estimates are made one, and `other` is removed."""
        if self.weighing:
            self.log_weight += measurement.agreement(self.mu[kept], self.sigma[kept], self.mu[other], self.sigma[other])
        self.mean[kept], self.cov[kept] = measurement.fused(
            self.mean[kept], self.cov[kept], self.mu[other], self.sigma[other]
        )
        self.remove(other)

    def weights(self, without: Collection[int] = ()) -> F64:
        """(M,) weights that sum to 1, with positions known otherwise (but not those of the slots `without`)."""
        log = self.log_weight.copy()
        if self.weighing and not self.as_printed:
            for slot, prior in enumerate(self.priors):
                if prior is not None and self.provisional[slot] and slot not in without:
                    log += self._agreement(slot, prior)
        return _normalised(log)

    def settle(self, slot: int) -> None:
        """Take the position known otherwise for good, step by step where it leaves few particles much weight."""
        prior = self.priors[slot]
        if prior is None:
            return
        if not self.as_printed:  # else each look has weighed
            self._weigh(lambda: measurement.agreement(self.mu[slot], self.sigma[slot], *prior))
        self.mean[slot], self.cov[slot] = measurement.fused(self.mean[slot], self.cov[slot], *prior)
        self.priors[slot] = None

    def loosen(self, slots: Collection[int], position_m: float, heading_rad: float) -> None:
        """The place in the map is in doubt: move each particle with these of its features as one body, at random."""
        if not self.weighing:
            return
        shift = position_m * self.rng.standard_normal((2, self.m))
        turn = heading_rad * self.rng.standard_normal(self.m)
        cos, sin = np.cos(turn), np.sin(turn)
        for slot in slots:
            off = self.mu[slot].T - self.state[:2]
            turned = np.stack([cos * off[0] - sin * off[1], sin * off[0] + cos * off[1]])
            self.mean[slot, :, :2] = (self.state[:2] + turned + shift).T
        self.state[:2] += shift
        self.state[HEADING] += turn
        self.state[GNSS_X:] -= shift

    def resample_if_needed(self) -> None:
        """Systematic resampling when the effective number of particles is small. Eq. (20), with squared weights."""
        weights = _normalised(self.log_weight)
        if self.m > 1 and effective(weights) < _RESAMPLE_BELOW * self.m:
            self._resample(weights)

    def expect(self, slot: int, before: F64, after: F64) -> None:
        """The errors that stay with a feature are of another size, variances (2,), than it was begun with."""
        self.mean[slot], self.cov[slot] = measurement.with_prior(self.mean[slot], self.cov[slot], before, after)

    def moments(self, slot: int, weights: F64, held: tuple[F64, F64] | None = None) -> tuple[F64, F64]:
        """Position (2,) and covariance (2, 2) of a feature over all particles: that of a mixture of Gaussians.

        Args:
            slot: of the feature.
            weights: (M,).
            held: variances (2,) of what stays with it: as it was begun with, and those to go by; None: as begun.
        """
        of_each = self.mean[slot], self.cov[slot]
        mean_of, cov_of = of_each if held is None else measurement.with_prior(*of_each, *held)
        mean = weights @ mean_of[:, :2]
        off = mean_of[:, :2] - mean
        between = (off * weights[:, None]).T @ off
        xx, xy, yy = weights @ cov_of[:, :3]
        return mean, between + np.array([[xx, xy], [xy, yy]])

    def errors_of(self, slot: int, weights: F64) -> tuple[F64, F64]:
        """Errors of range (share) and bearing [rad] that stay with a feature: means (2,) and variances (2,)."""
        errors = self.mean[slot, :, 2:]
        mean = weights @ errors
        return mean, weights @ (np.square(errors - mean) + self.cov[slot][:, [7, 9]])

    def pose(self, weights: F64) -> tuple[F64, F64]:
        """Pose (3,) and covariance (3, 3)."""
        near = self.state[:3].copy()
        near[HEADING] = near[HEADING, 0] + wrapped(near[HEADING] - near[HEADING, 0])
        mean = near @ weights
        off = near - mean[:, None]
        return np.array([mean[0], mean[1], float(wrapped(mean[2]))]), (off * weights) @ off.T

    def _agreement(self, slot: int, prior: Prior) -> F64:
        return np.logaddexp(measurement.agreement(self.mu[slot], self.sigma[slot], *prior), np.log(FLOOR_PER_M2))

    def _updated(self, slot: int, z: F64, variance: F64) -> tuple[F64, F64, F64]:
        return measurement.update(self.state[:3], self.mean[slot], self.cov[slot], z, variance, self.camera)

    def _of_map(self, xy_m: F64, z: F64, variance: F64) -> F64:
        return measurement.map_log_likelihood(self.state[:3], xy_m, z, variance, self.camera)

    def _floored(self, log_likelihood: F64) -> F64:
        return np.asarray(np.logaddexp(log_likelihood, np.log(max(_FLOOR, 1e-300))))

    def _off(self, xy_m: F64) -> F64:
        """(M,) squared distances of a fix from where each particle expects it."""
        return np.asarray(np.square(xy_m[:, None] - self.state[:2] - self.state[GNSS_X:]).sum(axis=0))

    def _weigh(self, log_likelihood: Callable[[], F64], first: F64 | None = None) -> bool:
        """Multiply the weights by a likelihood, Eq. (19); in steps, with resampling between, where few of the particles
        would be left with any weight.

        Args:
            log_likelihood: gives (M,) of the particles as they are then.
            first: the same of the particles as they are now.

        Returns:
            Whether particles were resampled.
        """
        if not self.weighing or self.m == 1:
            return False
        left, log = 1.0, log_likelihood() if first is None else first
        for stage in range(_MOST_STAGES):
            step = left if stage == _MOST_STAGES - 1 else self._bearable(log, left)
            self.log_weight += step * log
            left -= step
            if left <= 1e-9:
                return stage > 0
            self._resample(_normalised(self.log_weight))
            log = log_likelihood()
        return True

    def _bearable(self, log: F64, most: float) -> float:
        """The largest share of a log likelihood that leaves enough effective particles."""
        enough = 0.9 * _RESAMPLE_BELOW * self.m

        def bears(share: float) -> bool:
            return effective(_normalised(self.log_weight + share * log)) >= enough

        if bears(most):
            return most
        low, high = 0.0, most
        for _ in range(12):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if bears(middle) else (low, middle)
        return max(low, most / _MOST_STAGES)

    def _resample(self, weights: F64) -> None:
        index = systematic(weights, float(self.rng.random()))
        self.log_weight = np.zeros(self.m)
        self.state, self.mean, self.cov = self.state[:, index], self.mean[:, index], self.cov[:, index]
        self.camera = self.camera[:, index]
        if _JITTER > 0.0:
            one, other = self.rng.permutation(self.m), self.rng.permutation(self.m)
            self.state[HEADING] = self.state[HEADING, 0] + wrapped(self.state[HEADING] - self.state[HEADING, 0])
            self.state = _spread(self.state, 1, one, other, _JITTER)
            self.mean = _spread(self.mean, 1, one, other, _JITTER)
            self.camera = _spread(self.camera, 1, one, other, _JITTER)


def _spread(values: F64, axis: int, one: I64, other: I64, h: float) -> F64:
    """Values nearer to their mean, plus differences of random pairs: the covariance stays, the values differ again."""
    mean = values.mean(axis=axis, keepdims=True)
    pairs = values.take(one, axis) - values.take(other, axis)
    return np.asarray(mean + np.sqrt(1.0 - h * h) * (values - mean) + h / np.sqrt(2.0) * pairs)


def systematic(weights: F64, start: float) -> I64:
    """Indices (M,) of resampled particles: one draw for all, so that a weight of n/M is taken n times, or one more.

    Args:
        weights: (M,), summing to 1.
        start: uniform in [0, 1).
    """
    m = len(weights)
    borders = np.cumsum(weights)
    borders[-1] = 1.0
    return np.asarray(np.searchsorted(borders, (start + np.arange(m)) / m, side="right").clip(0, m - 1), np.int64)


def effective(weights: F64) -> float:
    """Effective number of particles. Eq. (20), with the squares that its sum lacks."""
    return float(1.0 / np.square(weights).sum())


def _normalised(log: F64) -> F64:
    weights = np.exp(log - log.max())
    return np.asarray(weights / weights.sum())


def _standard(rng: np.random.Generator, m: int) -> F64:
    """(3, M) of mean zero and, with enough of them, unit covariance exactly."""
    if m == 1:
        return np.zeros((3, 1))
    e = rng.standard_normal((3, m))
    e -= e.mean(axis=1, keepdims=True)
    if m < 8:
        return np.asarray(e)
    return np.asarray(np.linalg.solve(np.linalg.cholesky(e @ e.T / m), e))
