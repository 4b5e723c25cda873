"""What detectors of map features and a lane camera see in one look, values of a recorded drive."""

import math
from dataclasses import dataclass, field
from typing import Final, Literal, get_args

import numpy as np

from gnd.gnd_map.arrays import F32, check_array
from gnd.gnd_map.features.feature import KIND_PATTERN
from gnd.schemas import limits
from gnd.schemas.errors import BadValue
from gnd.schemas.wire import LAYER_PATTERN, check_length, check_text, check_unsigned, refusing

_TIME_BITS: Final = 63
_PI32: Final = float(np.float32(math.pi))
"""float32 rounds pi up."""
LookSensor = Literal["camera", "lidar"]
LOOK_SENSORS: Final[tuple[LookSensor, ...]] = get_args(LookSensor)


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """What a detector of map features found in one look; one that found nothing is said too: absence is evidence.

    Places are polar, as detectors err: about the vehicle's origin, in the plane of its x and y.
    """

    t_ns: int
    sensor: LookSensor
    """What looked."""
    layer: str
    """Feature layer that the detector looks for, such as "signs". [1-32 of a-z 0-9 _]"""
    kinds: tuple[str, ...]
    """N kinds, such as "traffic_sign". [1-64 of a-z 0-9 _]"""
    range_m: F32
    """(N,) horizontal distance from the vehicle's origin, >= 0."""
    bearing_rad: F32
    """(N,) counter-clockwise from the vehicle's x axis, -pi ... pi."""
    height_m: F32
    """(N,) above the vehicle's origin; nan = the detector cannot tell."""
    sigma_range_m: F32
    """(N,) standard deviation of the range, > 0."""
    sigma_bearing_rad: F32
    """(N,) standard deviation of the bearing, > 0."""
    free_m: F32 = field(default_factory=lambda: np.empty(0, np.float32))
    """(A,) horizontal distance up to which nothing hides a feature, > 0, in A equal sectors of `free_field_rad` from
    right to left; inf where nothing does; none where nobody knows."""
    free_field_rad: float = 0.0
    """Angle that the sectors cover, its middle on the vehicle's x axis, 0 ... 2 pi."""

    def __post_init__(self) -> None:
        check_unsigned("look time", self.t_ns, bits=_TIME_BITS)
        if self.sensor not in LOOK_SENSORS:
            raise BadValue(f"look at {self.t_ns} ns: sensor {self.sensor!r}, expected one of {', '.join(LOOK_SENSORS)}")
        check_text("layer", self.layer, LAYER_PATTERN)
        check_length(f"look at {self.t_ns} ns", len(self.kinds), limits.MAX_DETECTIONS_OF_LOOK, "detections")
        for kind in set(self.kinds):
            check_text("kind", kind, KIND_PATTERN)
        with refusing(f"look at {self.t_ns} ns"):
            self._check_columns()
            self._check_free()

    def _check_free(self) -> None:
        check_length("free ranges", len(self.free_m), limits.MAX_SECTORS_OF_LOOK, "sectors")
        check_array("free_m", np.minimum(self.free_m, np.float32(1e9)), np.float32, (None,))
        if len(self.free_m) and not (self.free_m.min() > 0 and 0 < self.free_field_rad <= 2 * _PI32):
            raise BadValue(
                f"free ranges from {self.free_m.min()} m over {self.free_field_rad} rad, expected > 0 and up to 2 pi"
            )

    def _check_columns(self) -> None:
        n = len(self.kinds)
        for name in ("range_m", "bearing_rad", "sigma_range_m", "sigma_bearing_rad"):
            check_array(name, getattr(self, name), np.float32, (n,))
        check_array("height_m", np.nan_to_num(self.height_m, nan=0.0, posinf=np.inf, neginf=-np.inf), np.float32, (n,))
        if n and not (self.range_m.min() >= 0 and np.abs(self.bearing_rad).max() <= _PI32):
            worst = float(np.abs(self.bearing_rad).max())
            raise BadValue(f"ranges from {self.range_m.min()} m, bearings to {worst} rad; expected >= 0 and <= pi")
        if n and min(self.sigma_range_m.min(), self.sigma_bearing_rad.min()) <= 0:
            raise BadValue(
                f"sigmas of {self.sigma_range_m.min()} m and {self.sigma_bearing_rad.min()} rad, expected > 0"
            )

    def __len__(self) -> int:
        return len(self.kinds)


@dataclass(frozen=True, slots=True, eq=False)
class LaneLook:
    """The lane markings that a camera sees at one time."""

    t_ns: int
    polylines: tuple[F32, ...]
    """Each (N, 2), N >= 2, x and y in the frame `vehicle` along one marking [m]."""
    sigma_m: float = 0.0
    """Standard deviation of a polyline's distance; 0 = the camera does not say."""
    sigma_rad: float = 0.0
    """Standard deviation of a polyline's heading; 0 = the camera does not say."""

    def __post_init__(self) -> None:
        check_unsigned("lane look time", self.t_ns, bits=_TIME_BITS)
        what = f"lane look at {self.t_ns} ns"
        check_length(what, len(self.polylines), limits.MAX_POLYLINES_OF_LOOK, "polylines")
        check_length(what, sum(map(len, self.polylines)), limits.MAX_POINTS_OF_LANE_LOOK, "points")
        with refusing(what):
            for line in self.polylines:
                check_array("polyline", line, np.float32, (None, 2))
        short = min(map(len, self.polylines), default=2)
        if short < 2:
            raise BadValue(f"{what}: a polyline of {short} points, expected at least 2")
        if not (0 <= self.sigma_m < math.inf and 0 <= self.sigma_rad < math.inf):
            raise BadValue(f"{what}: sigmas of {self.sigma_m} m and {self.sigma_rad} rad, expected >= 0")

    def __len__(self) -> int:
        return len(self.polylines)
