"""What travels along with the vehicle: a van ahead at its speed, lorries beside and behind, a trailer, spray.

Such things keep their place relative to the vehicle while the ground passes. So do walls, hedges and tunnels along the
way, for one piece of them looks like the next. Two questions tell them apart, asked to range images of earlier sweeps
and of the newest one (`co_moving_kernels`): is the place free now where the thing lay then? Was the place free then
where it lies now? A wall is still there, and was already there. Asked for ways of 1 to 11 m, for the middle of a
lorry's side is a wall until the lorry has passed it.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F32, F64
from gnd.gnd_map.se3 import T_inverse
from gnd.vehicle_agent.localise.co_moving_kernels import COLUMNS, MIN_PASSED, ROWS, compare, draw_sweep, grown

Mask = NDArray[np.bool_]
U8 = NDArray[np.uint8]

LAGS_M: Final = (1.0, 1.7, 2.6, 4.3, 6.6, 11.0)
"""Ways to earlier sweeps, none a multiple of another: posts of a fence are not mistaken for one that travels along."""
LEAST_M, REACH_M = 0.7, 14.0
"""Nearer and farther sweeps are not asked."""
EVERY_M: Final = 0.5
OLDEST_NS: Final = 4_000_000_000
LEAST_SWEEPS: Final = 3
REMEMBER_NS: Final = 1_000_000_000
REMEMBERED_M: Final = 0.6
SURE: Final = 6
SLOTS: Final = round(REACH_M / EVERY_M) + 3


class _KeptScan(NamedTuple):
    """An earlier sweep: where its image is, when, odometer and pose by odometry."""

    slot: int
    t_ns: int
    way_m: float
    T_odom_vehicle: F64


class CoMoving:
    """Feeds on sweeps in time order; a standing vehicle judges nothing, for there everything keeps its place.

    Remembers images of the last 14 m of way and 4 s: 6 MB.
    """

    def __init__(self, T_vehicle_lidar: F64) -> None:
        """Begin with the mount (4, 4)."""
        self._mount(T_vehicle_lidar)
        self._images = np.zeros((SLOTS, COLUMNS, ROWS), np.uint16)
        self._times_s = np.zeros((SLOTS, COLUMNS), np.float32)
        self._twists = np.zeros((SLOTS, 3))
        self._kept: list[_KeptScan] = []
        self._way_m, self._T_odom_vehicle, self._T_odom_before = 0.0, np.eye(4), np.eye(4)
        self._before_ns: int | None = None
        self._sure_m, self._sure_ns = np.empty((0, 3)), np.empty(0, np.int64)
        self.left_out = 0
        """Points so far."""

    def see(
        self,
        sweep_m: F32,
        t_offset_ns: NDArray[np.uint32],
        start_ns: int,
        t_ns: int,
        chosen: NDArray[np.int64],
        points_vehicle_m: F64,
        T_before_now: F64,
    ) -> Mask:
        """(K,) bool: which of the chosen points lie on what travels along.

        Args:
            sweep_m: (N, 3) float32 all points, LiDAR frame, as measured.
            t_offset_ns: (N,) uint32 their times after `start_ns`.
            start_ns: start of the sweep.
            t_ns: its reference time, later than that of the sweep before.
            chosen: (K,) the points that are asked about.
            points_vehicle_m: (K, 3) these in the vehicle frame at the reference time, sweep motion removed.
            T_before_now: (4, 4) motion since the reference time of the sweep before, by odometry.
        """
        self._advance(t_ns, T_before_now)
        slot = self._free_slot()
        self._images[slot], self._times_s[slot] = draw_sweep(
            np.ascontiguousarray(sweep_m), t_offset_ns, t_ns - start_ns, self._T_vehicle_lidar
        )
        then = self._earlier()
        result = np.zeros(len(chosen), np.bool_)
        if len(then) >= LEAST_SWEEPS:
            votes = compare(
                np.ascontiguousarray(sweep_m[chosen]), np.ascontiguousarray(points_vehicle_m), slot,
                *self._motions(then, t_ns), self._images, self._times_s, self._twists,
                self._T_vehicle_lidar, self._T_lidar_vehicle,
            )  # fmt: skip
            result = self._things(t_ns, points_vehicle_m, votes)
        if not self._kept or self._way_m - self._kept[-1].way_m >= EVERY_M:
            self._kept.append(_KeptScan(slot, t_ns, self._way_m, self._T_odom_vehicle))
        self.left_out += int(result.sum())
        return result

    def _things(self, t_ns: int, points_m: F64, votes: tuple[U8, U8, U8]) -> Mask:
        """(K,) bool: points on what travels along; what seemed to a moment ago, at the same place, counts too."""
        young = t_ns - self._sure_ns <= REMEMBER_NS
        self._sure_m, self._sure_ns = self._sure_m[young], self._sure_ns[young]
        certain = np.full((3, len(self._sure_m)), [[SURE], [SURE], [0]], np.uint8)
        all_votes = [np.concatenate(pair) for pair in zip(votes, certain, strict=True)]
        result = grown(np.concatenate([points_m, self._sure_m]), *all_votes)[: len(points_m)]
        self._remember(t_ns, points_m[(votes[1] >= MIN_PASSED) & (votes[2] <= votes[1])])
        return result

    def _remember(self, t_ns: int, sure_m: F64) -> None:
        """Keep one point in each cube, the newest."""
        p = np.concatenate([sure_m, self._sure_m])
        ns = np.concatenate([np.full(len(sure_m), t_ns), self._sure_ns])
        i, j, k = np.floor(p / REMEMBERED_M).astype(np.int64).T
        newest = np.unique((i * 1024 + j) * 1024 + k, return_index=True)[1]
        self._sure_m, self._sure_ns = p[newest], ns[newest]

    def correct(self, T_before_now: F64) -> None:
        """Put in what is known better by now of the motion (4, 4) before the newest sweep: wheels slip."""
        self._T_odom_vehicle = self._T_odom_before @ T_before_now
        if self._kept and self._kept[-1].t_ns == self._before_ns:
            self._kept[-1] = self._kept[-1]._replace(T_odom_vehicle=self._T_odom_vehicle)

    def remounted(self, T_vehicle_lidar: F64) -> None:
        """Begin anew with another mount (4, 4)."""
        self._mount(T_vehicle_lidar)
        self.forget()

    def _mount(self, T_vehicle_lidar: F64) -> None:
        self._T_vehicle_lidar = np.ascontiguousarray(T_vehicle_lidar, dtype=np.float64)
        self._T_lidar_vehicle = np.ascontiguousarray(T_inverse(self._T_vehicle_lidar))

    def forget(self) -> None:
        """Begin anew: the next sweep does not continue those before."""
        self._kept, self._before_ns = [], None
        self._sure_m, self._sure_ns = np.empty((0, 3)), np.empty(0, np.int64)

    def _advance(self, t_ns: int, T_before_now: F64) -> None:
        dt_s = 0.0 if self._before_ns is None else (t_ns - self._before_ns) * 1e-9
        self._before_ns = t_ns
        self._T_odom_before = self._T_odom_vehicle
        self._T_odom_vehicle = self._T_odom_before @ T_before_now
        self._way_m += float(np.hypot(T_before_now[0, 3], T_before_now[1, 3]))
        self._kept = [k for k in self._kept if t_ns - k.t_ns <= OLDEST_NS and self._way_m - k.way_m <= REACH_M]
        turned_rad = np.arctan2(T_before_now[1, 0], T_before_now[0, 0])
        moved = np.array([T_before_now[0, 3], T_before_now[1, 3], turned_rad])
        self._twists[self._free_slot()] = moved / dt_s if dt_s > 0.0 else 0.0

    def _free_slot(self) -> int:
        """The first one that no kept sweep has."""
        taken = {k.slot for k in self._kept}
        return next(slot for slot in range(SLOTS) if slot not in taken)

    def _earlier(self) -> list[_KeptScan]:
        """The sweeps that lie nearest to the ways, each once, the farthest first."""
        found: dict[int, _KeptScan] = {}
        way_m = self._way_m - np.array([k.way_m for k in self._kept])
        for lag_m in reversed(LAGS_M) if len(way_m) else ():
            off_m = np.abs(way_m - lag_m)
            nearest = int(off_m.argmin())
            if way_m[nearest] >= LEAST_M:
                found.setdefault(nearest, self._kept[nearest])
        return list(found.values())

    def _motions(self, then: list[_KeptScan], t_ns: int) -> tuple[NDArray[np.int64], F64, F64, F64]:
        """Slots and ages [s] of earlier sweeps, and the motion since then and back."""
        T_now_odom = T_inverse(self._T_odom_vehicle)
        T_now_then = np.stack([T_now_odom @ k.T_odom_vehicle for k in then])
        ages_s = np.array([(t_ns - k.t_ns) * 1e-9 for k in then])
        return np.array([k.slot for k in then], np.int64), ages_s, T_now_then, T_inverse(T_now_then)
