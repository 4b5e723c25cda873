"""Scans with final poses from the reference poses, with or without an error, in place of the vehicle's localiser."""

from collections import deque
from collections.abc import Iterator
from math import exp
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import exp_so3, transform
from gnd.schemas.drive import DriveHeader, DriveItem, ReferencePose, Scan
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.estimates import Cause, Health, PoseEstimate, RefinedScan
from gnd.vehicle_agent.packed_rays import PlacedRays
from studies.simulation.options import PoseSource

TIME_CONSTANT_S: Final = 2.0
_KEPT_NS: Final = 200_000_000


class FromReference:
    """The reference poses with an error of `source`, as if a localiser of that quality had run.

    The error is a first-order Gauss-Markov process with a time constant of 2 s, drawn at every reference pose:
    `sigma_m` on each horizontal axis and half of that in height, `sigma_rad` in heading and half of that in roll and
    pitch. The scan is deskewed on this trajectory and rests on it, so the error also moves within a sweep.
    """

    def __init__(self, header: DriveHeader, local_map: LocalMap, source: PoseSource, seed: int) -> None:
        self.online: PoseEstimate | None = None
        self._source = source
        self._T_vehicle_lidar = header.T_vehicle_lidar
        self._T_map_anchor = local_map.grid_frame.frame.T_self_other(header.anchor)
        self._rng = np.random.default_rng([seed, 0x905E])
        m, rad = source.sigma_m, source.sigma_rad
        self._sigma = np.array([m, m, m / 2, rad / 2, rad / 2, rad])
        self._error = np.zeros(6)
        self._poses: deque[tuple[int, F64]] = deque()
        self._waiting: deque[Scan] = deque()

    @property
    def state(self) -> tuple[Health, Cause]:
        """Health and cause now."""
        return ("lost", "searching") if self.online is None else (self.online.health, self.online.cause)

    def push(self, item: DriveItem) -> list[RefinedScan]:
        """Take a reference pose or a scan; a scan comes out when the poses reach its end."""
        if isinstance(item, Scan):
            self._waiting.append(item)
        elif isinstance(item, ReferencePose):
            self._add(item)
        return list(self._ready())

    def flush(self) -> Iterator[RefinedScan]:
        """Give what waits, if the poses reach it."""
        yield from self._ready(late_ns=100_000_000)

    def _add(self, pose: ReferencePose) -> None:
        T = self._T_map_anchor @ pose.T_map_vehicle
        if self._source.kind == "noisy":
            step_s = (pose.t_ns - self._poses[-1][0]) * 1e-9 if self._poses else np.inf
            keep = exp(-step_s / TIME_CONSTANT_S)
            drawn = self._sigma * self._rng.standard_normal(6)
            self._error = keep * self._error + np.sqrt(1.0 - keep * keep) * drawn
            T[:3, 3] += self._error[:3]
            T[:3, :3] = T[:3, :3] @ exp_so3(self._error[3:])
        self._poses.append((pose.t_ns, T))
        needed_ns = self._waiting[0].t_ns if self._waiting else pose.t_ns
        while self._poses[0][0] < needed_ns - _KEPT_NS:
            self._poses.popleft()

    def _ready(self, late_ns: int = 0) -> Iterator[RefinedScan]:
        while self._waiting and self._poses and self._poses[-1][0] + late_ns >= _end_ns(self._waiting[0]):
            yield self._refined(self._waiting.popleft())

    def _refined(self, scan: Scan) -> RefinedScan:
        known = Trajectory(np.array([t for t, _ in self._poses], np.int64), np.stack([T for _, T in self._poses]))
        t_ns = (scan.t_ns + _end_ns(scan)) // 2
        T = known.at(t_ns)
        finite = np.flatnonzero(np.isfinite(scan.points_m).all(axis=1))
        ends, starts = (
            deskew(points, scan.t_offset_ns[finite], scan.t_ns, known, self._T_vehicle_lidar, t_ns)
            for points in (scan.points_m[finite], np.zeros((len(finite), 3), np.float32))
        )
        self.online = PoseEstimate(t_ns, T, self._source.sigma_m, self._source.sigma_rad, 1.0, "good")
        return RefinedScan(t_ns, PlacedRays(transform(T, ends), transform(T, starts)), self.online)


def _end_ns(scan: Scan) -> int:
    return scan.t_ns + int(scan.t_offset_ns.max(initial=0))
