"""How well movers are told from what stands: the simulator's labels beside the vehicle's decisions, as account only.

The vehicle never sees a label; they are compared with what it has already decided.
"""

from collections import Counter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.vehicle_agent.segment import SegmentedScan

COUNTS: Final = ("movers", "movers_left", "static", "static_lost")
"""Points on movers, of these taken for static, points on what stands, of these taken for movers."""


class MoverLabels:
    """Keeps the labels of each scan until it has been segmented.

    Attributes:
        counts: `COUNTS`, of points within the range of detection.
    """

    def __init__(self, range_m: float) -> None:
        self.counts: Counter[str] = Counter(dict.fromkeys(COUNTS, 0))
        self._range_m = range_m
        self._waiting: dict[int, NDArray[np.bool_]] = {}

    def take(self, t_ns: int, moving: NDArray[np.bool_]) -> None:
        """Keep the labels (N,) of the scan that begins at `t_ns`."""
        self._waiting[t_ns] = moving

    def compare(self, segmented: SegmentedScan) -> None:
        """Count right and wrong points of a scan; scans that the vehicle dropped before are forgotten."""
        begun = [t_ns for t_ns in self._waiting if t_ns <= segmented.scan.t_ns]
        labels = [self._waiting.pop(t_ns) for t_ns in begun][-1:]
        if not labels or len(labels[0]) != len(segmented.moving):
            return
        scan, said = segmented.scan, segmented.moving
        near = np.linalg.norm(scan.points_map_m - scan.origins_map_m, axis=1) <= self._range_m
        true, said = labels[0][near], said[near]
        found = (true.sum(), (true & ~said).sum(), (~true).sum(), (~true & said).sum())
        self.counts.update(dict(zip(COUNTS, map(int, found), strict=True)))
