"""The ray kernel: every ray of a scan walks the dense window and counts the six cases of GND section 4.2.

Grid coordinates make every voxel a unit cube, whatever its metric size ("modified ray casting", GND 4.3.3): the affine
of the grid at the sensor turns metres into grid coordinates, and the walk crosses exactly |Δi| + |Δj| + |Δk| faces.
Whatever is measured in metres (distances to a Gaussian, to a plane, to the hit) stays in metres.
"""

import math
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F32, F64, I32
from gnd.gnd_map.jit import bare, pasted
from gnd.vehicle_agent.detect.parameters import INCLUDED_M, DetectParameters
from gnd.vehicle_agent.detect.records import N_BI, N_BO, N_PI, N_PO
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty

ETA_BLOCK: Final = 0.95
"""η_bound of Eq. (1) for points that end in a voxel."""
_ETA_PLANE: Final = 0.97
"""The same for the point where a ray crosses the plane of a planar Gaussian."""
_AHEAD_M: Final = 1.0
"""Of the rule `ahead`: how far before the hit the crossing must lie."""
_BEYOND_M: Final = 0.15
"""Of the rule `plane`: how far behind the plane a ray must end."""
_BEYOND_SIGMAS: Final = 2.0
"""A ray must end farther behind the plane by this many sigmas of the pose (root of the sum of squares with
`_BEYOND_M`)."""
_FACE_SIGMA: Final = 3.0

CERTAIN = PoseUncertainty()
RULES = {"ml": 0, "ahead": 1, "plane": 2}
UNKNOWN = -(2**31)


class KernelParameters(NamedTuple):
    """`DetectParameters` as the kernel reads them: thresholds on r² in place of confidences."""

    rule: int
    r2_block: float
    r2_pass: float
    r2_plane: float
    r2_face: float
    ahead_m: float
    beyond_m: float
    face_m: float
    range_min_m: float
    range_max_m: float
    pose_m2: float
    pose_rad2: float
    included_m2: float
    block_gain: float
    beyond_gain: float


def confidence(r2: float) -> float:
    """Probability mass inside the ellipsoid of squared Mahalanobis distance `r2`, GND Eq. (3) with k = 3: chi-square in
    closed form (scipy.stats would cost a second at every start).
    """
    return math.erf(math.sqrt(r2 / 2)) - math.sqrt(2 * r2 / math.pi) * math.exp(-r2 / 2)  # Eq. (3)


@lru_cache(maxsize=64)
def quantile(eta: float) -> float:
    """The r² whose `confidence` is `eta` (0 < eta < 1): "inside" becomes one comparison, computed once."""
    low, high = 0.0, 60.0
    while high - low > 1e-12:
        middle = (low + high) / 2
        low, high = (middle, high) if confidence(middle) < eta else (low, middle)
    return (low + high) / 2


def kernel_parameters(p: DetectParameters, pose: PoseUncertainty = CERTAIN) -> KernelParameters:
    """Eq. (1) and (4) compare confidences; r² against their quantiles is the same test.

    Args:
        p: the parameters.
        pose: of the scan whose rays are cast.
    """
    return KernelParameters(
        rule=RULES[p.rules.passing_rule],
        r2_block=quantile(ETA_BLOCK),
        r2_pass=quantile(p.rules.eta_pass),
        r2_plane=quantile(_ETA_PLANE),
        r2_face=_FACE_SIGMA**2,
        ahead_m=_AHEAD_M,
        beyond_m=_BEYOND_M,
        face_m=p.rules.face_m,
        range_min_m=p.range_min_m,
        range_max_m=p.range_max_m,
        pose_m2=float(pose.sigma_m**2),
        pose_rad2=float(pose.sigma_rad**2),
        included_m2=INCLUDED_M**2,
        block_gain=1.0 / p.rules.block_noise_m**2 if p.rules.soft else 0.0,
        beyond_gain=_BEYOND_SIGMAS**2 if p.rules.soft else 0.0,
    )


