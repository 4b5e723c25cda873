"""How alike two states of one voxel are, 0 … 1 (GND, 5.1, Eq. 13-17).

Similarity = existence x L2 x geometric (Eq. 13). Two readings of it:

- "paper": Eq. 14-17 with the gaps closed: both empty is 1 (Eq. 14 prints 0, the text says 1), two spheres are alike in
shape (1), the dot
  products of Eq. 17 are taken without sign, λ3 ≫ λ2 ≫ λ1 counts as a line. The hard types flip on unchanged voxels now
  and then.
- "default": the L2 term with a noise variance added to Σi + Σj, so that a thin wall seen with a few centimetres of pose
error stays the
  same wall, and in place of the types Bhattacharyya's coefficient of the two covariances, each with that variance
  added.
"""

import math
from typing import Literal

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import F64, I64, Array, check_array
from gnd.gnd_map.errors import ConfigError
from gnd.gnd_map.gaussian import full_matrices
from gnd.gnd_map.jit import bare, bare_inlined
from gnd.gnd_map.symmetric3 import add_to_diagonal, determinant, mahalanobis_squared

SimilarityMode = Literal["paper", "default"]

MUCH_LARGER = 10.0  # the ratio of eigenvalues that is ≫ (text below Eq. 16)
_LEAST_VARIANCE_M2 = 1e-6  # (1 mm)²: a perfect plane has no inverse
_SPHERE, _PLANE, _LINE = 0, 1, 2


def similarity(
    exists_a: Array,
    mean_a: Array,
    cov_a: Array,
    exists_b: Array,
    mean_b: Array,
    cov_b: Array,
    mode: SimilarityMode = "default",
    noise_m: float | F64 = 0.05,
) -> F64:
    """(N,) similarity in [0, 1] of N pairs of voxel states; symmetric in a and b.

    Args:
        exists_a: (N,) bool, whether there is a Gaussian.
        mean_a: (N, 3) metres, any common origin of the pair; not read where nothing exists.
        cov_a: (N, 6) m², xx, xy, xz, yy, yz, zz.
        exists_b: as a.
        mean_b: as a.
        cov_b: as a.
        mode: "paper" or "default", see the module's head.
        noise_m: standard deviation added in "default" mode, one for all or (N,): where the poses of a pair's
            observers are known poorly, it is larger.

    Raises:
        ShapeError: shapes differ or values are not finite.
        ConfigError: an unknown mode or a negative noise.
    """
    n = len(exists_a)
    noise = _checked("noise_m", np.full(n, noise_m) if np.ndim(noise_m) == 0 else np.asarray(noise_m), (n,), np.float64)
    _check_mode(mode, noise)
    exist = [_checked(name, x, (n,), np.bool_) for name, x in (("exists_a", exists_a), ("exists_b", exists_b))]
    mean = [_checked(name, x, (n, 3), np.float64) for name, x in (("mean_a", mean_a), ("mean_b", mean_b))]
    cov = [_checked(name, x, (n, 6), np.float64) for name, x in (("cov_a", cov_a), ("cov_b", cov_b))]
    if mode == "paper":
        return similarity_plain(exist[0], mean[0], cov[0], exist[1], mean[1], cov[1], mode, noise)
    result = np.empty(n)
    _default_kernel(exist[0], mean[0], cov[0], exist[1], mean[1], cov[1], noise**2, result)
    return result


def similarity_plain(
    exists_a: Array, mean_a: F64, cov_a: F64, exists_b: Array, mean_b: F64, cov_b: F64, mode: SimilarityMode,
    noise_m: F64,
) -> F64:  # fmt: skip
    """`similarity` in plain numpy, unchecked: the twin of the kernel, and all there is of the paper's mode."""
    result: F64 = (exists_a == exists_b).astype(np.float64)  # Eq. 14, with both empty = 1
    both = np.flatnonzero(exists_a & exists_b)
    term = _paper_terms if mode == "paper" else _default_terms
    result[both] = term(mean_b[both] - mean_a[both], cov_a[both], cov_b[both], noise_m[both])
    return result


