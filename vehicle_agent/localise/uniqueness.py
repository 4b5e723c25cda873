"""Is the tracked pose the only one that explains what was seen? Slots, pillars and tunnel segments repeat.

A pose that fits well proves nothing where another one fits as well. What the vehicle has seen over the last metres,
placed by odometry, is laid on the map at the tracked pose and at every other one that GNSS allows, and the poses are
compared patch by patch: the points of one car are one piece of evidence. If two poses were equally right, differences
d of their fits would be as likely positive as negative, whatever has changed in the world since, and

    z = sum(d) / sqrt(sum(d^2))

would exceed z with a probability below exp(-z^2 / 2) (Efron 1969, Student's t-test under symmetry conditions). Only a
pose that beats each other one by that measure is *proven*. Odometry carries a proof on, through a smooth tunnel for
instance; a gap takes it away, and so does a pose elsewhere that wins.
"""

from collections import deque
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64, numbered_rows
from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3, transform
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.localise.first_pose import SearchPlace
from gnd.vehicle_agent.localise.initialise import AROUND_POSITION, INITIALISE_N_REFINING, Around, search, thinned
from gnd.vehicle_agent.localise.kernels import point_fits
from gnd.vehicle_agent.localise.match_map import MatchMap
from gnd.vehicle_agent.localise.parameters import LocaliserParameters, RegistrationParameters
from gnd.vehicle_agent.localise.registration import REGISTRATION_GATE_PER_SCALE, Start, register

_WAY_M: Final = 25.0
_EVERY_M: Final = 0.7
_N_POINTS: Final = 300
"""The view is of the scans of so much way, one every so many metres, of each so many points."""
_N_COMPARED: Final = 2000
"""Points of the view by which poses are compared."""
_PATCH_M: Final = 2.0
"""Points of one square of this side are one piece of evidence, and fewer than `full_points` of them a smaller one."""
_FULL_POINTS: Final = 8
_HIGH_M: Final = 2.2
"""Above the vehicle's origin; no car is so high."""
_UNPROVEN_M: Final = 3.0
_PROVEN_M: Final = 20.0
"""Way between two tests."""
_REACH_M: Final = 7.5
"""Around the tracked pose without GNSS."""
_TURN_DEG: Final = 10.0
"""Headings within this of the tracked one, all as long as less than `course_m` have been driven."""
_COURSE_M: Final = 8.0
_N_REFINED: Final = 16
_N_KEPT: Final = 8
"""Other poses tried by registration, and kept."""
_APART_M: Final = 0.4
_APART_DEG: Final = 1.5
"""Two poses nearer are one."""
_BESIDE_M: Final = 1.5
"""So far along and across from the tracked pose others are tried that a search might leave out."""
_WON: Final = 2.5
_WON_AT_ONCE: Final = 5.0
"""By how many sigmas the pose must beat each other one to be proven: three times in a row, or at once."""
_LOST: Final = 3.0
"""By how many it must be beaten, twice in a row, to be no longer so."""

FARTHEST_M: Final = 60.0  # a far point is moved by more than a patch when odometry turns by a degree or two
WON_IN_A_ROW: Final = 3
LEAST_SQUARES: Final = 0.25  # added to sum(d^2): where next to nothing differs, nothing is decided
CONSTRAINED: Final = (
    1.0  # sigmas by which poses a little before and behind must fit worse: the map constrains the place along
)
SEEN_BY: Final = 0.3  # least way between two fixes that are remembered, as share of the view


class _SeenScan(NamedTuple):
    """What one scan saw: odometer [m], pose (4, 4) and standing points (K, 3) in its own frame."""

    way_m: float
    T_odom_vehicle: F64
    points_m: F64


class _Fix(NamedTuple):
    """GNSS: odometer [m], where odometry was (3,), where the fix was (3,) in the map, how far it may be off [m]."""

    way_m: float
    p_odom_m: F64
    p_map_m: F64
    reach_m: float


