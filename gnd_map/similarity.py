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

from typing import Literal

import numpy as np
import numpy.typing as npt

from gnd_map.arrays import F64, I64, Array, check_array
from gnd_map.errors import ConfigError
from gnd_map.gaussian import full_matrices
from gnd_map.symmetric3 import add_to_diagonal, determinant, mahalanobis_squared

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
    result: F64 = (exist[0] == exist[1]).astype(np.float64)  # Eq. 14, with both empty = 1
    both = np.flatnonzero(exist[0] & exist[1])
    term = _paper_terms if mode == "paper" else _default_terms
    result[both] = term(mean[1][both] - mean[0][both], cov[0][both], cov[1][both], noise[both])
    return result


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
    values = np.asarray(array).astype(dtype, copy=False)
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
