"""The scans of a stretch, the knots among them, and the measured motion between these."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.localise.calibration import MotionTeacher
from gnd.vehicle_agent.localise.odometry import MotionBuffer
from gnd.vehicle_agent.localise.scan_odometry import ScanStep
from gnd.vehicle_agent.localise.step_noise import StepNoise
from gnd.vehicle_agent.localise.stretch import N_SHARED, Knot, StretchStep, shared_of

_KNOT_M: Final = 0.7
_KNOT_S: Final = 0.5
"""A scan becomes a knot when the vehicle has moved so far, or so much time has passed, since the last."""
_N_POINTS: Final = 2500
"""Of a knot."""
_CORRELATED_M: Final = 2.0
"""Scans nearer to each other see the same surfaces of the map, with the same errors: they share one weight."""
_LEAST_WEIGHT: Final = 0.05
_YAW_DEG: Final = 0.02
_LONGITUDINAL_M: Final = 0.01
_LATERAL_M: Final = 0.003
_NOISE_WAY_M: Final = 5.0
"""One sigma of the odometry over this way beside what all steps share, growing with the root of the way; a second
counts as a metre."""
_ROLL_PITCH_DEG: Final = 0.2
_VERTICAL_M: Final = 0.01
"""Of attitude and height from scan to scan, which no wheel measures."""


@dataclass(slots=True, eq=False)
class StretchScan:
    """A scan since the first of the stretch.

    Attributes:
        number: of its pose in the graph.
        t_ns: its time.
        way_m: odometer.
        T_before_now: (4, 4) motion since the scan before by all odometry.
        variance: (6,) of wheels and gyro in that motion, less what all steps share.
        seen: that motion by the scans.
        knot: its part in the solution; None between knots.
    """

    number: int
    t_ns: int
    way_m: float
    T_before_now: F64
    variance: F64
    seen: ScanStep | None
    knot: Knot | None


class StretchScans:
    """The scans of a stretch in order of time; their numbers follow each other."""

    def __init__(self, motion: MotionBuffer, teacher: MotionTeacher) -> None:
        self._motion, self._teacher = motion, teacher
        self._all: list[StretchScan] = []

    def __len__(self) -> int:
        return len(self._all)

    def __getitem__(self, i: int) -> StretchScan:
        return self._all[i]

    def take(
        self, number: int, t_ns: int, points_m: F64, T_online: F64, T_before_now: F64 | None, seen: ScanStep | None
    ) -> StretchScan:
        """Add a scan, arguments as of `Refiner.push`: a knot, if the vehicle has moved on or time has passed."""
        self._all.append(self._made(number, t_ns, points_m, T_online, T_before_now, seen))
        return self._all[-1]

    def knots(self) -> list[StretchScan]:
        """Return the scans that are knots."""
        return [scan for scan in self._all if scan.knot is not None]

    def index(self, scan: StretchScan) -> int:
        """Return the place of a scan among all."""
        return scan.number - self._all[0].number

    def drop_before(self, scan: StretchScan) -> int:
        """Let go of the scans before this one; return how many they are."""
        gone = self.index(scan)
        self._all = self._all[gone:]
        return gone

    def seen_since(self, t_ns: int) -> list[ScanStep | None]:
        """Return the motion by the scans, step by step, after a time."""
        return [scan.seen for scan in self._all if scan.t_ns > t_ns]

    def steps(self, noise: StepNoise) -> list[list[StretchStep]]:
        """Return the measurements of the motion between neighbouring knots: by wheels and gyro, and by the scans where
        all of them are known.
        """
        found = []
        for before, now in pairwise(self.knots()):
            T, dt_s = self._motion.delta(before.t_ns, now.t_ns), (now.t_ns - before.t_ns) * 1e-9
            passed = self._all[self.index(before) + 1 : self.index(now) + 1]
            variance = np.sum([scan.variance for scan in passed], axis=0)
            variance[2:4] += np.square(self._teacher.clock_sigmas(before.t_ns, now.t_ns))
            variance[3] += self._teacher.slip_sigma_m(before.t_ns, now.t_ns, T) ** 2
            measured = [noise.grown(StretchStep(T, np.diag(variance), shared_of(T, dt_s)))]
            seen = [scan.seen for scan in passed if scan.seen is not None]
            if len(seen) == len(passed):
                measured.append(_chained(seen))
            found.append(measured)
        return found

    def from_knot(self, knot: int, i: int) -> F64:
        """Return the pose (4, 4) of a scan by wheels and gyro from that of a knot."""
        first, scan = self._all[knot], self._all[i]
        assert first.knot is not None
        return np.asarray(first.knot.T_map_vehicle @ self._motion.delta(first.t_ns, scan.t_ns))

    def share(self, i: int, low: int, high: int) -> float:
        """Return how far along the way from one knot to the next a scan is, 0 ... 1."""
        way = [self._all[k].way_m for k in (low, i, high)]
        t = [self._all[k].t_ns for k in (low, i, high)]
        a, b, c = way if way[2] - way[0] > 1e-3 else t
        return float(np.clip((b - a) / (c - a), 0.0, 1.0)) if c > a else 0.0

    def _made(
        self, number: int, t_ns: int, points_m: F64, T_online: F64, T_before_now: F64 | None, seen: ScanStep | None
    ) -> StretchScan:
        wheels_m = self._teacher.mount.wheels_m
        if not self._all:
            knot = Knot(_thinned(points_m), T_online.copy(), _LEAST_WEIGHT, wheels_m=wheels_m)
            return StretchScan(number, t_ns, 0.0, np.eye(4), np.zeros(6), None, knot)
        last, before = self._all[-1], next(scan for scan in reversed(self._all) if scan.knot is not None)
        driven = self._motion.delta(last.t_ns, t_ns)
        T = driven if T_before_now is None else T_before_now
        way_m = last.way_m + float(np.linalg.norm(driven[:3, 3]))
        scan = StretchScan(number, t_ns, way_m, T, _variance(driven, t_ns - last.t_ns), seen, None)
        since_m, since_ns = way_m - before.way_m, t_ns - before.t_ns
        if since_m >= _KNOT_M or since_ns >= _KNOT_S * 1e9:
            weight = float(np.clip(since_m / _CORRELATED_M, _LEAST_WEIGHT, 1.0))
            scan.knot = Knot(_thinned(points_m), self._carried(before, scan), weight, wheels_m=wheels_m)
        return scan

    def _carried(self, knot: StretchScan, scan: StretchScan) -> F64:
        """The pose of the newest scan, not yet among the others, from that of the last knot."""
        assert knot.knot is not None
        T = knot.knot.T_map_vehicle
        for passed in self._all[self.index(knot) + 1 :]:
            T = T @ passed.T_before_now
        return np.asarray(T @ scan.T_before_now)


def _variance(driven: F64, dt_ns: int) -> F64:
    """Return the variance (6,) of a motion (4, 4) by wheels and gyro beside what all steps share.

    A single step that is far off counts less (`STEP_CHI2`); odometry that is worse all along is found by
    `StepNoise`. Single scans are not asked what it is off by: they follow walls that were moved.
    """
    grown = np.sqrt(max(float(np.linalg.norm(driven[:3, 3])), dt_ns * 1e-9) / _NOISE_WAY_M)
    roll_pitch = np.radians(_ROLL_PITCH_DEG)
    sigmas = np.array([
        roll_pitch, roll_pitch, grown * np.radians(_YAW_DEG),
        grown * _LONGITUDINAL_M, grown * _LATERAL_M, _VERTICAL_M,
    ])  # fmt: skip
    return sigmas**2


def _thinned(points_m: F64) -> F64:
    every = max(1, len(points_m) // _N_POINTS)
    return np.ascontiguousarray(points_m[::every], dtype=np.float64)


def _chained(seen: Sequence[ScanStep]) -> StretchStep:
    """Return successive steps by the scans as one; they are short, so that covariances just add."""
    T, covariance = np.eye(4), np.zeros((6, 6))
    for step in seen:
        T, covariance = T @ step.T_before_now, covariance + step.covariance
    return StretchStep(T, covariance, np.zeros((6, N_SHARED)))