class ScanView:
    """Standing points of the last metres of way, and the GNSS fixes on it, in a frame that odometry carries on.

    Place and heading are odometry's; height and tilt are those of the tracked poses, which the road gives and odometry
    does not.
    """

    def __init__(self, way_m: float, every_m: float, n_points: int) -> None:
        self._reach_m, self._every_m, self._n_points = way_m, every_m, n_points
        self.way_m = 0.0
        self._T: F64 | None = None  # newest, odometry's frame
        self._seen: deque[_SeenScan] = deque()
        self._fixes: deque[_Fix] = deque()

    def push(self, standing_m: F64, T_before_now: F64, T_tracked: F64) -> None:
        """Take a scan: standing points (K, 3) in the vehicle frame, motion (4, 4) since the one before, tracked pose
        (4, 4).
        """
        moved = T_tracked if self._T is None else self._T @ T_before_now
        turn = _yaw(moved) - _yaw(T_tracked)
        self._T = T_from_R_t(exp_so3(np.array([0.0, 0.0, turn])) @ T_tracked[:3, :3], [*moved[:2, 3], T_tracked[2, 3]])
        self.way_m += float(np.hypot(*T_before_now[:2, 3]))
        if not self._seen or self.way_m - self._seen[-1].way_m >= self._every_m:
            self._seen.append(_SeenScan(self.way_m, self._T, thinned(standing_m, self._n_points)))
        while self.way_m - self._seen[0].way_m > self._reach_m:
            self._seen.popleft()
        while self._fixes and self.way_m - self._fixes[0].way_m > self._reach_m:
            self._fixes.popleft()

    def see_position(self, p_map_m: F64, reach_m: float) -> None:
        """Take the GNSS position now: (3,) in the map, and how far it may be off."""
        if self._T is None:
            return
        if len(self._fixes) > 1 and self._fixes[-1].way_m - self._fixes[-2].way_m < SEEN_BY * self._reach_m:
            self._fixes.pop()
        self._fixes.append(_Fix(self.way_m, self._T[:3, 3].copy(), np.asarray(p_map_m, np.float64), reach_m))

    @property
    def points_m(self) -> F64:
        """(N, 3) of all scans, newest vehicle frame, newest first."""
        if self._T is None:
            return np.empty((0, 3))
        T_now_odom = T_inverse(self._T)
        seen = [transform(T_now_odom @ one.T_odom_vehicle, one.points_m) for one in reversed(self._seen)]
        points = np.concatenate(seen)
        return points[np.hypot(points[:, 0], points[:, 1]) < FARTHEST_M]

    @property
    def place(self) -> tuple[F64, float] | None:
        """The newest GNSS position moved on to now, (3,), odometry since then added as a reach; or None."""
        if not self._fixes or self._T is None:
            return None
        fix = self._fixes[-1]
        return fix.p_map_m, fix.reach_m + float(np.hypot(*(self._T[:2, 3] - fix.p_odom_m[:2])))

    def allowed(self, T_map_vehicle: F64, T_tracked: F64) -> bool:
        """True when GNSS allows the pose (4, 4), or is no farther from it than from the tracked one."""
        if self._T is None:
            return True
        for fix in self._fixes:
            p = transform(T_inverse(self._T), fix.p_odom_m[None])
            off, own = (float(np.hypot(*(transform(T, p)[0] - fix.p_map_m)[:2])) for T in (T_map_vehicle, T_tracked))
            if off > max(fix.reach_m, own):
                return False
        return True


