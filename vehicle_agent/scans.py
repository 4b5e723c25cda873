"""Scans that cannot be used are named, counted and left out; the drive goes on."""

from collections import Counter

import numpy as np

from gnd.gnd_map.arrays import F32
from gnd.schemas.drive import DriveItem, GnssFix, MotionSample, Scan
from gnd.vehicle_agent.errors import BadScan

MIN_POINTS = 50
MIN_FINITE = 0.5  # share of the points
MIN_SPREAD_M = 0.5  # a sensor that repeats one value shows less
SAMPLE = 1000  # points that usually settle it


def check_points(points_m: F32, t_ns: int) -> None:
    """Refuse the points (N, 3) of a scan at `t_ns` that hold no information.

    Raises:
        BadScan: `empty` (too few points), `not-finite` (mostly NaN) or `constant` (all points in one place).
    """
    n = len(points_m)
    if n < MIN_POINTS:
        raise BadScan("empty", f"scan at {t_ns} ns has {n} points, {MIN_POINTS} are needed")
    bad = points_m.size - int(np.count_nonzero(np.isfinite(points_m)))
    if bad > (1 - MIN_FINITE) * points_m.size:
        raise BadScan("not-finite", f"scan at {t_ns} ns: {bad} of {points_m.size} coordinates are not finite")
    if spread_m(points_m[:: max(1, n // SAMPLE)]) < MIN_SPREAD_M and spread_m(points_m) < MIN_SPREAD_M:
        raise BadScan("constant", f"scan at {t_ns} ns: its {n} points lie within {MIN_SPREAD_M} m")


def spread_m(points_m: F32) -> float:
    """Longest side of the box around the points (N, 3), metres; what is not finite does not count."""
    finite = [x[np.isfinite(x)] for x in points_m.T]
    return max(float(np.ptp(x)) if len(x) else 0.0 for x in finite)


class Guard:
    """Lets through what can be used, in time order; counts the rest by its state in `bad`."""

    def __init__(self) -> None:
        self.bad: Counter[str] = Counter()
        self.last_problem = ""
        self._newest_ns: dict[type, int] = {}

    def admits(self, item: DriveItem) -> bool:
        """Whether the vehicle can work with an item; if not, it is counted."""
        try:
            self._check(item)
        except BadScan as problem:
            self.bad[problem.state] += 1
            self.last_problem = str(problem)
            return False
        self._newest_ns[type(item)] = item.t_ns
        return True

    def _check(self, item: DriveItem) -> None:
        newest_ns = self._newest_ns.get(type(item), -1)
        if isinstance(item, Scan | MotionSample | GnssFix) and item.t_ns <= newest_ns:
            what = type(item).__name__
            raise BadScan("time-backwards", f"{what} at {item.t_ns} ns comes after one at {newest_ns} ns")
        if isinstance(item, Scan):
            check_points(item.points_m, item.t_ns)
