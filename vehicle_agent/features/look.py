"""What SLAMCU is given: features of the map, and looks of a detector."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.vehicle_agent.features.errors import BadLook, BadMapFeatures

MAX_RANGE_M: Final = 1000.0
MAX_DETECTIONS: Final = 1024
"""More in one look is no detector's work (the same limit as on the wire)."""
SMALLEST_SIGMA: Final = 1e-4
"""m or rad; a smaller one is taken as this."""


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """What a detector found in one look; none found is a look too.

    Attributes:
        t_ns: UTC.
        range_m: float64 (N,), horizontal distance from the vehicle's origin.
        bearing_rad: float64 (N,), counter-clockwise from the vehicle's x axis.
        sigma_range_m: float64 (N,).
        sigma_bearing_rad: float64 (N,).
        kinds: N words; only equal kinds are associated.
        height_m: float64 (N,) over the vehicle's origin, nan = unknown; None = the detector measures none.
    """

    t_ns: int
    range_m: F64
    bearing_rad: F64
    sigma_range_m: F64
    sigma_bearing_rad: F64
    kinds: Sequence[str]
    height_m: F64 | None = None

    def __post_init__(self) -> None:
        n = len(self.kinds)
        if n > MAX_DETECTIONS:
            raise BadLook(f"look at {self.t_ns} ns: {n} detections, at most {MAX_DETECTIONS}")
        for name in ("range_m", "bearing_rad", "sigma_range_m", "sigma_bearing_rad"):
            self._check(name, n)
        if (self.range_m <= 0.0).any() or (self.range_m > MAX_RANGE_M).any():
            raise BadLook(f"look at {self.t_ns} ns: ranges {self.range_m.min()} … {self.range_m.max()} m")
        if (self.sigma_range_m <= 0.0).any() or (self.sigma_bearing_rad <= 0.0).any():
            raise BadLook(f"look at {self.t_ns} ns: a sigma is not positive")
        if self.height_m is not None and np.shape(self.height_m) != (n,):
            raise BadLook(f"look at {self.t_ns} ns: {np.shape(self.height_m)} heights of {n} detections")

    def _check(self, name: str, n: int) -> None:
        column = np.asarray(getattr(self, name), np.float64)
        if column.shape != (n,) or not np.isfinite(column).all():
            raise BadLook(f"look at {self.t_ns} ns: {name} of shape {column.shape} must be {n} finite values")
        object.__setattr__(self, name, column)

    def __len__(self) -> int:
        return len(self.kinds)

    @property
    def variance(self) -> F64:
        """(N, 2) variances of range [m^2] and bearing [rad^2]: the diagonal of R."""
        sigmas = np.stack([self.sigma_range_m, self.sigma_bearing_rad], axis=1)
        return np.asarray(np.maximum(sigmas, SMALLEST_SIGMA) ** 2)


@dataclass(frozen=True, slots=True, eq=False)
class MapFeatures:
    """Point features of the map that a vehicle drives with, in its map frame.

    Attributes:
        feature_id: int64 (N,), unique, > 0.
        kind: N words.
        xy_m: float64 (N, 2).
        z_m: float64 (N,), nan where the height is unknown.
        cov: float64 (N, 2, 2), m^2.
    """

    feature_id: I64
    kind: tuple[str, ...]
    xy_m: F64
    z_m: F64
    cov: F64

    def __post_init__(self) -> None:
        n = len(self.feature_id)
        shapes = (len(self.kind), self.xy_m.shape, self.z_m.shape, self.cov.shape)
        if shapes != (n, (n, 2), (n,), (n, 2, 2)):
            raise BadMapFeatures(f"{n} ids, but kinds, xy_m, z_m and cov of shapes {shapes}")
        if len(np.unique(self.feature_id)) != n or (n and self.feature_id.min() <= 0):
            raise BadMapFeatures(f"{n} ids, {len(np.unique(self.feature_id))} of them different; each must be > 0")
        if not np.isfinite(self.xy_m).all():
            raise BadMapFeatures(f"{int((~np.isfinite(self.xy_m)).any(axis=1).sum())} features without position")
        if n and not (np.isfinite(self.cov).all() and (np.linalg.eigvalsh(self.cov) >= -1e-9).all()):
            raise BadMapFeatures("a covariance is not finite, or has a negative eigenvalue")

    @classmethod
    def none(cls) -> "MapFeatures":
        """An empty map."""
        return cls(np.zeros(0, np.int64), (), np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2, 2)))