class Uniqueness:
    """Compares the tracked pose with all others; `proven` when it has won once, and none has won since."""

    def __init__(self, parameters: LocaliserParameters) -> None:
        self._par, self._registration = parameters.uniqueness, parameters.registration
        par = self._par
        self._how = replace(
            AROUND_POSITION,
            n_refined=_N_REFINED,
            n_kept=_N_KEPT,
            same_m=_APART_M,
            same_deg=_APART_DEG,
        )
        self.proven = not par.enabled
        self.margin = 0.0
        """Sigmas by which the tracked pose was ahead of the best other one at the last test."""
        self.tested = False
        """Whether a scan was since this was set to False."""
        self._view = ScanView(_WAY_M, _EVERY_M, _N_POINTS)
        self._beaten = self._ahead = 0  # tests in a row
        self._next_m = 0.0  # odometer of the next test
        self._tested_m = self._constrained_m = (
            0.0  # odometer of the last test, and of the last that told the place along
        )

    def distrust(self, *, moved: bool) -> None:
        """The pose must be proven again; `moved`: odometry does not know either how it has come here."""
        if not self._par.enabled:
            return
        if self.proven:
            self.proven, self._ahead, self._beaten, self._next_m = False, 0, 0, self._view.way_m
        if moved:
            self._view = ScanView(_WAY_M, _EVERY_M, _N_POINTS)
            self._next_m = _EVERY_M
            self._tested_m = self._constrained_m = 0.0

    def see(
        self, standing_m: F64, T_before_now: F64, T_tracked: F64, place: SearchPlace | None, match_map: MatchMap,
        *, believed: bool = True,
    ) -> None:  # fmt: skip
        """Take a scan; test the pose if it is time.

        Args:
            standing_m: (K, 3) points that stand above the ground, vehicle frame.
            T_before_now: (4, 4) motion since the one before.
            T_tracked: (4, 4) the tracked pose.
            place: a new GNSS position.
            match_map: the map window.
            believed: whether the scan's match is; what is not matched is not compared.
        """
        if not self._par.enabled:
            return
        self._view.push(standing_m, T_before_now, T_tracked)
        if place is not None:
            self._view.see_position(place.p_map_m, place.reach_m)
        if believed and self._view.way_m >= self._next_m:
            self._tested_m, self.tested = self._view.way_m, True
            self.margin = self._tested(T_tracked, match_map)
            self._conclude()

    @property
    def unconstrained_m(self) -> float:
        """Way since the map last constrained the place along it: in a smooth tunnel odometry alone knows it."""
        return self._view.way_m - self._constrained_m if self._constrained_m < self._tested_m else 0.0

    @property
    def beaten(self) -> bool:
        """True when another pose was clearly better, twice in a row."""
        return self._beaten >= 2

    def _conclude(self) -> None:
        """A few metres of a place that repeats prove any pose now and then: the proof stands once three tests in a row
        agree, or one by far, and until the view is whole any other pose that is ahead by a sigma takes it away.
        """
        self._beaten = self._beaten + 1 if self.margin <= -_LOST else 0
        self._ahead = self._ahead + 1 if self.margin >= _WON else 0
        won = self._ahead >= WON_IN_A_ROW or self.margin >= _WON_AT_ONCE
        whole = self._view.way_m >= _WAY_M
        self.proven = (self.proven or won) and not self.beaten and (whole or self.margin >= -CONSTRAINED)
        steady = self.proven and whole and not self._beaten
        self._next_m = self._view.way_m + (_PROVEN_M if steady else _UNPROVEN_M)

    def _tested(self, T_tracked: F64, match_map: MatchMap) -> float:
        """Sigmas by which the tracked pose is ahead of each other one."""
        points = thinned(self._view.points_m, _N_COMPARED)
        own = self._registered(points, T_tracked, match_map, "near")
        if own is None:
            return 0.0
        if self._apart(own, T_tracked):
            own = T_tracked  # what it was drawn to is another pose
        patches, high = patches_of(points, _PATCH_M), points[:, 2] > _HIGH_M
        fits = self._fits(points, own, match_map)

        def least(others: list[F64]) -> float:
            against = [self._fits(points, T, match_map) for T in others]
            return min((ahead_of_both(fits - fit, patches, high, _FULL_POINTS) for fit in against), default=np.inf)

        along, across = (self._beside(points, own, match_map, axis) for axis in (0, 1))
        if least(along) >= CONSTRAINED:
            self._constrained_m = self._view.way_m
        others = [T for T in [*self._elsewhere(points, own, match_map), *along, *across] if self._view.allowed(T, own)]
        return least(others) if others else ahead(fits, patches, _FULL_POINTS)

    def _elsewhere(self, points: F64, own: F64, match_map: MatchMap) -> list[F64]:
        """Other poses (4, 4) around the GNSS position, as good as registration can make them."""
        place = self._view.place
        turn_rad = np.radians(_TURN_DEG) if self._view.way_m >= _COURSE_M else np.pi
        p_m, reach_m = (own[:3, 3], _REACH_M) if place is None else place
        around = Around(p_m, reach_m, _yaw(own), turn_rad)
        found, _ = search(points, around, match_map, self._how, self._registration, points)
        poses = [one.registration.T_map_vehicle for one in found]
        return [T for T in poses if self._apart(T, own)]

    def _beside(self, points: F64, own: F64, match_map: MatchMap, axis: int) -> list[F64]:
        """The same from a little before and behind (axis 0), or to the left and right (1): a search may leave them out,
        and where the map does not constrain the place along that axis, they stay there.
        """
        poses = []
        for side_m in (_BESIDE_M, -_BESIDE_M):
            shift = np.zeros(3)
            shift[axis] = side_m
            poses.append(self._registered(points, own @ T_from_R_t(np.eye(3), shift), match_map, "wide"))
        return [T for T in poses if T is not None and self._apart(T, own)]

    def _apart(self, T: F64, own: F64) -> bool:
        off = T_inverse(own) @ T
        return bool(np.hypot(off[0, 3], off[1, 3]) > _APART_M or abs(_yaw(off)) > np.radians(_APART_DEG))

    def _registered(self, points: F64, T: F64, m: MatchMap, start: Start) -> F64 | None:
        try:
            return register(thinned(points, INITIALISE_N_REFINING), T, m, self._registration, start).T_map_vehicle
        except RegistrationError:
            return None

    def _fits(self, points: F64, T: F64, m: MatchMap) -> F64:
        return fits_at(points, T, m, self._registration)


