"""What a scan may hold before it is used: points that are numbers, and near enough to have been measured."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F32
from gnd.schemas.drive import U16, U32, Scan

MAX_RANGE_M: Final = 500.0
"""No LiDAR of a car measures farther; such points are errors of a driver or of a unit."""


@dataclass(frozen=True, slots=True, eq=False)
class RawScan:
    """A sweep as a file holds it, unchecked: drivers write NaN for beams without a return. Fields as in `Scan`."""

    t_ns: int
    points_m: F32
    t_offset_ns: U32
    ring: U16 | None = None

    def __len__(self) -> int:
        return len(self.points_m)


@dataclass(frozen=True, slots=True)
class Cleaned:
    """A scan without the points that cannot be, None where no other is left, and how many those were."""

    scan: Scan | None
    not_finite: int
    far: int


def cleaned(scan: RawScan | Scan) -> Cleaned:
    """Leave out what is no point."""
    finite = np.isfinite(scan.points_m).all(axis=1)
    near = np.zeros(len(scan), np.bool_)
    near[finite] = (scan.points_m[finite].astype(np.float64) ** 2).sum(axis=1) <= MAX_RANGE_M**2
    not_finite, far = int((~finite).sum()), int((finite & ~near).sum())
    if not near.any():
        return Cleaned(None, not_finite, far)
    ring = None if scan.ring is None else scan.ring[near]
    kept = Scan(scan.t_ns, np.ascontiguousarray(scan.points_m[near]), scan.t_offset_ns[near], ring)
    return Cleaned(kept, not_finite, far)