@bare
def far_at(least: float) -> float:
    """The squared Mahalanobis distance of means beyond which similarity is certainly below `least`."""
    return 1e-9 - 2.0 * math.log(max(least, 1e-300))


@bare_inlined
def alike(mean_a: Array, cov_a: Array, mean_b: Array, cov_b: Array, noise_m2: float, far: float) -> float:
    """Similarity in "default" mode of two Gaussians that exist, for kernels.

    Args:
        mean_a: (3,) metres, any common origin.
        cov_a: (6,) m².
        mean_b: as a.
        cov_b: as a.
        noise_m2: the variance that is added on each axis, m².
        far: squared Mahalanobis distance of the means beyond which the answer is 0; see `far_at`.
    """
    v = max(noise_m2, _LEAST_VARIANCE_M2)
    a, b = _raised(cov_a, v), _raised(cov_b, v)
    xy, xz, yz = a[1] + b[1], a[2] + b[2], a[4] + b[4]
    xx = np.float64(cov_a[0]) + np.float64(cov_b[0]) + v
    yy = np.float64(cov_a[3]) + np.float64(cov_b[3]) + v
    zz = np.float64(cov_a[5]) + np.float64(cov_b[5]) + v
    x = np.float64(mean_b[0]) - np.float64(mean_a[0])
    y = np.float64(mean_b[1]) - np.float64(mean_a[1])
    z = np.float64(mean_b[2]) - np.float64(mean_a[2])
    square: float = x * x * (yy * zz - yz * yz) + y * y * (xx * zz - xz * xz) + z * z * (xx * yy - xy * xy)
    square += 2.0 * (x * y * (xz * yz - xy * zz) + x * z * (xy * yz - xz * yy) + y * z * (xy * xz - xx * yz))
    squared = max(square / _determinant(xx, xy, xz, yy, yz, zz), 0.0)
    if squared > far:
        return 0.0
    middle = _determinant(a[0] + b[0], xy, xz, a[3] + b[3], yz, a[5] + b[5]) / 8.0  # of half the sum
    shape = math.sqrt(math.sqrt(_determinant(*a) * _determinant(*b))) / math.sqrt(middle)
    return math.exp(-0.5 * squared) * min(shape, 1.0)  # Eq. 15, and Bhattacharyya's coefficient


@bare_inlined
def _raised(cov: Array, variance: float) -> tuple[float, float, float, float, float, float]:
    """A covariance with the variance added on each axis."""
    return (
        np.float64(cov[0]) + variance,
        np.float64(cov[1]),
        np.float64(cov[2]),
        np.float64(cov[3]) + variance,
        np.float64(cov[4]),
        np.float64(cov[5]) + variance,
    )


@bare_inlined
def _determinant(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float) -> float:
    return xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)


@bare
def _default_kernel(
    exists_a: Array, mean_a: F64, cov_a: F64, exists_b: Array, mean_b: F64, cov_b: F64, noise_m2: F64, result: F64
) -> None:
    """(N,) `_default_terms` of N pairs, with Eq. 14."""
    for k in range(len(result)):
        if exists_a[k] and exists_b[k]:
            result[k] = alike(mean_a[k], cov_a[k], mean_b[k], cov_b[k], noise_m2[k], np.inf)
        else:
            result[k] = 1.0 if exists_a[k] == exists_b[k] else 0.0


