"""Scans that cannot be used are named, counted and left out; the drive goes on."""

from collections import Counter
from collections.abc import Iterable, Iterator

import numpy as np

from schemas.drive import DriveItem, GnssFix, MotionSample, Scan
from vehicle_agent.errors import BadScan

MIN_POINTS = 50
MIN_FINITE = 0.5  # share of the points
MIN_SPREAD_M = 0.5  # a sensor that repeats one value shows less


def check_scan(scan: Scan) -> None:
    """Refuse a scan without information.

    Raises:
        BadScan: `empty` (too few points), `not-finite` (mostly NaN) or `constant` (all points in one place).
    """
    n = len(scan.points_m)
    if n < MIN_POINTS:
        raise BadScan("empty", f"scan at {scan.t_ns} ns has {n} points, {MIN_POINTS} are needed")
    finite = np.isfinite(scan.points_m).all(axis=1)
    if finite.mean() < MIN_FINITE:
        raise BadScan("not-finite", f"scan at {scan.t_ns} ns: {n - int(finite.sum())} of {n} points are not finite")
    spread_m = float(np.ptp(scan.points_m[finite], axis=0).max())
    if spread_m < MIN_SPREAD_M:
        raise BadScan("constant", f"scan at {scan.t_ns} ns: all points lie within {spread_m:.3g} m")


class Guard:
    """Lets through what can be used, in time order; counts the rest by its state in `bad`."""

    def __init__(self) -> None:
        self.bad: Counter[str] = Counter()
        self.last_problem = ""
        self._newest_ns: dict[type, int] = {}

    def usable(self, items: Iterable[DriveItem]) -> Iterator[DriveItem]:
        """The items that the vehicle can work with."""
        for item in items:
            try:
                self._check(item)
            except BadScan as problem:
                self.bad[problem.state] += 1
                self.last_problem = str(problem)
                continue
            self._newest_ns[type(item)] = item.t_ns
            yield item

    def _check(self, item: DriveItem) -> None:
        newest_ns = self._newest_ns.get(type(item), -1)
        if isinstance(item, Scan | MotionSample | GnssFix) and item.t_ns <= newest_ns:
            what = type(item).__name__
            raise BadScan("time-backwards", f"{what} at {item.t_ns} ns comes after one at {newest_ns} ns")
        if isinstance(item, Scan):
            check_scan(item)
