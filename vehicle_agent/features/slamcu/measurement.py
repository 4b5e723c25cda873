"""Range and bearing of point features, for many particles at once (SLAMCU, section 5.2).

A pose is (x, y, heading) of the vehicle in the map frame; particles lie along the last axis of poses, (3, M), and along
the first of features, (M, 2). Covariances of features are kept as xx, xy, yy.
"""

from typing import NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.view import wrapped


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


def inverse(pose: F64, z: F64, variance: F64) -> tuple[F64, F64]:
    """The feature that each particle measures, were it the first time.

    Args:
        pose: (3, M).
        z: (2,) range [m] and bearing [rad].
        variance: (2,) of z.

    Returns:
        (M, 2) positions and (M, 3) covariances xx, xy, yy.
    """
    direction = pose[2] + z[1]
    cos, sin = np.cos(direction), np.sin(direction)
    along, across = variance[0], variance[1] * z[0] ** 2
    mu = np.stack([pose[0] + z[0] * cos, pose[1] + z[0] * sin], axis=1)
    xx, xy, yy = cos**2 * along + sin**2 * across, cos * sin * (along - across), sin**2 * along + cos**2 * across
    return mu, np.stack([xx, xy, yy], axis=1)


def innovation_cov(at: Predicted, sigma: F64, variance: F64) -> tuple[F64, F64, F64]:
    """Q = H Σ Hᵀ + R of Eq. (18), as rr, rb, bb; (M,) each."""
    xx, xy, yy = sigma[..., 0], sigma[..., 1], sigma[..., 2]
    rr = at.cos**2 * xx + 2.0 * at.cos * at.sin * xy + at.sin**2 * yy
    rb = (at.cos * at.sin * (yy - xx) + (at.cos**2 - at.sin**2) * xy) / at.range_m
    bb = (at.sin**2 * xx - 2.0 * at.cos * at.sin * xy + at.cos**2 * yy) / at.range_m**2
    return rr + variance[0], rb, bb + variance[1]


def update(pose: F64, mu: F64, sigma: F64, z: F64, variance: F64) -> tuple[F64, F64, F64]:
    """EKF update of one feature in every particle, and how likely the measurement was.

    Eq. (16) without the stray inverse at the innovation and with H taken with respect to the feature; Eq. (18) with the
    factor -1/2 that its exponent lacks. With Σ = 0 the likelihood is Eq. (17).

    Args:
        pose: (3, M).
        mu: (M, 2).
        sigma: (M, 3) xx, xy, yy.
        z: (2,) range [m] and bearing [rad].
        variance: (2,) of z, the diagonal of R.

    Returns:
        (M, 2) positions, (M, 3) covariances, (M,) log likelihoods.
    """
    at = predicted(pose, mu)
    rr, rb, bb = innovation_cov(at, sigma, variance)
    det = rr * bb - rb * rb
    nu_r, nu_b = z[0] - at.range_m, wrapped(z[1] - at.bearing_rad)
    xx, xy, yy = sigma[:, 0], sigma[:, 1], sigma[:, 2]
    # Σ Hᵀ, its two columns
    xr, yr = xx * at.cos + xy * at.sin, xy * at.cos + yy * at.sin
    xb, yb = (xy * at.cos - xx * at.sin) / at.range_m, (yy * at.cos - xy * at.sin) / at.range_m
    # K = Σ Hᵀ Q⁻¹, Eq. (16)
    k_xr, k_xb = (xr * bb - xb * rb) / det, (xb * rr - xr * rb) / det
    k_yr, k_yb = (yr * bb - yb * rb) / det, (yb * rr - yr * rb) / det
    out_mu = np.stack([mu[:, 0] + k_xr * nu_r + k_xb * nu_b, mu[:, 1] + k_yr * nu_r + k_yb * nu_b], axis=1)
    out_sigma = np.stack([xx - k_xr * xr - k_xb * xb, xy - k_xr * yr - k_xb * yb, yy - k_yr * yr - k_yb * yb], axis=1)
    squared = (bb * nu_r**2 - 2.0 * rb * nu_r * nu_b + rr * nu_b**2) / det
    return out_mu, out_sigma, -0.5 * squared - 0.5 * np.log((2.0 * np.pi) ** 2 * det)  # Eq. (18)


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


def fused(mu: F64, sigma: F64, xy_m: F64, cov: F64) -> tuple[F64, F64]:
    """Two estimates of one feature made one, in every particle; arguments as of `agreement`."""
    s = sigma + cov
    det = s[..., 0] * s[..., 2] - s[..., 1] ** 2
    a, b, c = s[..., 2] / det, -s[..., 1] / det, s[..., 0] / det  # (Σ + C)⁻¹
    xx, xy, yy = sigma[:, 0], sigma[:, 1], sigma[:, 2]
    k = (xx * a + xy * b, xx * b + xy * c, xy * a + yy * b, xy * b + yy * c)
    d = xy_m - mu
    out_mu = np.stack([mu[:, 0] + k[0] * d[:, 0] + k[1] * d[:, 1], mu[:, 1] + k[2] * d[:, 0] + k[3] * d[:, 1]], axis=1)
    out = np.stack([xx - k[0] * xx - k[1] * xy, xy - k[0] * xy - k[1] * yy, yy - k[2] * xy - k[3] * yy], axis=1)
    return out_mu, out
