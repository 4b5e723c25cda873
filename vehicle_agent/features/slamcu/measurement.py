"""Range and bearing of point features, for many particles at once (SLAMCU, section 5.2).

A pose is (x, y, heading) of the vehicle in the map frame; particles lie along the last axis of poses, (3, M), and along
the first of features, (M, 2). Covariances of features are kept as xx, xy, yy.
"""

from typing import Final, NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.view import wrapped

PACKED: Final = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 2), (2, 3), (3, 3))
"""Rows and columns of the ten numbers that a symmetric covariance (4, 4) of x, y, share of range, bearing is kept as:
the first three are those of the position."""


class Predicted(NamedTuple):
    """h and its Jacobian with respect to the feature's position."""

    range_m: F64
    bearing_rad: F64
    cos: F64
    """Direction to the feature in the map frame: H = [[cos, sin], [-sin/range, cos/range]]."""
    sin: F64


def predicted(pose: F64, mu: F64) -> Predicted:
    """Range and bearing at which each particle would measure its feature.

    Args:
        pose: (3, M).
        mu: (M, 2), or (2,) for all.
    """
    dx, dy = mu[..., 0] - pose[0], mu[..., 1] - pose[1]
    range_m = np.maximum(np.hypot(dx, dy), 1e-3)
    return Predicted(range_m, wrapped(np.arctan2(dy, dx) - pose[2]), dx / range_m, dy / range_m)


def inverse(pose: F64, z: F64, variance: F64, camera: F64, held: F64) -> tuple[F64, F64]:
    """The feature that each particle measures, were it the first time.

    Args:
        pose: (3, M).
        z: (2,) range [m] and bearing [rad].
        variance: (2,) of z.
        camera: (2, M), errors of the camera: share of the range, and bearing [rad].
        held: (2,) variances of the same errors that stay with this feature.

    Returns:
        (M, 4) x, y [m] and the errors of range (share) and bearing [rad]; (M, 10) covariances, see `PACKED`.
    """
    scale = 1.0 + camera[0]
    range_m, direction = z[0] / scale, pose[2] + z[1] - camera[1]
    cos, sin = np.cos(direction), np.sin(direction)
    share, turn = range_m * held[0] / scale, np.full_like(cos, held[1])
    along, across = (variance[0] / scale + range_m * share) / scale, (variance[1] + turn) * range_m**2
    none = np.zeros_like(cos)
    mean = np.stack([pose[0] + range_m * cos, pose[1] + range_m * sin, none, none], axis=1)
    xx, xy, yy = cos**2 * along + sin**2 * across, cos * sin * (along - across), sin**2 * along + cos**2 * across
    turned = range_m * turn
    cross = (-share * cos, -share * sin, turned * sin, -turned * cos)
    return mean, np.stack([xx, xy, yy, *cross, none + held[0], none, turn], axis=1)


class Innovation(NamedTuple):
    """A measurement against what each particle predicts; all (M,)."""

    nu_r: F64
    nu_b: F64
    rr: F64
    rb: F64
    bb: F64
    """Q = H Σ Hᵀ + R of Eq. (18)."""
    r: tuple[F64, F64, F64, F64]
    b: tuple[F64, F64, F64, F64]
    """Columns of Σ Hᵀ."""

    @property
    def log_likelihood(self) -> F64:
        """Eq. (18), with the factor -1/2 that its exponent lacks. With Σ = 0 it is Eq. (17)."""
        det = self.rr * self.bb - self.rb**2
        squared = (self.bb * self.nu_r**2 - 2.0 * self.rb * self.nu_r * self.nu_b + self.rr * self.nu_b**2) / det
        return np.asarray(-0.5 * squared - 0.5 * np.log((2.0 * np.pi) ** 2 * det))


