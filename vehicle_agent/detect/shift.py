"""Could what seems to have changed be an error of the pose? Whether a common small shift lays scans onto the map.

A building site does not vanish under any shift of the whole scan, and what still stands around it gets worse. A pose
error does vanish: what did not fit fits then, and what fitted stays. So two hypotheses are compared voxel by voxel, at
the pose as it is and at the best pose nearby: a paired test, in which voxels are the samples. What a shift does not
change (ground under a shift along it, walls along a street) fits equally well under both and does not count; changed
voxels fit badly under both and do not count either.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3, log_so3
from gnd.vehicle_agent.detect.fit_kernel import point_costs
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.localise.match_map import MatchMap
from gnd.vehicle_agent.localise.parameters import WITHOUT_WHEELS, RegistrationParameters
from gnd.vehicle_agent.localise.registration import RegistrationResult, Start, register

_GRID_M: Final = 1.0
"""Voxels are told apart on a plain grid of the map frame: which of them a point is in matters little here."""
_LEAST_POINTS: Final = 2
"""Of a voxel, before it counts."""
_LEAST_VOXELS: Final = 30
"""That count, before a shift could be found."""
_SCALE2: Final = 2.0**2
"""Of the robust cost, squared sigmas of a point."""
_MISFIT: Final = 0.5
"""Mean cost of a voxel's points above which it does not fit: points are off by two sigmas."""
_MANY_MISFITS: Final = 0.05
"""Share of voxels that do not fit from which on the search begins around the pose, too."""
_AROUND_M: Final = ((0.6, 0.0), (-0.6, 0.0), (0.0, 0.6), (0.0, -0.6))
"""Forward and left of the pose."""
LEVER_M: Final = 25.0
"""Distance at which turns are measured: 0.2 degrees move a point there by 9 cm."""
_REGISTRATION: Final = RegistrationParameters(rules=WITHOUT_WHEELS)


@dataclass(frozen=True, slots=True)
class ShiftTestRules:
    """When a shift counts as one.

    Attributes:
        least_m: smaller shifts are within what poses may be off by; so are turns that move a point at `LEVER_M` by
            less. At 10 cm detection begins to err (docs/decisions/0082-the-gate-on-the-vehicle.md).
        sigmas: poses that claim to be less certain may be off by so many of their sigmas ...
        loosest_m: ... but never by more than this.
        most_m: farther away is another place, not the error of a pose.
        z: how sure it must be that the map fits better after the shift, in sigmas of the paired test.
    """

    least_m: float
    sigmas: float
    loosest_m: float
    most_m: float
    z: float

    def limit_m(self, pose: PoseUncertainty) -> float:
        """How far a pose that is known so well may be off."""
        sigma_m = max(pose.sigma_m, LEVER_M * pose.sigma_rad)
        return float(np.clip(self.sigmas * sigma_m, self.least_m, self.loosest_m))


OF_SCANS: Final = ShiftTestRules(least_m=0.08, sigmas=3.0, loosest_m=0.15, most_m=5.0, z=3.0)
"""Of a stretch of scans, while driving."""


@dataclass(frozen=True, slots=True, eq=False)
class Shift:
    """The best pose nearby and what it does to the fit.

    Attributes:
        T: (4, 4) correction of the pose in the vehicle's axes: T_map_vehicle -> T_map_vehicle @ T.
        voxels: how many voxels counted.
        misfits: how many of them do not fit the map at the pose as it is.
        explained: how many of those fit after the shift.
        spoiled: how many that fitted do not fit after the shift.
        z: sum of what the voxels' costs fell by, over the root of the sum of its squares: how sure the gain is.
        checked: whether the map constrains place and heading here, so that a shift would have been found.
    """

    T: F64
    voxels: int
    misfits: int
    explained: int
    spoiled: int
    z: float
    checked: bool

    @property
    def shift_m(self) -> F64:
        """(3,) forward, left, up."""
        return np.asarray(self.T[:3, 3])

    @property
    def turn_rad(self) -> F64:
        """(3,) roll, pitch, yaw."""
        return np.asarray(log_so3(self.T[:3, :3]))

    @property
    def size_m(self) -> float:
        """The larger one of the shift and of what the turn moves at `LEVER_M`."""
        return float(max(np.linalg.norm(self.shift_m), LEVER_M * np.linalg.norm(self.turn_rad)))

    @property
    def explained_share(self) -> float:
        """Of what does not fit, less what the shift spoils, 0 ... 1."""
        return max(self.explained - self.spoiled, 0) / max(self.misfits, 1)

    def is_far(self, test: ShiftTestRules, pose: PoseUncertainty) -> bool:
        """Whether the best pose nearby is farther off than a pose known so well may be, surely better or not."""
        return test.limit_m(pose) <= self.size_m <= test.most_m

    def is_pose_error(self, test: ShiftTestRules, pose: PoseUncertainty) -> bool:
        """Whether the pose is off by more than a pose known so well may be, and surely so."""
        return self.is_far(test, pose) and self.z >= test.z


def no_shift(voxels: int = 0, misfits: int = 0, *, checked: bool = False) -> Shift:
    """The pose as it is."""
    return Shift(np.eye(4), voxels, misfits, 0, 0, 0.0, checked)


