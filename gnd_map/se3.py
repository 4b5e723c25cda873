"""Rotations and rigid motions, vectorised. Poses are (4, 4) matrices T_dst_src: p_dst = T_dst_src @ p_src. Quaternions
are x, y, z, w.

Everything goes through unit quaternions, which stay exact near angles of 0 and π; scipy is the oracle of the tests.
"""

import math

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import F64, I64, check_array
from gnd.gnd_map.errors import MotionError, ShapeError


def R_from_quaternion_xyzw(q: npt.ArrayLike) -> F64:
    """(..., 3, 3) rotations of quaternions (..., 4); they are normalised first.

    Raises:
        ShapeError: a quaternion has no length, or none that is finite.
    """
    quaternion = np.asarray(q, dtype=np.float64)
    if quaternion.shape == (4,):
        x, y, z, w = quaternion.tolist()
        norm = math.sqrt(x * x + y * y + z * z + w * w)
        if 0.0 < norm < math.inf:
            return _R_of_one(x / norm, y / norm, z / norm, w / norm)
    with np.errstate(over="ignore", invalid="ignore"):  # some NaN warn where they are multiplied
        length = np.linalg.norm(quaternion, axis=-1, keepdims=True)
    if quaternion.shape[-1:] != (4,) or not ((length > 0.0) & (length < np.inf)).all():
        raise ShapeError(f"quaternions: expected (..., 4) of finite length > 0, got shape {quaternion.shape}")
    x, y, z, w = np.moveaxis(quaternion / length, -1, 0)
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_xyzw_from_R(R: npt.ArrayLike) -> F64:
    """(..., 4) unit quaternions, w >= 0, of rotations (..., 3, 3): of Shepperd's four forms the best conditioned."""
    m = np.asarray(R, dtype=np.float64)
    if m.shape == (3, 3):
        return _quaternion_of_one(m)
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    x, y, z = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    forms = [
        [1.0 + xx - yy - zz, xy, xz, x],
        [xy, 1.0 - xx + yy - zz, yz, y],
        [xz, yz, 1.0 - xx - yy + zz, z],
        [x, y, z, 1.0 + xx + yy + zz],
    ]
    stacked = np.stack([np.stack(form, axis=-1) for form in forms], axis=-2)
    best = np.argmax(np.stack([xx, yy, zz, xx + yy + zz], axis=-1), axis=-1)
    q = np.take_along_axis(stacked, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.asarray(np.where(q[..., 3:] < 0.0, -q, q))


def _quaternion_of_one(R: F64) -> F64:
    """The same of one rotation, in plain numbers."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R.tolist()
    x, y, z, trace = zy - yz, xz - zx, yx - xy, xx + yy + zz
    forms = (
        (1.0 + xx - yy - zz, xy + yx, xz + zx, x),
        (xy + yx, 1.0 - xx + yy - zz, yz + zy, y),
        (xz + zx, yz + zy, 1.0 - xx - yy + zz, z),
        (x, y, z, 1.0 + trace),
    )
    sizes = (xx, yy, zz, trace)
    q = np.array(forms[sizes.index(max(sizes))])
    return np.asarray(q / math.copysign(math.sqrt(float(q @ q)), -1.0 if q[3] < 0.0 else 1.0))


def exp_so3(rotation_vector: npt.ArrayLike) -> F64:
    """(..., 3, 3) rotations about the vectors (..., 3) by their lengths in radians."""
    v = np.asarray(rotation_vector, dtype=np.float64)
    if v.shape == (3,):
        return _exp_of_one(*v.tolist())
    angle = np.linalg.norm(v, axis=-1, keepdims=True)
    half_sine = 0.5 * np.sinc(angle / (2.0 * np.pi))  # sin(angle/2)/angle
    return R_from_quaternion_xyzw(np.concatenate([half_sine * v, np.cos(0.5 * angle)], axis=-1))


def log_so3(R: npt.ArrayLike) -> F64:
    """(..., 3) rotation vectors, length 0 … π radians, of rotations (..., 3, 3)."""
    m = np.asarray(R, dtype=np.float64)
    if m.shape == (3, 3):
        return _log_of_one(m)
    q = quaternion_xyzw_from_R(m)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., 3:])
    return q[..., :3] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)


def _exp_of_one(x: float, y: float, z: float) -> F64:
    """One rotation in plain numbers: a solver's loop asks for thousands, and numpy takes 0.1 ms for each."""
    angle = math.sqrt(x * x + y * y + z * z)
    half_sine = math.sin(0.5 * angle) / angle if angle > 1e-8 else 0.5
    return _R_of_one(half_sine * x, half_sine * y, half_sine * z, math.cos(0.5 * angle))


def _R_of_one(x: float, y: float, z: float, w: float) -> F64:
    """(3, 3) of one unit quaternion."""
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def _log_of_one(R: F64) -> F64:
    """The vector of one rotation that turns by less than a right angle in plain numbers; others by quaternions."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R.tolist()
    if xx + yy + zz < 1.0:
        q = quaternion_xyzw_from_R(R)
        x, y, z, w = q.tolist()
    else:
        w = 0.5 * math.sqrt(1.0 + xx + yy + zz)
        x, y, z = (zy - yz) / (4.0 * w), (xz - zx) / (4.0 * w), (yx - xy) / (4.0 * w)
    sine = math.sqrt(x * x + y * y + z * z)
    per_sine = 2.0 * math.atan2(sine, w) / sine if sine > 1e-12 else 2.0
    return np.array([per_sine * x, per_sine * y, per_sine * z])


def T_from_R_t(R: npt.ArrayLike, t_m: npt.ArrayLike) -> F64:
    """(..., 4, 4) poses of rotations (..., 3, 3) and translations (..., 3)."""
    rotation, translation = np.asarray(R, dtype=np.float64), np.asarray(t_m, dtype=np.float64)
    T = np.zeros((*rotation.shape[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, translation, 1.0
    return T


def T_inverse(T: npt.ArrayLike) -> F64:
    """(..., 4, 4) inverse poses: T_src_dst of T_dst_src."""
    pose = np.asarray(T, dtype=np.float64)
    if pose.shape == (4, 4):
        inverse = np.eye(4)
        inverse[:3, :3] = pose[:3, :3].T
        inverse[:3, 3] = -(inverse[:3, :3] @ pose[:3, 3])
        return inverse
    R = np.swapaxes(pose[..., :3, :3], -1, -2)
    return T_from_R_t(R, -np.einsum("...ij,...j->...i", R, pose[..., :3, 3]))


def transform(T_dst_src: npt.ArrayLike, points_src_m: npt.ArrayLike) -> F64:
    """(N, 3) points in the frame dst of points (N, 3) in the frame src, for one pose (4, 4)."""
    T = np.asarray(T_dst_src, dtype=np.float64)
    return np.asarray(points_src_m, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]


def interpolate_poses(t_ns: I64, T: F64, query_ns: npt.ArrayLike, *, tolerance_ns: int = 0) -> F64:
    """(M, 4, 4) poses at times (M,): translation linear, rotation along the shortest arc (slerp).

    Args:
        t_ns: (N,) int64, strictly increasing.
        T: (N, 4, 4) poses at these times.
        query_ns: (M,) int64.
        tolerance_ns: how far outside the known times the first or last motion is continued.

    Raises:
        MotionError: a time lies further outside, or there are no poses.
        ShapeError: wrong shapes.
    """
    query = np.asarray(query_ns, dtype=np.int64)
    check_array("t_ns", t_ns, np.int64, (None,))
    check_array("T", T, np.float64, (len(t_ns), 4, 4))
    check_array("query_ns", query, np.int64, (None,))
    _check_covered(t_ns, query, tolerance_ns)
    if len(t_ns) == 1:
        return np.repeat(T, len(query), axis=0)
    k = np.clip(np.searchsorted(t_ns, query, side="right") - 1, 0, len(t_ns) - 2)
    part = (query - t_ns[k]) / (t_ns[k + 1] - t_ns[k])
    turn = log_so3(np.swapaxes(T[:-1, :3, :3], -1, -2) @ T[1:, :3, :3])
    R = T[k, :3, :3] @ exp_so3(part[:, None] * turn[k])
    return T_from_R_t(R, T[k, :3, 3] + part[:, None] * (T[k + 1, :3, 3] - T[k, :3, 3]))


def _check_covered(t_ns: I64, query: I64, tolerance_ns: int) -> None:
    if not len(t_ns):
        raise MotionError("no poses to interpolate")
    if not len(query):
        return
    before, after = int(t_ns[0] - query.min()), int(query.max() - t_ns[-1])
    if max(before, after) > tolerance_ns:
        raise MotionError(
            f"times {query.min()} … {query.max()} ns lie up to {max(before, after) / 1e9:.3f} s outside the poses "
            f"{t_ns[0]} … {t_ns[-1]} ns; {tolerance_ns / 1e9:.3f} s are allowed"
        )
