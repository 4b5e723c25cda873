"""What a sensor could have seen: its field of view, and what hides features in it.

A feature that is out of view or hidden gets no evidence (SLAMCU, section 4.2.1 and 6.3). Whether something hides it is
taken from a scan: the nearest return in its direction. What hides a sign is decided by directions, not by heights: a
truck of 4 m near by hides a sign of 6 m far away. So returns are kept by azimuth and slope (height over distance, seen
from the sensor), and compared by horizontal distance.
"""

from dataclasses import dataclass
from math import isfinite, pi, radians
from typing import Final

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import F64, points_3d
from gnd.schemas.drive import Detections
from gnd.vehicle_agent.features.errors import BadLook

_TURN: Final = 2.0 * pi
TYPICAL_HEIGHT_M: Final = 2.5
"""Height over the vehicle's origin at which a feature of unknown height is looked for: the middle of a road sign."""
BEHIND_M: Final = 1.0
"""A return this little nearer than a feature may be the feature's own, or its post's."""


@dataclass(frozen=True, slots=True)
class SensorView:
    """A sector ahead of the vehicle's origin.

    Attributes:
        field_rad: its whole angle; 2π all around.
        range_m: its farthest range.
    """

    field_rad: float
    range_m: float

    def __post_init__(self) -> None:
        if not (isfinite(self.range_m) and self.range_m > 0 and 0 < self.field_rad <= _TURN + 1e-9):
            raise BadLook(f"view of {self.field_rad} rad, {self.range_m} m")

    @property
    def all_around(self) -> bool:
        """Whether it has no left and right border."""
        return self.field_rad >= _TURN - 1e-9

    def inside(
        self, range_m: F64, bearing_rad: F64, range_edge_m: npt.ArrayLike = 0.0, bearing_edge_rad: npt.ArrayLike = 0.0
    ) -> npt.NDArray[np.bool_]:
        """Which directions (N,) lie in view, farther from its border than the edges (N,) or one for all."""
        in_range = range_m <= self.range_m - np.asarray(range_edge_m)
        if self.all_around:
            return np.asarray(in_range)
        off = np.abs(wrapped(bearing_rad))
        return np.asarray(in_range & (off <= 0.5 * self.field_rad - np.asarray(bearing_edge_rad)))


CAMERA: Final = SensorView(radians(40.0), 80.0)
"""The camera of the SLAMCU paper, section 6.1."""
LIDAR: Final = SensorView(_TURN, 50.0)
"""Poles are found reliably so far around."""


def wrapped(angle_rad: F64) -> F64:
    """Angles in -π … π."""
    return np.asarray((angle_rad + pi) % _TURN - pi)


@dataclass(frozen=True, slots=True, eq=False)
class Occlusion:
    """How far one can see: free horizontal range by azimuth (and slope) from the vehicle's origin.

    Attributes:
        free_m: float64 (A, S), A azimuths of equal width, S bands of slope; inf = nothing in the way.
        first_rad: where the first azimuth bin begins, counter-clockwise from the vehicle's x axis.
        width_rad: width of an azimuth bin; outside of all bins nothing is known to hide anything.
        slopes: float64 (S + 1,), rising borders of the bands; () for one band of all heights.
        height_m: of the sensor over the vehicle's origin.
    """

    free_m: F64
    first_rad: float
    width_rad: float
    slopes: F64
    height_m: float = 0.0

    def __post_init__(self) -> None:
        bands = max(len(self.slopes) - 1, 1)
        if self.free_m.ndim != 2 or self.free_m.shape[1] != bands or not len(self.free_m):
            raise BadLook(f"free ranges of shape {self.free_m.shape}, expected (A, {bands})")
        if np.isnan(self.free_m).any() or not 0.0 < self.width_rad * len(self.free_m) <= _TURN + 1e-6:
            raise BadLook(f"{len(self.free_m)} azimuths of {self.width_rad} rad, or ranges that are no numbers")

    @classmethod
    def of_ranges(cls, free_m: npt.ArrayLike, first_rad: float, width_rad: float) -> "Occlusion":
        """One band: free ranges (A,) [m] by azimuth, whatever the height."""
        return cls(np.asarray(free_m, np.float64).reshape(-1, 1), first_rad, width_rad, np.zeros(0))

    @classmethod
    def of_look(cls, look: Detections) -> "Occlusion | None":
        """The free ranges that come with a look; None where it brings none."""
        if not len(look.free_m):
            return None
        return cls.of_ranges(look.free_m, -0.5 * look.free_field_rad, look.free_field_rad / len(look.free_m))

    @classmethod
    def of_scan(
        cls, points_vehicle_m: F64, sensor_m: npt.ArrayLike, azimuths: int = 720, max_range_m: float = 100.0
    ) -> "Occlusion":
        """Nearest return per azimuth and slope.

        Args:
            points_vehicle_m: (N, 3) returns, vehicle frame.
            sensor_m: (3,) where they were measured from, vehicle frame.
            azimuths: bins of the circle.
            max_range_m: returns beyond hide nothing of interest.
        """
        points = points_3d("points_vehicle_m", points_vehicle_m)
        slopes = np.arange(-0.25, 0.7501, 0.05)
        free = np.full((azimuths, len(slopes) - 1), np.inf)
        x, y, z = (points - [0.0, 0.0, float(np.asarray(sensor_m)[2])]).T
        range_m = np.hypot(x, y)
        keep = (range_m > 0.5) & (range_m < max_range_m)
        band = np.floor((z[keep] / range_m[keep] - slopes[0]) / 0.05).astype(np.int64)
        azimuth = np.floor((np.arctan2(y[keep], x[keep]) + pi) / _TURN * azimuths).astype(np.int64) % azimuths
        inside = (band >= 0) & (band < free.shape[1])
        np.minimum.at(free, (azimuth[inside], band[inside]), range_m[keep][inside])
        return cls(free, -pi, _TURN / azimuths, slopes, float(np.asarray(sensor_m)[2]))

    def clear(self, range_m: F64, bearing_rad: F64, bearing_edge_rad: F64, z_m: F64) -> npt.NDArray[np.bool_]:
        """Which features (N,) nothing hides, anywhere in bearing ± edge.

        Args:
            range_m: horizontal distance.
            bearing_rad: counter-clockwise from the vehicle's x axis.
            bearing_edge_rad: how uncertain the bearing is.
            z_m: height over the vehicle's origin, nan = unknown.
        """
        return np.array(
            [self._clear(*one) for one in zip(range_m, bearing_rad, bearing_edge_rad, z_m, strict=True)], np.bool_
        )

    def _clear(self, range_m: float, bearing_rad: float, edge_rad: float, z_m: float) -> bool:
        steps = np.arange(-np.ceil(edge_rad / self.width_rad), np.ceil(edge_rad / self.width_rad) + 1)
        bins = np.floor((bearing_rad - self.first_rad) % _TURN / self.width_rad).astype(np.int64) + steps.astype(
            np.int64
        )
        bins = bins % round(_TURN / self.width_rad)
        bins = bins[bins < len(self.free_m)]
        if not len(bins):
            return True
        return bool(self.free_m[bins, self._band(range_m, z_m)].min() >= range_m - BEHIND_M)

    def _band(self, range_m: float, z_m: float) -> int:
        if not len(self.slopes):
            return 0
        slope = ((z_m if isfinite(z_m) else TYPICAL_HEIGHT_M) - self.height_m) / max(range_m, 0.1)
        return int(np.clip(np.searchsorted(self.slopes, slope, side="right") - 1, 0, len(self.slopes) - 2))