def find_shift(points_vehicle_m: F64, T_map_vehicle: F64, match_map: MatchMap, *, planar: bool = False) -> Shift:
    """The small shift under which points fit the map best, and how many voxels it explains and spoils.

    Args:
        points_vehicle_m: (N, 3) float64 points that stand still, in the frame of the vehicle at one moment of the
            stretch (those of other moments moved there as the poses say).
        T_map_vehicle: (4, 4) the pose that is asked about.
        match_map: the map there.
        planar: look for shifts in place and heading only: what a few layers see does not constrain height and tilt.

    Returns:
        The shift; the identity where nothing nearby fits better, or too little of the map is known.
    """
    points = np.ascontiguousarray(points_vehicle_m, np.float64)
    before = costs_at(points, T_map_vehicle, match_map)
    points, before = points[before >= 0.0], before[before >= 0.0]
    voxels = _Voxels.of(points, T_map_vehicle)
    if voxels.n < _LEAST_VOXELS:
        return no_shift(voxels.n)
    was = voxels.mean(before)
    misfits = int((was > _MISFIT).sum())
    found = _candidates(points, T_map_vehicle, match_map, wide=misfits >= _MANY_MISFITS * voxels.n)
    best = no_shift(voxels.n, misfits, checked=any(_constrains(one) for one in found))
    least = float(was.sum())
    for one in found:
        T = T_inverse(T_map_vehicle) @ one.T_map_vehicle
        T = _flat(T) if planar else T
        after = costs_at(points, T_map_vehicle @ T, match_map)
        now = voxels.mean(np.where(after < 0.0, before, after))
        if float(now.sum()) < least:
            least = float(now.sum())
            best = _compared(T, was, now, checked=best.checked)
    return best


def _flat(T: F64) -> F64:
    """Only forward, left and heading of a shift."""
    turn = np.array([0.0, 0.0, np.arctan2(T[1, 0], T[0, 0])])
    return T_from_R_t(exp_so3(turn), np.array([T[0, 3], T[1, 3], 0.0]))


def gain(points_vehicle_m: F64, T_before: F64, T_after: F64, match_map: MatchMap) -> float:
    """How much surer the points (N, 3) fit a map at one pose (4, 4) than at another: z of the paired test, above 0 for
    the pose after.
    """
    before, after = (costs_at(points_vehicle_m, T, match_map) for T in (T_before, T_after))
    known = (before >= 0.0) & (after >= 0.0)
    voxels = _Voxels.of(points_vehicle_m[known], T_before)
    if not voxels.n:
        return 0.0
    return _z(voxels.mean(before[known]) - voxels.mean(after[known]))


def _z(gains: F64) -> float:
    """Of the paired test: as far from 0 as so many sigmas, if the gains (n,) were as often losses."""
    return float(gains.sum() / max(np.sqrt((gains**2).sum()), 1e-9))


def costs_at(points: F64, T: F64, m: MatchMap) -> F64:
    """(N,) robust cost of each point (N, 3) at the pose T (4, 4) of its frame; below 0 where the map is not known."""
    cost, points = np.empty(len(points)), np.ascontiguousarray(points, np.float64)
    R, t = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
    point_costs(points, R, t, m.index, m.A, m.b, m.mean_m, m.information, _SCALE2, cost)
    return cost


def _compared(T: F64, was: F64, now: F64, *, checked: bool) -> Shift:
    """What a shift does to the costs (n,) of the voxels."""
    bad, still_bad = was > _MISFIT, now > _MISFIT
    return Shift(
        T=T,
        voxels=len(was),
        misfits=int(bad.sum()),
        explained=int((bad & ~still_bad).sum()),
        spoiled=int((still_bad & ~bad).sum()),
        z=_z(was - now),
        checked=checked,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Voxels:
    """Which voxel each point is in at the pose as it is; `weight` 0 for points in voxels with too few."""

    member: NDArray[np.int64]
    weight: F64
    per_voxel: F64
    n: int

    @classmethod
    def of(cls, points: F64, T: F64) -> "_Voxels":
        if not len(points):
            return cls(np.empty(0, np.int64), np.empty(0), np.empty(0), 0)
        g = np.floor((points @ T[:3, :3].T + T[:3, 3]) / _GRID_M).astype(np.int64)
        key = (g[:, 0] << 42) + (g[:, 1] << 21) + g[:, 2]
        _, member, count = np.unique(key, return_inverse=True, return_counts=True)
        kept = count >= _LEAST_POINTS
        number = np.where(kept, np.cumsum(kept) - 1, 0)
        return cls(number[member], kept[member].astype(np.float64), count[kept].astype(np.float64), int(kept.sum()))

    def mean(self, values: F64) -> F64:
        """(n,) mean of a value (N,) of the points, voxel by voxel."""
        return np.asarray(np.bincount(self.member, values * self.weight, self.n) / self.per_voxel)


def _candidates(points: F64, T: F64, match_map: MatchMap, *, wide: bool) -> list[RegistrationResult]:
    """Where registration ends from the pose itself; and, if asked, with wide reach and from around it."""
    starts: list[tuple[F64, Start]] = [(T, "near")]
    if wide:
        starts += [(T, "wide"), *((_beside(T, *step), "near") for step in _AROUND_M)]
    found = []
    for start, reach in starts:
        try:
            found.append(register(points, start, match_map, _REGISTRATION, reach))
        except RegistrationError:
            continue
    return found


def _beside(T: F64, forward_m: float, left_m: float) -> F64:
    beside = T.copy()
    beside[:3, 3] += T[:3, :3] @ np.array([forward_m, left_m, 0.0])
    return beside


def _constrains(found: RegistrationResult) -> bool:
    """Whether heading and both horizontal directions are constrained (columns of `degenerate`: turns, then places)."""
    return not bool((np.abs(found.degenerate[:, 2:5]) > 0.5).any()) if len(found.degenerate) else True
