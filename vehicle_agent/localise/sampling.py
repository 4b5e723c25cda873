"""A few thousand points of a scan, spread evenly in space: all that registration needs."""

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.jit import kernel
from gnd.vehicle_agent.localise.parameters import MIN_RANGE_M, SamplingParameters

TABLE_BITS = 16
CANDIDATES_PER_POINT = 12  # points tried for each one kept
LEAF_M = 0.3


def sample_scan(
    points_m: NDArray[np.floating],
    parameters: SamplingParameters,
    leaf_m: float = LEAF_M,
    min_range_m: float = MIN_RANGE_M,
) -> NDArray[np.int64]:
    """Indices (K,) of about `n_points` points, ascending, at most one in a cube of `leaf_m`.

    Args:
        points_m: (N, 3) in the LiDAR's frame, firing order; points that are not finite are left out.
        parameters: number, and largest range from the LiDAR.
        leaf_m: side of the cube.
        min_range_m: smallest range.
    """
    return _sampled(points_m, stride_of(len(points_m), parameters.n_points), parameters, leaf_m, min_range_m)


def stride_of(n: int, n_points: int) -> int:
    """Of n points in firing order, every so many are candidates for about `n_points` that are chosen.

    It is odd, so that it meets every ring of a sensor with 16, 32, 64 or 128 of them.
    """
    return max(1, n // (CANDIDATES_PER_POINT * n_points)) | 1


def sample_candidates(
    points_m: NDArray[np.floating],
    parameters: SamplingParameters,
    leaf_m: float = LEAF_M,
    min_range_m: float = MIN_RANGE_M,
) -> NDArray[np.int64]:
    """As `sample_scan`, where `points_m` are the candidates alone, every `stride_of`-th point of the scan."""
    return _sampled(points_m, 1, parameters, leaf_m, min_range_m)


def _sampled(
    points_m: NDArray[np.floating], stride: int, parameters: SamplingParameters, leaf_m: float, min_range_m: float
) -> NDArray[np.int64]:
    chosen = np.empty(len(points_m) // stride + 1, np.int64)
    limits = (min_range_m**2, parameters.max_range_m**2)
    kept = _first_in_cubes(np.ascontiguousarray(points_m), stride, 1.0 / leaf_m, *limits, chosen)
    every = max(1.0, kept / parameters.n_points)
    # Counted, not stepped: stepping a float up to `kept` may give one more, at `kept` itself.
    return chosen[(np.arange(min(kept, parameters.n_points)) * every).astype(np.int64)]


@kernel
def _first_in_cubes(
    points: NDArray[np.floating], stride: int, per_m: float, min2: float, max2: float, chosen: NDArray[np.int64]
) -> int:
    """Fill `chosen` with the first point of each cube; a cube may take over the slot of another."""
    table = np.zeros(1 << TABLE_BITS, np.int64)
    kept = 0
    for n in range(0, points.shape[0], stride):
        x, y, z = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        r2 = x * x + y * y + z * z
        if not min2 <= r2 <= max2:  # false for NaN too
            continue
        i, j, k = int(np.floor(x * per_m)), int(np.floor(y * per_m)), int(np.floor(z * per_m))
        key = ((i + (1 << 20)) << 42) | ((j + (1 << 20)) << 21) | (k + (1 << 20))
        slot = (np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(64 - TABLE_BITS)  # Fibonacci hash
        if table[slot] != key:
            table[slot] = key
            chosen[kept] = n
            kept += 1
    return kept
