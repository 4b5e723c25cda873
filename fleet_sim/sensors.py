"""The LiDARs of the simulations after their data sheets: where and when each beam fires, how far and how well it sees.

The lidar frame is x forward, y left, z up. Every model here turns clockwise seen from above and sweeps an azimuth span
that lies evenly about straight ahead: a whole turn that starts and ends behind for spinning sensors, less for a sensor
with a window. In the rest of its period such a sensor sees nothing.

Beams are listed in the order of firing. What a single unit's calibration file corrects (azimuth and height offsets of
its lasers, by up to some degrees and centimetres) is no part of a model.
"""

from dataclasses import dataclass
from math import radians, tau
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import SceneError

FloatArray = NDArray[np.float64]

_NS_PER_S: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class LidarModel:
    """A LiDAR whose beams sweep an azimuth span again and again.

    Attributes:
        name: model name as written into recordings.
        short: name of the model in options and results.
        elevations_rad: elevation of each beam in the order of firing, up positive.
        firing_ns: time of each beam after the start of its firing cycle, never falling.
        cycle_ns: time between two firings of the same beam.
        rate_hz: sweeps a second; the sensor turns once in a period.
        span_rad: azimuth that a sweep covers, evenly about straight ahead; at most a whole turn.
        range_min_m, range_max_m: nearer and farther returns are not given.
        range_sigma_m: standard deviation of the range.
        range_step_m: ranges are given as multiples of it; 0 where the rounding of the points is as fine.
        loss: probability that any return is lost.
        dark_m: range at which a surface of reflectivity 0.1, met head-on, is still always seen.
        mount_m: where it sits on the vehicle: x ahead of the rear axle, y left, z over the road.
    """

    name: str
    short: str
    elevations_rad: tuple[float, ...]
    firing_ns: tuple[int, ...]
    cycle_ns: int
    rate_hz: float = 10.0
    span_rad: float = tau
    range_min_m: float = 1.0
    range_max_m: float = 100.0
    range_sigma_m: float = 0.03
    range_step_m: float = 0.0
    loss: float = 0.01
    dark_m: float = 100.0
    mount_m: tuple[float, float, float] = (1.2, 0.0, 1.9)

    def __post_init__(self) -> None:
        beams, times = len(self.elevations_rad), self.firing_ns
        if beams < 1 or len(times) != beams:
            raise SceneError(f"{self.name}: {beams} beams have {len(times)} firing times")
        if list(times) != sorted(times) or times[0] < 0 or times[-1] >= self.cycle_ns:
            raise SceneError(f"{self.name}: {beams} shots until {times[-1]} ns do not fit into {self.cycle_ns} ns")
        if not 0.0 < self.span_rad <= tau or self.columns < 1:
            raise SceneError(f"{self.name}: {self.columns} cycles in a span of {self.span_rad:.3f} rad")
        if not 0.0 <= self.range_min_m < self.range_max_m or min(self.range_sigma_m, self.range_step_m) < 0.0:
            raise SceneError(f"{self.name}: impossible ranges {self.range_min_m} … {self.range_max_m} m")

    @property
    def beams(self) -> int:
        """Number of beams."""
        return len(self.elevations_rad)

    @property
    def columns(self) -> int:
        """Firing cycles in a sweep."""
        return int(self.period_ns * (self.span_rad / tau) + 1e-6) // self.cycle_ns

    @property
    def period_ns(self) -> int:
        """Time from sweep to sweep [ns]."""
        return round(_NS_PER_S / self.rate_hz)

    @property
    def rings(self) -> NDArray[np.uint8]:
        """Rank of each beam from the lowest up, uint8 (beams,), in the order of firing."""
        return np.argsort(np.argsort(self.elevations_rad)).astype(np.uint8)

    @property
    def shares(self) -> FloatArray:
        """Time of each beam as a share of the firing cycle, float64 (beams,)."""
        return np.array(self.firing_ns, dtype=np.float64) / self.cycle_ns

    def shot_times_ns(self) -> NDArray[np.int64]:
        """Return the time of each shot after the start of the sweep, int64 (columns, beams) [ns]."""
        columns = np.arange(self.columns, dtype=np.int64)
        return columns[:, None] * self.cycle_ns + np.array(self.firing_ns, dtype=np.int64)

    def directions(self) -> FloatArray:
        """Return the unit direction of each shot, float64 (columns, beams, 3), lidar frame at the time of the shot."""
        azimuth = self.span_rad / 2 - tau * self.shot_times_ns() / self.period_ns
        elevation = np.array(self.elevations_rad)
        flat = np.cos(elevation)
        up = np.broadcast_to(np.sin(elevation), azimuth.shape)
        return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up], axis=-1)


