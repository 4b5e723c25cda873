"""What a scan may hold before it is used: points that are numbers, and near enough to have been measured."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from schemas.drive import Scan

MAX_RANGE_M: Final = 500.0
"""No LiDAR of a car measures farther; such points are errors of a driver or of a unit."""


@dataclass(frozen=True, slots=True)
class Cleaned:
    """A scan without the points that cannot be, None where no other is left, and how many those were."""

    scan: Scan | None
    not_finite: int
    far: int


def cleaned(scan: Scan) -> Cleaned:
    """Leave out what is no point."""
    finite = np.isfinite(scan.points_m).all(axis=1)
    near = np.zeros(len(scan), np.bool_)
    near[finite] = np.linalg.norm(scan.points_m[finite].astype(np.float64), axis=1) <= MAX_RANGE_M
    not_finite, far = int((~finite).sum()), int((finite & ~near).sum())
    if not near.any():
        return Cleaned(None, not_finite, far)
    if near.all():
        return Cleaned(scan, 0, 0)
    ring = None if scan.ring is None else scan.ring[near]
    kept = Scan(scan.t_ns, np.ascontiguousarray(scan.points_m[near]), scan.t_offset_ns[near], ring)
    return Cleaned(kept, not_finite, far)
