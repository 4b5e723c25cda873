"""Pose matrices as files hold them, made rigid."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.se3 import T_from_R_t
from gnd.vehicle_agent.errors import ImportDriveError

F64 = NDArray[np.float64]

TOLERANCE: Final = 1e-2
"""Matrices of three decimals are off by 1e-3; a camera's projection or a scaled axis by much more."""


def orthonormal(rows: F64, where: str) -> tuple[F64, float]:
    """(N, 4, 4) of matrices (N, 3, 4) whose rotations become the nearest orthonormal ones, and the most they were off.

    Raises:
        ImportDriveError: a rotation that is off by more than `TOLERANCE`, or mirrors.
    """
    R, t = rows[:, :, :3], rows[:, :, 3]
    if not np.isfinite(rows).all():
        bad = int(np.flatnonzero(~np.isfinite(rows).all(axis=(1, 2)))[0])
        raise ImportDriveError(f"{where}: pose {bad + 1} holds a number that is not finite")
    off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2))
    if (off > TOLERANCE).any():
        bad = int(np.argmax(off > TOLERANCE))
        raise ImportDriveError(
            f"{where}: rotation of pose {bad + 1} is off by {off[bad]:.3g} from orthonormal, {TOLERANCE} is allowed"
        )
    if (np.linalg.det(R) < 0).any():
        bad = int(np.argmax(np.linalg.det(R) < 0))
        raise ImportDriveError(f"{where}: pose {bad + 1} mirrors (determinant -1): an axis has the wrong sign")
    u, _, vt = np.linalg.svd(R)
    return T_from_R_t(u @ vt, t), float(off.max(initial=0.0))
