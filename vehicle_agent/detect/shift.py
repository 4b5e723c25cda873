"""Could what seems to have changed be an error of the pose? Whether a common small shift lays scans onto the map.

A building site does not vanish under any shift of the whole scan, and what still stands around it gets worse. A pose
error does vanish: what did not fit fits then, and what fitted stays. So two hypotheses are compared voxel by voxel, at
the pose as it is and at the best pose nearby: a paired test, in which voxels are the samples. What a shift does not
change (ground under a shift along it, walls along a street) fits equally well under both and does not count; changed
voxels fit badly under both and do not count either.

The test says that a shift fits better, not which part of it does. A motion along a motorway changes nothing, and comes
along with any real gain across it. So directions that nothing constrains are left out of what registration finds, and
each other part of it must pass the paired test by itself.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3, log_so3
from gnd.vehicle_agent.detect.fit_kernel import point_costs
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.localise.kernels import LEVER_M as LEVER_M_OF_TURNS
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
_POINTS_AROUND: Final = 1000
"""So many points find out where the search from around the pose ends."""
_SAME_M: Final = 0.04
"""Ends nearer to each other, turns taken at `LEVER_M`, are one: half of the least shift that counts."""
LEVER_M: Final = 25.0
"""Distance at which turns are measured: 0.2 degrees move a point there by 9 cm."""
_REGISTRATION: Final = RegistrationParameters(rules=WITHOUT_WHEELS)
_LEVERS_M: Final = np.array([LEVER_M_OF_TURNS] * 3 + [1.0] * 3)
_PLANAR: Final = (2, 3, 4)
"""Heading, forward and left of a motion, turns first."""
_PART_M: Final = 0.01
"""Smaller parts are below what registration claims to know (`MatchRules.floor_m`)."""


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

    def costs(motion: F64) -> F64:
        after = costs_at(points, T_map_vehicle @ _moved(motion), match_map)
        return voxels.mean(np.where(after < 0.0, before, after))

    checked = any(_constrains(one) for one in found)
    motions = [_motion(T_inverse(T_map_vehicle) @ one.T_map_vehicle, one, planar=planar) for one in found]
    sums = [float(costs(motion).sum()) for motion in motions]
    if not sums or min(sums) >= float(was.sum()):
        return no_shift(voxels.n, misfits, checked=checked)
    best = int(np.argmin(sums))
    motion, dropped_m = _sure_parts(motions[best], _principal(found[best], planar=planar), costs)
    return _compared(_moved(motion), was, costs(motion), checked=checked and dropped_m < OF_SCANS.least_m)


def _sure_parts(motion: F64, directions: F64, costs: Callable[[F64], F64]) -> tuple[F64, float]:
    """A motion (6,) without the parts along unit directions (K, 6), the first one first, without which the costs (n,)
    of the voxels are not surely worse; and the largest part that was left out, metres.
    """
    dropped_m, now = 0.0, costs(motion)
    for direction in directions:
        part_m = float(direction @ motion)
        if abs(part_m) < _PART_M:
            continue
        without = motion - part_m * direction
        then = costs(without)
        if _z(then - now) < OF_SCANS.z:
            motion, now, dropped_m = without, then, max(dropped_m, abs(part_m))
    return motion, dropped_m


def _motion(T: F64, found: RegistrationResult, *, planar: bool) -> F64:
    """(6,) a shift as turns (times their lever) and metres, without what registration says nothing constrains."""
    motion = np.concatenate([log_so3(T[:3, :3]), T[:3, 3]]) * _LEVERS_M
    motion = motion - found.degenerate.T @ (found.degenerate @ motion)
    if planar:
        motion[[k for k in range(6) if k not in _PLANAR]] = 0.0
    return np.asarray(motion)


def _moved(motion: F64) -> F64:
    """(4, 4) of a motion (6,)."""
    xi = motion / _LEVERS_M
    return T_from_R_t(exp_so3(xi[:3]), xi[3:])


def _principal(found: RegistrationResult, *, planar: bool) -> F64:
    """(K, 6) the independent directions of a registration, the least constrained one first."""
    free = list(_PLANAR if planar else range(6))
    covariance = (found.covariance * _LEVERS_M * _LEVERS_M[:, None])[np.ix_(free, free)]
    directions = np.zeros((len(free), 6))
    directions[:, free] = np.linalg.eigh(covariance)[1].T[::-1]
    return directions


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
    """Where registration ends from the pose itself; and, if asked, with wide reach and from around it.

    Most of these descents end at one pose. A few points tell which do not, and only those are followed with all points.
    """
    found = [one for one in [_registered(points, T, match_map, "near")] if one is not None]
    if not wide:
        return found
    few = np.ascontiguousarray(points[:: max(1, len(points) // _POINTS_AROUND)])
    starts: list[tuple[F64, Start]] = [(T, "wide"), *((_beside(T, *step), "near") for step in _AROUND_M)]
    for start, reach in starts:
        about = _registered(few, start, match_map, reach)
        if about is None or any(_is_same(about, one) for one in found):
            continue
        one = _registered(points, about.T_map_vehicle, match_map, "near")
        if one is not None:
            found.append(one)
    return found


def _registered(points: F64, T: F64, match_map: MatchMap, reach: Start) -> RegistrationResult | None:
    try:
        return register(points, T, match_map, _REGISTRATION, reach)
    except RegistrationError:
        return None


def _is_same(about: RegistrationResult, found: RegistrationResult) -> bool:
    """Whether a few points ended where all points have ended from elsewhere."""
    return Shift(T_inverse(found.T_map_vehicle) @ about.T_map_vehicle, 0, 0, 0, 0, 0.0, True).size_m < _SAME_M


def _beside(T: F64, forward_m: float, left_m: float) -> F64:
    beside = T.copy()
    beside[:3, 3] += T[:3, :3] @ np.array([forward_m, left_m, 0.0])
    return beside


def _constrains(found: RegistrationResult) -> bool:
    """Whether heading and both horizontal directions are constrained (columns of `degenerate`: turns, then places)."""
    return not bool((np.abs(found.degenerate[:, 2:5]) > 0.5).any()) if len(found.degenerate) else True