def innovation(pose: F64, mean: F64, cov: F64, z: F64, variance: F64, camera: F64) -> Innovation:
    """How a measurement differs from what is predicted; arguments as of `update`."""
    at = predicted(pose, mean)
    scale = 1.0 + camera[0] + mean[:, 2]
    gx, gy = at.cos * scale, at.sin * scale  # ∂range/∂(x, y); ∂range/∂share = range, ∂bearing/∂turn = 1
    tx, ty = -at.sin / at.range_m, at.cos / at.range_m
    xx, xy, yy, xe, ye, xb, yb, ee, eb, bb = cov.T
    r = (
        xx * gx + xy * gy + xe * at.range_m,
        xy * gx + yy * gy + ye * at.range_m,
        xe * gx + ye * gy + ee * at.range_m,
        xb * gx + yb * gy + eb * at.range_m,
    )
    b = (xx * tx + xy * ty + xb, xy * tx + yy * ty + yb, xe * tx + ye * ty + eb, xb * tx + yb * ty + bb)
    return Innovation(
        nu_r=z[0] - at.range_m * scale,
        nu_b=wrapped(z[1] - at.bearing_rad - camera[1] - mean[:, 3]),
        rr=gx * r[0] + gy * r[1] + at.range_m * r[2] + variance[0],
        rb=tx * r[0] + ty * r[1] + r[3],
        bb=tx * b[0] + ty * b[1] + b[3] + variance[1],
        r=r,
        b=b,
    )


def update(pose: F64, mean: F64, cov: F64, z: F64, variance: F64, camera: F64) -> tuple[F64, F64, F64]:
    """EKF update of one feature in every particle, and how likely the measurement was.

    Eq. (16) without the stray inverse at the innovation and with H taken with respect to the feature; beside its
    position the feature has an error of range and of bearing that all of its measurements share.

    Args:
        pose: (3, M).
        mean: (M, 4).
        cov: (M, 10), see `PACKED`.
        z: (2,) range [m] and bearing [rad].
        variance: (2,) of z, the diagonal of R.
        camera: (2, M), errors of the camera: share of the range, and bearing [rad].

    Returns:
        (M, 4) means, (M, 10) covariances, (M,) log likelihoods.
    """
    one = innovation(pose, mean, cov, z, variance, camera)
    det = one.rr * one.bb - one.rb**2
    gain_r = [(r * one.bb - b * one.rb) / det for r, b in zip(one.r, one.b, strict=True)]  # K = Σ Hᵀ Q⁻¹
    gain_b = [(b * one.rr - r * one.rb) / det for r, b in zip(one.r, one.b, strict=True)]
    out_mean = np.stack([gain_r[i] * one.nu_r + gain_b[i] * one.nu_b for i in range(4)], axis=1) + mean
    less = [gain_r[i] * one.r[j] + gain_b[i] * one.b[j] for i, j in PACKED]
    return out_mean, cov - np.stack(less, axis=1), one.log_likelihood


def map_log_likelihood(pose: F64, xy_m: F64, z: F64, variance: F64, camera: F64) -> F64:
    """(M,) log ω_HD of Eq. (17): how likely each particle finds a measurement of a map feature whose place is exact.

    ω_HD = |2πR|^(-1/2) exp{-1/2 (z - ẑ)ᵀ R⁻¹ (z - ẑ)} with ẑ = h(x, m_HD). The paper prints the exponent without the
    factor -1/2; so read, the particle that fits worst would weigh most.

    Args:
        pose: (3, M).
        xy_m: (2,) the feature's place in the map.
        z: (2,) range [m] and bearing [rad].
        variance: (2,) of z, the diagonal of R.
        camera: (2, M), errors of the camera: share of the range, and bearing [rad].
    """
    at = predicted(pose, xy_m)
    nu_r, nu_b = z[0] - at.range_m * (1.0 + camera[0]), wrapped(z[1] - at.bearing_rad - camera[1])
    squared = nu_r**2 / variance[0] + nu_b**2 / variance[1]
    return np.asarray(-0.5 * squared - 0.5 * np.log((2.0 * np.pi) ** 2 * variance[0] * variance[1]))