@pasted
def _whitened(W: F32, row: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """W d for the lower triangle in `W[row, :6]`."""
    return (
        W[row, 0] * x,
        W[row, 1] * x + W[row, 2] * y,
        W[row, 3] * x + W[row, 4] * y + W[row, 5] * z,
    )


@pasted
def _r2_on_ray(
    records: F32, row: int, dx: float, dy: float, dz: float, vx: float, vy: float, vz: float, t: float
) -> float:
    """Squared Mahalanobis distance (Eq. 2) of the ray's point at `t`; d = mean - origin."""
    x, y, z = _whitened(records, row, t * vx - dx, t * vy - dy, t * vz - dz)
    return x * x + y * y + z * z


@pasted
def _ml_parameter(
    records: F32,
    row: int,
    dx: float,
    dy: float,
    dz: float,
    vx: float,
    vy: float,
    vz: float,
    t_in: float,
    t_out: float,
) -> float:
    """Where the ray's likelihood is greatest, clamped to its segment inside the voxel (Eq. 4, [41])."""
    yx, yy, yz = _whitened(records, row, vx, vy, vz)
    zx, zy, zz = _whitened(records, row, dx, dy, dz)
    t = (yx * zx + yy * zy + yz * zz) / (yx * yx + yy * yy + yz * yz)
    return min(max(t, t_in), t_out)


@pasted
def _passes(
    records: F32,
    row: int,
    ox: float,
    oy: float,
    oz: float,
    vx: float,
    vy: float,
    vz: float,
    t_in: float,
    t_out: float,
    length: float,
    beyond_m: float,
    p: "KernelParameters",
) -> bool:
    """Whether the ray passes inside the Gaussian (PI) rather than outside (PO), by the rule of `p`."""
    dx, dy, dz = records[row, 6] - ox, records[row, 7] - oy, records[row, 8] - oz
    nx, ny, nz = records[row, 9], records[row, 10], records[row, 11]
    if p.rule == 2 and nx * nx + ny * ny + nz * nz > 0.5:
        along = nx * vx + ny * vy + nz * vz
        t = (nx * dx + ny * dy + nz * dz) / along
        if not (t_in <= t <= t_out) or (1.0 - t) * abs(along) <= beyond_m:
            return False
        return _r2_on_ray(records, row, dx, dy, dz, vx, vy, vz, t) <= p.r2_plane
    t = _ml_parameter(records, row, dx, dy, dz, vx, vy, vz, t_in, t_out)
    if p.rule != 0 and (1.0 - t) * length < p.ahead_m:
        return False
    return _r2_on_ray(records, row, dx, dy, dz, vx, vy, vz, t) <= p.r2_pass  # Eq. (4)


@pasted
def _r2_block(block: F32, records: F32, row: int, px: float, py: float, pz: float) -> float:
    """Eq. (2) for a point, with the measurement noise added to Σ."""
    x, y, z = _whitened(block, row, px - records[row, 6], py - records[row, 7], pz - records[row, 8])
    return x * x + y * y + z * z


@pasted
def _neighbour_explains(
    state: I32,
    at: int,
    f: float,
    i: int,
    n: int,
    stride: int,
    face: float,
    block: F32,
    records: F32,
    px: float,
    py: float,
    pz: float,
    p: "KernelParameters",
) -> bool:
    """True when the point lies within `face` of a face and the Gaussian behind that face contains it."""
    row = -1
    if f < face and i > 0:
        row = int(state[np.uint64(at - stride)])
    elif f > 1.0 - face and i < n - 1:
        row = int(state[np.uint64(at + stride)])
    if row < 0:
        return False
    return _r2_block(block, records, row, px, py, pz) <= p.r2_face


@pasted
def _first_face(g: float, d: float, i: int, n: int) -> tuple[float, float]:
    """Ray parameter of the first face along one axis and the step between faces; infinite when none is crossed."""
    if n == 0:
        return np.inf, np.inf
    face = i + 1.0 if d > 0.0 else float(i)
    return (face - g) / d, 1.0 / abs(d)


@pasted
def _clip(g: float, d: float, n: int, t0: float, t1: float) -> tuple[float, float]:
    """The part of [t0, t1] where g + t d lies inside [0, n]; empty when t0 > t1."""
    if d == 0.0:
        return (t0, t1) if 0.0 <= g < n else (np.inf, -np.inf)
    a, b = -g / d, (n - g) / d
    return max(t0, min(a, b)), min(t1, max(a, b))


@pasted
def _index(g: float, n: int) -> int:
    """floor(g), kept inside the window against rounding at its faces."""
    return min(max(math.floor(g), 0), n - 1)


@bare
def cast_rays(  # noqa: C901  (one loop: a call a voxel would cost more than the voxel)
    points: F64,
    origins: F64,
    anchor_m: F64,
    A: F64,
    b: F64,
    state: I32,
    shape: tuple[int, int, int],
    words: I32,
    records: F32,
    block: F32,
    p: KernelParameters,
    moving: NDArray[np.bool_],
    kept: NDArray[np.uint8],
) -> int:
    """Cast the rays of one scan: counts into `state` and `words`, marks the points that new Gaussians are made of.

    Args:
        points: (N, 3) float64 hits in metres, map frame.
        origins: (N, 3) or (1, 3) float64 the sensor at each hit, the same frame.
        anchor_m: (3,) float64 the window's anchor, from which the records' means are counted; so are p of A and b.
        A: (3, 3) float64; window coordinates are A @ p + b.
        b: (3,) float64.
        state: (nx * ny * nz,) int32, changed: row of a Gaussian >= 0, -1 - (passes) where empty, `UNKNOWN`.
        shape: (nx, ny, nz) ints.
        words: (M, 16) int32 records, counters changed.
        records: the same memory as float32.
        block: (M, 6) float32 whitening for blocked points.
        p: KernelParameters.
        moving: (N,) bool, points of moving objects: the ray passes what lies before, its end is no evidence.
        kept: (N,) uint8, set to 1 for the points that count (BI, BO, BE), 0 for the others.

    Returns:
        The number of rays that were cast.
    """
    nx, ny, nz = shape
    stride_x, stride_y = ny * nz, nz
    face_x = p.face_m * math.sqrt(A[0, 0] ** 2 + A[0, 1] ** 2 + A[0, 2] ** 2)
    face_y = p.face_m * math.sqrt(A[1, 0] ** 2 + A[1, 1] ** 2 + A[1, 2] ** 2)
    face_z = p.face_m * math.sqrt(A[2, 0] ** 2 + A[2, 1] ** 2 + A[2, 2] ** 2)
    one_origin = len(origins) == 1
    cast = 0
    for r in range(len(points)):
        kept[r] = 0
        o = 0 if one_origin else r
        ox, oy, oz = origins[o, 0] - anchor_m[0], origins[o, 1] - anchor_m[1], origins[o, 2] - anchor_m[2]
        px, py, pz = points[r, 0] - anchor_m[0], points[r, 1] - anchor_m[1], points[r, 2] - anchor_m[2]
        vx, vy, vz = px - ox, py - oy, pz - oz
        length = math.sqrt(vx * vx + vy * vy + vz * vz)
        if not (length > p.range_min_m):
            continue
        s2 = max(p.pose_m2 + p.pose_rad2 * length * length - p.included_m2, 0.0)  # variance of the ray's end
        beyond_m = math.sqrt(p.beyond_m * p.beyond_m + p.beyond_gain * s2)
        # The ray in window coordinates, cut at the range and at the window.
        gx = A[0, 0] * ox + A[0, 1] * oy + A[0, 2] * oz + b[0]
        gy = A[1, 0] * ox + A[1, 1] * oy + A[1, 2] * oz + b[1]
        gz = A[2, 0] * ox + A[2, 1] * oy + A[2, 2] * oz + b[2]
        dx = A[0, 0] * vx + A[0, 1] * vy + A[0, 2] * vz
        dy = A[1, 0] * vx + A[1, 1] * vy + A[1, 2] * vz
        dz = A[2, 0] * vx + A[2, 1] * vy + A[2, 2] * vz
        reach = min(1.0, p.range_max_m / length)
        t_in, t_end = _clip(gx, dx, nx, 0.0, reach)
        t_in, t_end = _clip(gy, dy, ny, t_in, t_end)
        t_in, t_end = _clip(gz, dz, nz, t_in, t_end)
        if t_in >= t_end:
            continue
        cast += 1
        i, j, k = _index(gx + t_in * dx, nx), _index(gy + t_in * dy, ny), _index(gz + t_in * dz, nz)
        i1, j1, k1 = _index(gx + t_end * dx, nx), _index(gy + t_end * dy, ny), _index(gz + t_end * dz, nz)
        n_x, n_y, n_z = abs(i1 - i), abs(j1 - j), abs(k1 - k)
        t_x, dt_x = _first_face(gx, dx, i, n_x)
        t_y, dt_y = _first_face(gy, dy, j, n_y)
        t_z, dt_z = _first_face(gz, dz, k, n_z)
        step_x = stride_x if i1 > i else -stride_x
        step_y = stride_y if j1 > j else -stride_y
        step_z = 1 if k1 > k else -1
        at = i * stride_x + j * stride_y + k
        # An axis that has made all its steps never wins again, so rounding cannot lead the walk astray.
        for _ in range(n_x + n_y + n_z):
            row = state[np.uint64(at)]
            t_out = min(t_x, t_y, t_z)
            if row >= 0:
                inside = _passes(records, row, ox, oy, oz, vx, vy, vz, t_in, t_out, length, beyond_m, p)
                words[np.uint64(row), N_PI if inside else N_PO] += 1
            elif row != UNKNOWN:
                state[np.uint64(at)] = row - 1
            t_in = t_out
            if t_x <= t_y and t_x <= t_z:
                at += step_x
                n_x -= 1
                t_x = t_x + dt_x if n_x > 0 else np.inf
            elif t_y <= t_z:
                at += step_y
                n_y -= 1
                t_y = t_y + dt_y if n_y > 0 else np.inf
            else:
                at += step_z
                n_z -= 1
                t_z = t_z + dt_z if n_z > 0 else np.inf
        row = state[np.uint64(at)]
        if t_end < 1.0 or row == UNKNOWN or moving[r]:
            continue
        # A Gaussian that is thin beside the noise: its variance, and so the limit of r², grows by this factor.
        wider = 1.0 + p.block_gain * s2
        if row >= 0 and _r2_block(block, records, row, px, py, pz) <= p.r2_block * wider:  # Eq. (1)
            words[np.uint64(row), N_BI] += 1
            kept[r] = 1
            continue
        fx, fy, fz = gx + dx - i1, gy + dy - j1, gz + dz - k1
        if (
            _neighbour_explains(state, at, fx, i1, nx, stride_x, face_x, block, records, px, py, pz, p)
            or _neighbour_explains(state, at, fy, j1, ny, stride_y, face_y, block, records, px, py, pz, p)
            or _neighbour_explains(state, at, fz, k1, nz, 1, face_z, block, records, px, py, pz, p)
        ):
            continue
        kept[r] = 1
        if row >= 0:
            words[np.uint64(row), N_BO] += 1
    return cast


def window_affine(
    A: NDArray[np.float64], b: NDArray[np.float64], anchor_m: NDArray[np.float64], origin_g: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The grid's affine g = A p + b rewritten for points relative to `anchor_m` and voxels relative to `origin_g`."""
    return np.ascontiguousarray(A), A @ anchor_m + (b - origin_g)
