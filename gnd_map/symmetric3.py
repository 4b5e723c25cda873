"""Closed forms for many symmetric 3 x 3 matrices at once, as six entries xx, xy, xz, yy, yz, zz in the last axis."""

import numpy as np

from gnd.gnd_map.arrays import F64


def determinant(s: F64) -> F64:
    """(...) determinants of (..., 6)."""
    xx, xy, xz, yy, yz, zz = np.moveaxis(s, -1, 0)
    return np.asarray(xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz))


def adjugate(s: F64) -> F64:
    """(..., 6) adjugates: inverse = adjugate / determinant."""
    xx, xy, xz, yy, yz, zz = np.moveaxis(s, -1, 0)
    return np.stack(
        [
            yy * zz - yz * yz,
            xz * yz - xy * zz,
            xy * yz - xz * yy,
            xx * zz - xz * xz,
            xy * xz - xx * yz,
            xx * yy - xy * xy,
        ],
        axis=-1,
    )


def quadratic_form(s: F64, d: F64) -> F64:
    """(...) dᵀ S d of (..., 6) and (..., 3)."""
    xx, xy, xz, yy, yz, zz = np.moveaxis(s, -1, 0)
    x, y, z = np.moveaxis(d, -1, 0)
    return np.asarray(x * x * xx + y * y * yy + z * z * zz + 2.0 * (x * y * xy + x * z * xz + y * z * yz))


def mahalanobis_squared(s: F64, d: F64) -> F64:
    """(...) dᵀ S⁻¹ d of positive definite (..., 6) and (..., 3); never negative."""
    return np.maximum(quadratic_form(adjugate(s), d) / determinant(s), 0.0)


def add_to_diagonal(s: F64, variance: float | F64) -> F64:
    """(..., 6) S + variance·I, one variance for all or (...) one each."""
    return np.asarray(s + np.asarray(variance)[..., None] * np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0]))