def agreement(mu: F64, sigma: F64, xy_m: F64, cov: F64) -> F64:
    """(M,) log N(μ - m; 0, Σ + C): how well each particle's feature agrees with a position known otherwise.

    Args:
        mu: (M, 2).
        sigma: (M, 3).
        xy_m: (2,) or (M, 2).
        cov: (3,) or (M, 3), its covariance.
    """
    d, s = mu - xy_m, sigma + cov
    det = s[..., 0] * s[..., 2] - s[..., 1] ** 2
    squared = (s[..., 2] * d[:, 0] ** 2 - 2.0 * s[..., 1] * d[:, 0] * d[:, 1] + s[..., 0] * d[:, 1] ** 2) / det
    return np.asarray(-0.5 * squared - 0.5 * np.log((2.0 * np.pi) ** 2 * det))


def fused(mean: F64, cov: F64, xy_m: F64, other: F64) -> tuple[F64, F64]:
    """A feature's position known otherwise is taken in, in every particle.

    Args:
        mean: (M, 4).
        cov: (M, 10), see `PACKED`.
        xy_m: (2,) or (M, 2).
        other: (3,) or (M, 3), covariance of that.

    Returns:
        (M, 4) means and (M, 10) covariances.
    """
    s = cov[:, :3] + other
    det = s[:, 0] * s[:, 2] - s[:, 1] ** 2
    a, b, c = s[:, 2] / det, -s[:, 1] / det, s[:, 0] / det  # (Σ + C)⁻¹
    columns = [(cov[:, 0], cov[:, 1]), (cov[:, 1], cov[:, 2]), (cov[:, 3], cov[:, 4]), (cov[:, 5], cov[:, 6])]
    gains = [(x * a + y * b, x * b + y * c) for x, y in columns]
    d = xy_m - mean[:, :2]
    out_mean = mean + np.stack([gx * d[:, 0] + gy * d[:, 1] for gx, gy in gains], axis=1)
    less = [gains[i][0] * columns[j][0] + gains[i][1] * columns[j][1] for i, j in PACKED]
    return out_mean, cov - np.stack(less, axis=1)


def with_prior(mean: F64, cov: F64, before: F64, after: F64) -> tuple[F64, F64]:
    """A feature as it would be, had the errors that stay with it been expected to be of another size from the start.

    The prior N(0, before) of these errors is divided out and N(0, after) multiplied in: information M = after⁻¹ -
    before⁻¹ is added, Σ' = Σ - Σ E (M⁻¹ + Eᵀ Σ E)⁻¹ Eᵀ Σ with E the columns of the errors. Exact for the linearised
    feature: its looks need not be taken again.

    Args:
        mean: (M, 4).
        cov: (M, 10), see `PACKED`.
        before: (2,) variances of the errors of range (share) and bearing [rad] that it was begun with, above 0.
        after: (2,) those that hold, above 0.

    Returns:
        (M, 4) means and (M, 10) covariances.
    """
    m = 1.0 / after - 1.0 / before
    ee, eb, bb = cov[:, 7], cov[:, 8], cov[:, 9]
    # (M⁻¹ + S)⁻¹ = M (1 + S M)⁻¹, which M = 0 does not hurt
    a, b, c, d = 1.0 + ee * m[0], eb * m[1], eb * m[0], 1.0 + bb * m[1]
    det = a * d - b * c
    k00, k01, k11 = m[0] * d / det, -m[0] * b / det, m[1] * a / det
    columns = [(cov[:, 3], cov[:, 5]), (cov[:, 4], cov[:, 6]), (ee, eb), (eb, bb)]
    gains = [(x * k00 + y * k01, x * k01 + y * k11) for x, y in columns]
    out_mean = mean - np.stack([gx * mean[:, 2] + gy * mean[:, 3] for gx, gy in gains], axis=1)
    less = [gains[i][0] * columns[j][0] + gains[i][1] * columns[j][1] for i, j in PACKED]
    return out_mean, cov - np.stack(less, axis=1)
