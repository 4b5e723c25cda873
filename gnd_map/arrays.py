"""Array types and the one check that every value of this package makes of its arrays."""

import math
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.errors import ShapeError

F64: TypeAlias = npt.NDArray[np.float64]
F32: TypeAlias = npt.NDArray[np.float32]
I64: TypeAlias = npt.NDArray[np.int64]
I32: TypeAlias = npt.NDArray[np.int32]
U8: TypeAlias = npt.NDArray[np.uint8]
BOOL: TypeAlias = npt.NDArray[np.bool_]
Array: TypeAlias = npt.NDArray[Any]


def check_array(name: str, array: object, dtype: type[np.generic], shape: tuple[int | None, ...]) -> None:
    """Refuse `array` unless it is a numpy array of `dtype` and `shape` (None = any length) with finite values only.

    Raises:
        ShapeError: names the array and says what was expected and found.
    """
    if not isinstance(array, np.ndarray):
        raise ShapeError(f"{name}: expected a numpy array, got {type(array).__name__}")
    if array.dtype != dtype:
        raise ShapeError(f"{name}: expected dtype {np.dtype(dtype)}, got {array.dtype}")
    if array.shape != shape and not _fits(array.shape, shape):
        raise ShapeError(f"{name}: expected shape {shown_shape(shape)}, got {array.shape}")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ShapeError(f"{name}: {int((~np.isfinite(array)).sum())} of {array.size} values are not finite")


def _fits(found: tuple[int, ...], shape: tuple[int | None, ...]) -> bool:
    return len(found) == len(shape) and all(want is None or want == n for want, n in zip(shape, found, strict=True))


def unique(ids: Array) -> Array:
    """The values of (N,) ids, ascending, each once. As `np.unique`, which takes longer on a few thousand."""
    ordered = np.sort(ids)
    return np.asarray(ordered[np.append(True, ordered[1:] != ordered[:-1])[: len(ordered)]])


def are_in(sorted_values: Array, among: Array) -> npt.NDArray[np.bool_]:
    """(N,) which of some values are among others (M,); both ascending. As `np.isin`, which sorts them first."""
    if len(among) == 0:
        return np.zeros(len(sorted_values), np.bool_)
    at = np.minimum(np.searchsorted(among, sorted_values), len(among) - 1)
    return np.asarray(among[at] == sorted_values)


def shown_shape(shape: tuple[int | None, ...]) -> str:
    """`shape` with N for "any length": "(N, 3)"."""
    return "(" + ", ".join("N" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"


def points_3d(name: str, points: object) -> F64:
    """`points` as a C-contiguous float64 array of shape (N, 3) with finite values.

    Raises:
        ShapeError: it is none.
    """
    array = np.ascontiguousarray(points, dtype=np.float64)
    check_array(name, array, np.float64, (None, 3))
    return array


def numbered_rows(rows: I64) -> I64:
    """(N,) which of the different rows of `rows` (N, K) int64 each one is, in their order; `numpy.unique` along an axis
    is far slower, and asked only where the ranges are so large that a row is no single number.
    """
    if not len(rows):
        return np.empty(0, np.int64)
    low = rows.min(axis=0)
    spans = (rows.max(axis=0) - low + 1).tolist()
    if math.prod(spans) >= 1 << 62:
        return np.unique(rows, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)
    key = np.zeros(len(rows), np.int64)
    for column, span in enumerate(spans):
        key = key * span + (rows[:, column] - low[column])
    return np.unique(key, return_inverse=True)[1].astype(np.int64)