def pairwise(
    group: npt.ArrayLike,
    exists: Array,
    mean: Array,
    cov: Array,
    mode: SimilarityMode = "default",
    noise_m: float = 0.05,
) -> tuple[I64, I64, F64]:
    """All pairs of rows within each group: (i (K,), j (K,), similarity (K,)) with i < j.

    Args:
        group: (N,) group numbers, equal ones next to each other (one group = the statements about one voxel).
        exists: (N,) as in `similarity`.
        mean: (N, 3).
        cov: (N, 6).
        mode: "paper" or "default".
        noise_m: as in `similarity`.

    Raises:
        ShapeError: as `similarity`.
    """
    i, j = pairs_within(group)
    return i, j, similarity(exists[i], mean[i], cov[i], exists[j], mean[j], cov[j], mode, noise_m)


def pairs_within(group: npt.ArrayLike) -> tuple[I64, I64]:
    """Row numbers i < j of all pairs with the same group number; equal numbers must stand together."""
    numbers = np.asarray(group)
    n = len(numbers)
    begins = np.append(True, numbers[1:] != numbers[:-1])[:n]
    first = np.flatnonzero(begins)
    size = np.diff(np.append(first, n))
    after = np.repeat(first + size, size) - np.arange(n) - 1  # rows of the same group behind each row
    i = np.repeat(np.arange(n), after)
    j = i + 1 + np.arange(len(i)) - np.repeat(np.cumsum(after) - after, after)
    return i.astype(np.int64), j.astype(np.int64)


def _check_mode(mode: str, noise_m: F64) -> None:
    if mode not in ("paper", "default"):
        raise ConfigError(f"similarity mode {mode!r}: expected 'paper' or 'default'")
    if (noise_m < 0.0).any():
        raise ConfigError(f"noise_m = {noise_m.min()} is negative")


def _checked(name: str, array: Array, shape: tuple[int, ...], dtype: type[np.generic]) -> Array:
    values = np.require(array, dtype, ("C", "W"))  # of one kind, so that one kernel does for all
    check_array(name, values, dtype, shape)
    return values


def _paper_terms(d: F64, cov_a: F64, cov_b: F64, _noise_m: F64) -> F64:
    l2 = np.exp(-0.5 * mahalanobis_squared(add_to_diagonal(cov_a + cov_b, _LEAST_VARIANCE_M2), d))  # Eq. 15
    return l2 * _geometric(cov_a, cov_b)  # Eq. 13


def _default_terms(d: F64, cov_a: F64, cov_b: F64, noise_m: F64) -> F64:
    variance = np.maximum(noise_m**2, _LEAST_VARIANCE_M2)
    l2 = np.exp(-0.5 * mahalanobis_squared(add_to_diagonal(cov_a + cov_b, variance), d))  # Eq. 15
    a, b = add_to_diagonal(cov_a, variance), add_to_diagonal(cov_b, variance)
    shape = (determinant(a) * determinant(b)) ** 0.25 / np.sqrt(
        determinant(0.5 * (a + b))
    )  # Bhattacharyya, equal means
    return l2 * np.minimum(shape, 1.0)


def _geometric(cov_a: F64, cov_b: F64) -> F64:
    """(N,) geometric similarity, Eq. 17."""
    type_a, feature_a = shape_types(cov_a)
    type_b, feature_b = shape_types(cov_b)
    along = np.minimum(np.abs(np.einsum("ni,ni->n", feature_a, feature_b)), 1.0)
    return np.where(type_a != type_b, 0.0, np.where(type_a == _SPHERE, 1.0, along))


def shape_types(cov: F64) -> tuple[npt.NDArray[np.uint8], F64]:
    """Types (N,) 0 sphere, 1 plane, 2 line (Eq. 16), and features (N, 3): a plane's normal, a line's direction."""
    value, vector = np.linalg.eigh(full_matrices(cov))
    line = value[:, 2] > MUCH_LARGER * value[:, 1]
    plane = ~line & (value[:, 1] > MUCH_LARGER * value[:, 0])
    kind = np.where(line, _LINE, np.where(plane, _PLANE, _SPHERE)).astype(np.uint8)
    return kind, np.where(line[:, None], vector[:, :, 2], vector[:, :, 0])
