"""Where the vehicle is, as well as it knows: for choosing tiles, for the ledger and for people."""

import math

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas.drive import DriveItem, GnssFix, MotionSample
from gnd.vehicle_agent.link.plan import VehicleCourse
from gnd.vehicle_agent.localise.estimates import PoseEstimate

LONGEST_STEP_S = 1.0  # a gap in the wheel speed is not driven
HEADING_BASE_M = 3.0  # satellites give a heading from fixes this far apart


class Place:
    """Position and heading in the map frame from the localiser where it knows them, else from satellites."""

    def __init__(self, frame: LocalFrame, fix: GnssFix) -> None:
        self.frame = frame
        self.t_ns = fix.t_ns
        self.odometer_m = 0.0
        self.speed_mps = 0.0
        self.health = "lost"
        self.position_map_m = self._enu(fix)
        self.heading_rad: float | None = None
        self._fix_map_m = self.position_map_m
        self._motion_ns: int | None = None

    def take(self, item: DriveItem, online: PoseEstimate | None) -> None:
        """Follow a measurement; `online` is what the localiser makes of all so far."""
        self.t_ns = max(self.t_ns, item.t_ns)
        if isinstance(item, MotionSample):
            self._drive(item)
        known = online is not None and online.health != "lost"
        if online is not None and known:
            self.position_map_m = online.T_map_vehicle[:3, 3].copy()
            self.heading_rad = math.atan2(online.T_map_vehicle[1, 0], online.T_map_vehicle[0, 0])
        elif isinstance(item, GnssFix):
            self._believe_satellites(item)
        self.health = online.health if online is not None else "lost"

    @property
    def course(self) -> VehicleCourse:
        """Where the vehicle goes; in reverse gear the way that it came."""
        x_m, y_m = self.position_map_m[:2].tolist()
        course_rad = None if self.heading_rad is None else self.heading_rad + self._back_rad
        return VehicleCourse(x_m, y_m, course_rad, abs(self.speed_mps))

    def ahead_map_m(self, distance_m: float) -> F64:
        """(2, 3) here and `distance_m` farther along the course; (1, 3) while the heading is not known."""
        heading_rad = self.course.heading_rad
        if heading_rad is None:
            return self.position_map_m[None]
        step = distance_m * np.array([math.cos(heading_rad), math.sin(heading_rad), 0.0])
        return np.stack([self.position_map_m, self.position_map_m + step])

    @property
    def _back_rad(self) -> float:
        """From where the vehicle points to where it goes."""
        return math.pi if self.speed_mps < 0 else 0.0

    @property
    def height_m(self) -> float:
        """Ellipsoidal height."""
        return float(self.frame.geodetic_from_enu(self.position_map_m[None])[2][0])

    @property
    def geodetic(self) -> tuple[float, float]:
        """(latitude, longitude) in radians."""
        lat, lon, _ = self.frame.geodetic_from_enu(self.position_map_m[None])
        return float(lat[0]), float(lon[0])

    def _drive(self, sample: MotionSample) -> None:
        self.speed_mps = sample.speed_mps
        if self._motion_ns is not None:
            step_s = (sample.t_ns - self._motion_ns) * 1e-9
            self.odometer_m += abs(sample.speed_mps) * min(max(step_s, 0.0), LONGEST_STEP_S)
        self._motion_ns = sample.t_ns

    def _believe_satellites(self, fix: GnssFix) -> None:
        self.position_map_m = self._enu(fix)
        step = self.position_map_m - self._fix_map_m
        if math.hypot(step[0], step[1]) > HEADING_BASE_M:
            course_rad = math.atan2(step[1], step[0])
            self.heading_rad = course_rad + self._back_rad
            self._fix_map_m = self.position_map_m

    def _enu(self, fix: GnssFix) -> F64:
        return np.asarray(self.frame.enu_from_geodetic(fix.lat_rad, fix.lon_rad, fix.height_m)).reshape(3)