def _evenly(shot_ns: int, beams: int) -> tuple[int, ...]:
    """One shot after the other."""
    return tuple(shot_ns * i for i in range(beams))


def _interleaved(low_deg: float, step_deg: float, beams: int) -> tuple[float, ...]:
    """Velodyne's order of firing: lowest beam, middle beam, second lowest, second of the upper half, ..."""
    angles = [low_deg + step_deg * i for i in range(beams)]
    pairs = zip(angles[: beams // 2], angles[beams // 2 :], strict=True)
    return tuple(radians(angle) for pair in pairs for angle in pair)


# Velodyne VLP-16 user manual 63-9243: 16 beams, ±15° by 2°, 55.296 µs a cycle, 2.304 µs a shot, ±3 cm, 100 m.
VLP16: Final = LidarModel(
    name="VLP-16",
    short="vlp16",
    elevations_rad=_interleaved(-15.0, 2.0, 16),
    firing_ns=_evenly(2_304, 16),
    cycle_ns=55_296,
    range_sigma_m=0.03,
)

# Velodyne HDL-32E user manual 63-9113: 32 beams, +10.67° … -30.67° by 1.33°, 46.08 µs a cycle, 1.152 µs a shot,
# ±2 cm, 100 m.
HDL32E: Final = LidarModel(
    name="HDL-32E",
    short="hdl32e",
    elevations_rad=_interleaved(-92 / 3, 4 / 3, 32),
    firing_ns=_evenly(1_152, 32),
    cycle_ns=46_080,
    range_sigma_m=0.02,
)

_HDL64_PAIRS: Final = (2, 13, 3, 0, 4, 1, 8, 5, 9, 6, 10, 7, 14, 11, 15, 12)
"""Height of each pair of neighbouring lasers within its block, counted from below, in the order of firing."""
_HDL64_GROUP_NS: Final = (0, 1_260, 2_460, 3_660)
"""Four lasers of a block fire one after the other, then it recharges; a group takes 6 µs."""


def _hdl64_elevations() -> tuple[float, ...]:
    """Two blocks of 32: +2 … -8.33° by 1/3°, -8.83 … -24.33° by 1/2°; laser i of both fires at the same time."""
    ranks = [2 * pair + i for pair in _HDL64_PAIRS for i in range(2)]
    degrees = [angle for rank in ranks for angle in (-25 / 3 + rank / 3, -73 / 3 + rank / 2)]
    return tuple(radians(angle) for angle in degrees)


def _hdl64_firing_ns() -> tuple[int, ...]:
    return tuple(6_000 * group + ns for group in range(8) for ns in _HDL64_GROUP_NS for _ in range(2))


# Velodyne HDL-64E S2 user manual 63-HDL64ES2: 2 x 32 beams, 0.1728° at 10 Hz, 120 m, 50 m on pavement (which is met at
# a grazing angle: 200 m head-on), 2 cm; times from its "laser firing time table"; the order of the lasers' heights is
# the one of every calibration file, such as velodyne_pointcloud's 64e_s2.1-sztaki.yaml.
HDL64E: Final = LidarModel(
    name="HDL-64E",
    short="hdl64e",
    elevations_rad=_hdl64_elevations(),
    firing_ns=_hdl64_firing_ns(),
    cycle_ns=48_000,
    range_min_m=0.9,
    range_max_m=120.0,
    range_sigma_m=0.02,
    dark_m=200.0,
    mount_m=(1.2, 0.0, 2.0),
)

# RoboSense RS-LiDAR-16 user manual: 16 beams, ±15° by 2° (-15° … -1°, then +15° … +1°), 50 µs a cycle (0.18° at 10 Hz),
# 2.8 µs a shot, 0.4 … 150 m, 80 m on 10 %, ±2 cm, distances by 5 mm (rs_driver, decoder_RS16).
RS16: Final = LidarModel(
    name="RS-LiDAR-16",
    short="rs16",
    elevations_rad=tuple(radians(angle) for angle in (*range(-15, 0, 2), *range(15, 0, -2))),
    firing_ns=_evenly(2_800, 16),
    cycle_ns=50_000,
    range_min_m=0.4,
    range_max_m=150.0,
    range_sigma_m=0.02,
    range_step_m=0.005,
    dark_m=80.0,
)

_RS32_DEG: Final = (
    *(-10.281, 0.333, -6.424, 0.0, 2.333, -0.333, 3.333, -0.667, 4.667, 1.667, 7.0, 1.333, 10.333, 1.0, 15.0, 0.667),
    *(-25.0, -2.333, -14.638, -2.667, -7.91, -3.0, -5.407, -3.333, -3.667, -1.0, -4.0, -1.333, -4.333, -1.667),
    *(-4.667, -2.0),
)
"""Elevation of each channel."""


def _rs32_elevations() -> tuple[float, ...]:
    """Channels k and k + 16 fire in turn."""
    return tuple(radians(angle) for k in range(16) for angle in (_RS32_DEG[k], _RS32_DEG[k + 16]))


# RoboSense RS-LiDAR-32 user manual, section 9 and appendix A: 32 beams of uneven spacing, -25° … +15°, 1.44 µs a shot
# with one left out before the last two (table A-1, rs_driver's decoder_RS32), 0.4 … 200 m, 150 m on 10 %, ±3 cm, 5 mm;
# order of the channels as in ros_rslidar's rs_lidar_32/angle.csv; 0.18° at 10 Hz is 50 µs a cycle.
RS32: Final = LidarModel(
    name="RS-LiDAR-32",
    short="rs32",
    elevations_rad=_rs32_elevations(),
    firing_ns=(*_evenly(1_440, 30), 44_640, 46_080),
    cycle_ns=50_000,
    range_min_m=0.4,
    range_max_m=200.0,
    range_sigma_m=0.03,
    range_step_m=0.005,
    dark_m=150.0,
)

# Valeo Scala (first generation, Ibeo's ScaLa B2): 4 layers of 0.8° that receive one flash together, 145° by 0.25°,
# 25 Hz, 150 m on cars, 5 cm, ranges in centimetres (ibeo_msgs/ScanPoint2208). Its mirror has two sides and turns at
# 12.5 Hz: the beam moves at 9000°/s through the window and is blind for the rest of the 40 ms. It sits level behind the
# front bumper, at the height of a number plate: 3.6 m ahead of the rear axle, 0.6 m over the road.
SCALA: Final = LidarModel(
    name="Scala",
    short="scala",
    elevations_rad=tuple(radians(angle) for angle in (-1.2, -0.4, 0.4, 1.2)),
    firing_ns=(0, 0, 0, 0),
    cycle_ns=27_777,
    rate_hz=25.0,
    span_rad=radians(145.0),
    range_min_m=0.3,
    range_max_m=150.0,
    range_sigma_m=0.05,
    range_step_m=0.01,
    dark_m=80.0,
    mount_m=(3.6, 0.0, 0.6),
)

MODELS: Final = {model.name: model for model in (VLP16, HDL32E, HDL64E, RS16, RS32, SCALA)}
"""The models by their names in recordings."""
SHORT_NAMES: Final = {model.short: model.name for model in MODELS.values()}
"""Names in recordings by the names of options and results."""