def fits_at(points_m: F64, T_map_vehicle: F64, m: MatchMap, parameters: RegistrationParameters) -> F64:
    """(N,) how well each of points (N, 3) lies on the map at a pose (4, 4): 1 - robust cost, 0 ... 1; 0 where it is
    not known.
    """
    fits, scale = np.empty(len(points_m)), parameters.rules.scales[-1]
    R, t = np.ascontiguousarray(T_map_vehicle[:3, :3]), np.ascontiguousarray(T_map_vehicle[:3, 3])
    gate_m2 = (REGISTRATION_GATE_PER_SCALE * scale) ** 2
    point_fits(
        np.ascontiguousarray(points_m), R, t, m.index, m.A, m.b, m.mean_m, m.information, scale**2, gate_m2, fits
    )
    return fits


def patches_of(points_m: F64, side_m: float) -> I64:
    """(N,) number of the square of the ground that each of points (N, 3) stands on."""
    square = np.floor(points_m[:, :2] / side_m).astype(np.int64)
    return numbered_rows(square)


def ahead(difference: F64, patches: I64, full_points: int) -> float:
    """By how many sigmas a pose is ahead of another.

    Args:
        difference: (N,) fit of each point at the one less that at the other.
        patches: (N,) which piece of evidence each point belongs to, from 0.
        full_points: a patch with fewer counts for less.
    """
    if not len(difference):
        return 0.0
    count = np.maximum(np.bincount(patches), 1)
    d = np.bincount(patches, difference) / count * np.minimum(count / full_points, 1.0)
    return float(d.sum() / np.sqrt((d**2).sum() + LEAST_SQUARES))


def ahead_of_both(difference: F64, patches: I64, high: NDArray[np.bool_], full_points: int) -> float:
    """By how many sigmas a pose is ahead of another, by all points or by the `high` (N,) ones, whichever are clearer.

    What stands higher than a car stays where it is: where many cars have left, they only add noise to what a few lamps
    know.
    """
    by_all = ahead(difference, patches, full_points)
    by_high = ahead(difference[high], patches[high], full_points)
    return by_high if abs(by_high) > abs(by_all) else by_all


def _yaw(T: F64) -> float:
    return float(np.arctan2(T[1, 0], T[0, 0]))
