"""What goes wrong with a vehicle's sensors: clocks that differ, wheels that slip, satellites that jump, dirt."""

from dataclasses import dataclass, fields, replace
from math import pi
from typing import Final

import numpy as np

from gnd.fleet_sim.errors import DriveSimError
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import exp_so3
from gnd.schemas.drive import Scan

_NS_PER_S: Final = 1_000_000_000
_DIRT_M: Final = 0.3
_SLIP_S: Final = (0.4, 0.9)
_JUMP_S: Final = (2.0, 4.0)


@dataclass(frozen=True, slots=True)
class Faults:
    """What is wrong on a drive, beside the usual errors of its sensors; nothing by default.

    Attributes:
        clock_s: stamps of wheel and gyro samples are so much too late against those of the scans.
        clock_drift: and grow by so many seconds a second.
        scan_clock_s: stamps of the scans are so much too late against everything else, the truth's times too.
        wheel_scale: the wheels tell so much too much speed, as a share.
        slips_per_min: times that the wheels spin or lock, for half a second or so.
        slip: by how much the speed is off then, as a share.
        gyro_bias_radps: constant error of the yaw rate.
        mount_rad: by how much the header is wrong about the mount: roll, pitch, yaw.
        gnss_jump_m: the position jumps by so much for some seconds ...
        gnss_jumps_per_min: ... so often.
        no_gnss_s: from and until when there is no position.
        missing_share: share of the scans that never arrive, in gaps of one to three.
        blocked_rad: width of a sector in which dirt covers the window.
    """

    clock_s: float = 0.0
    clock_drift: float = 0.0
    scan_clock_s: float = 0.0
    wheel_scale: float = 0.0
    slips_per_min: float = 0.0
    slip: float = 0.3
    gyro_bias_radps: float = 0.0
    mount_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gnss_jump_m: float = 0.0
    gnss_jumps_per_min: float = 0.0
    no_gnss_s: tuple[float, float] = (0.0, 0.0)
    missing_share: float = 0.0
    blocked_rad: float = 0.0

    def __post_init__(self) -> None:
        if not all(np.isfinite(np.atleast_1d(getattr(self, field.name))).all() for field in fields(self)):
            raise DriveSimError(f"every number of the faults must be finite: {self}")
        if not 0.0 <= self.missing_share <= 0.9 or not 0.0 <= self.blocked_rad < 2 * pi:
            raise DriveSimError(f"faults: {self.missing_share} of the scans, {self.blocked_rad} rad of the window")
        if (
            min(self.slips_per_min, self.gnss_jumps_per_min, self.gnss_jump_m) < 0.0
            or max(abs(self.clock_s), abs(self.scan_clock_s)) > 1.0
        ):
            raise DriveSimError(f"faults: rates and sizes must not be negative, clocks within 1 s: {self}")

    def stamp_error_s(self, t_s: F64) -> F64:
        """Return by how much the stamps (K,) of samples taken at times (K,) [s] are too late."""
        return self.clock_s + self.clock_drift * np.maximum(t_s, 0.0)

    def speed_factor(self, t_s: F64, rng: np.random.Generator) -> F64:
        """Return what the wheels make of the speed at times (K,) [s], as factors (K,)."""
        factor = np.full(len(t_s), 1.0 + self.wheel_scale)
        for begin, end in _episodes(t_s, self.slips_per_min, _SLIP_S, rng):
            spins = rng.random() < 0.5
            factor[(t_s >= begin) & (t_s < end)] *= 1.0 + self.slip * (1.0 if spins else -1.0)
        return factor

    def gnss_jumps(self, t_s: F64, rng: np.random.Generator) -> F64:
        """Return jumps of the position (K, 3) [m] at times (K,) [s], map frame: level, in a direction each."""
        jumps = np.zeros((len(t_s), 3))
        for begin, end in _episodes(t_s, self.gnss_jumps_per_min, _JUMP_S, rng):
            turn = rng.uniform(0.0, 2 * pi)
            jumps[(t_s >= begin) & (t_s < end)] = self.gnss_jump_m * np.array([np.cos(turn), np.sin(turn), 0.0])
        return jumps

    def has_gnss(self, t_s: F64) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Return when there is a position, bool (K,), at times (K,) [s]."""
        begin, end = self.no_gnss_s
        return np.asarray((t_s < begin) | (t_s >= end))

    def mount(self, T_vehicle_lidar: F64) -> F64:
        """Return the mount (4, 4) that the header claims, from the one that it should."""
        T = T_vehicle_lidar.copy()
        T[:3, :3] = T[:3, :3] @ exp_so3(np.array(self.mount_rad))
        return T

    def arrives(self, scans: int, rng: np.random.Generator) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Return which scans arrive, bool (scans,); the first does."""
        arrived = np.ones(scans, dtype=np.bool_)
        while self.missing_share and 1.0 - arrived.mean() < self.missing_share:
            at = int(rng.integers(1, max(scans, 2)))
            arrived[at : at + int(rng.integers(1, 4))] = False
        return arrived

    def blocked_at(self, span_rad: float, rng: np.random.Generator) -> float:
        """Return the azimuth of the middle of the dirt [rad], within a sensor's span about straight ahead."""
        reach = max(0.5 * (span_rad - self.blocked_rad), 0.0)
        return float(rng.uniform(-reach, reach))

    def dirty(self, scan: Scan, middle_rad: float, rng: np.random.Generator) -> Scan:
        """Return a scan with dirt on the window: half of the sector gives returns at 0.3 m, the other half none."""
        if not self.blocked_rad:
            return scan
        azimuth = np.arctan2(scan.points_m[:, 1], scan.points_m[:, 0])
        off = (azimuth - middle_rad + pi) % (2 * pi) - pi
        returns, blind = (off >= 0) & (off < self.blocked_rad / 2), (off < 0) & (off >= -self.blocked_rad / 2)
        points, near = scan.points_m.copy(), _DIRT_M * rng.uniform(0.9, 1.1, int(returns.sum()))
        points[returns] *= (near / np.linalg.norm(points[returns], axis=1))[:, None].astype(np.float32)
        ring = None if scan.ring is None else scan.ring[~blind]
        return replace(scan, points_m=points[~blind], t_offset_ns=scan.t_offset_ns[~blind], ring=ring)


def _episodes(
    t_s: F64, per_min: float, length_s: tuple[float, float], rng: np.random.Generator
) -> list[tuple[float, float]]:
    """Return begins and ends [s], evenly at random over what is driven, `per_min` a minute but at least one if any."""
    whole_s = float(t_s[-1] - t_s[0])
    count = max(1, round(per_min * whole_s / 60.0)) if per_min else 0
    begins = [float(t_s[0]) + whole_s * (k + rng.uniform(0.25, 0.75)) / count for k in range(count)]
    return [(begin, begin + float(rng.uniform(*length_s))) for begin in begins]
