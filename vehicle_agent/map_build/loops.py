"""Loops: where one pass meets what another pass saw, how the two lie to each other, and which of these to believe.

A loop is believed when the cloud of one anchor fits the map around another well, no other pose within what odometry
and GNSS leave open fits nearly as well, the match back gives the same, and a neighbouring loop agrees. A street that
repeats itself fails the second; that is no loss: a loop that is not closed leaves the poses as they were.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_inverse, log_so3
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.localise.initialise import AROUND_POSITION, Around, Candidate, near_pose, search
from gnd.vehicle_agent.localise.match_map import MatchMap
from gnd.vehicle_agent.localise.parameters import WITHOUT_WHEELS, RegistrationParameters
from gnd.vehicle_agent.localise.registration import register
from gnd.vehicle_agent.map_build.anchors import PoseAnchors

APART_M: Final = 60.0
"""Way between two anchors of one drive from which on they are two passes: their maps share no scan."""
NEAR_M: Final = 15.0
"""Passes that meet come this near; farther apart they see too little of the same."""
SAME_LEVEL_M: Final = 6.0
PARTNERS: Final = 2
"""Other passes that an anchor is matched with, the nearest ones."""
DRIFT_SHARE, DRIFT_M, OTHER_DRIVE_M = 0.01, 0.5, 3.0
"""One sigma of how two anchors lie to each other: of the way between them, at least; and of two drives."""
SIGMAS, LEAST_REACH_M, MOST_REACH_M, TURN_DEG = 3.0, 3.0, 20.0, 6.0
"""How far around the expected pose is searched."""
MIN_FIT, RIVAL = 0.4, 0.85
"""Least fit of what stands above the ground, and the share of it that another pose may reach."""
RIVAL_M, RIVAL_DEG = 1.0, 5.0
BACK_M, BACK_DEG = 0.15, 0.5
"""How far the match of the one on the other and of the other on the one may disagree."""
NEIGHBOUR_M: Final = 45.0
AGREE_M, AGREE_SHARE, AGREE_DEG = 0.2, 0.01, 1.0
"""How far a neighbouring loop may disagree: at least, of the way between, and in angle."""
FLOOR_M, FLOOR_RAD = 0.02, 1e-3

_REGISTRATION: Final = RegistrationParameters(rules=WITHOUT_WHEELS)
_SEARCH: Final = replace(AROUND_POSITION, step_m=1.5, step_deg=3.0, n_refined=12, n_kept=4)


@dataclass(frozen=True, slots=True, eq=False)
class Loop:
    """Anchor `late` as seen from anchor `early`: T_early_late (4, 4), and its (6, 6) covariance in the frame of `late`,
    rotation first.
    """

    early: int
    late: int
    T_early_late: F64
    covariance: F64
    fit: float


@dataclass(frozen=True, slots=True)
class LoopCounts:
    """What became of the pairs of anchors that were tried."""

    tried: int
    poor: int
    """Fitted badly, or matched nothing."""
    ambiguous: int
    """Fitted in two places."""
    one_way: int
    """The match back gave something else."""
    alone: int
    """No neighbouring loop agreed."""
    found: int


def pairs(anchors: PoseAnchors, T: F64) -> list[tuple[int, int]]:
    """(early, late) numbers of anchors of different passes that lie near each other, with the poses T (N, 4, 4)."""
    found = set[tuple[int, int]]()
    for late in range(len(anchors)):
        off = T[:, :3, 3] - T[late, :3, 3]
        distance = np.hypot(off[:, 0], off[:, 1])
        other = (anchors.drive != anchors.drive[late]) | (np.abs(anchors.way_m - anchors.way_m[late]) > APART_M)
        near = np.flatnonzero(other & (distance < _reach_of(anchors, late) + NEAR_M) & (np.abs(off[:, 2]) < 20.0))
        chosen: list[int] = []
        for k in near[np.argsort(distance[near], kind="stable")]:
            apart = [
                anchors.drive[k] != anchors.drive[c] or abs(anchors.way_m[k] - anchors.way_m[c]) > APART_M
                for c in chosen
            ]
            if all(apart) and len(chosen) < PARTNERS:
                chosen.append(int(k))
        found.update((min(k, late), max(k, late)) for k in chosen)
    return sorted(found)


def _reach_of(anchors: PoseAnchors, late: int) -> F64:
    """(N,) how much farther than it seems each anchor may be."""
    same = anchors.drive == anchors.drive[late]
    drift = DRIFT_SHARE * np.abs(anchors.way_m - anchors.way_m[late])
    return np.asarray(np.minimum(np.where(same, drift, OTHER_DRIVE_M), MOST_REACH_M - LEAST_REACH_M))


def sigma_between(anchors: PoseAnchors, early: int, late: int) -> float:
    """One sigma of how two anchors lie to each other before any loop is closed."""
    if anchors.drive[early] != anchors.drive[late]:
        return OTHER_DRIVE_M
    return max(DRIFT_M, DRIFT_SHARE * abs(float(anchors.way_m[late] - anchors.way_m[early])))


def find_loops(
    anchors: PoseAnchors,
    T: F64,
    tried: Sequence[tuple[int, int]],
    sigma_m: Callable[[int, int], float],
    progress: Callable[[int, int], None],
) -> tuple[list[Loop], LoopCounts]:
    """The loops among pairs of anchors that can be believed.

    Args:
        anchors: of all drives.
        T: (N, 4, 4) where they are thought to be.
        tried: of `pairs`.
        sigma_m: one sigma of how a pair lies to each other.
        progress: called with how many pairs are done, of how many.
    """
    found: list[Loop] = []
    fate = {"poor": 0, "ambiguous": 0, "one_way": 0}
    for done, (early, late) in enumerate(tried):
        loop = _loop(anchors, early, late, T_inverse(T[early]) @ T[late], sigma_m(early, late))
        if isinstance(loop, Loop):
            found.append(loop)
        else:
            fate[loop] += 1
        progress(done + 1, len(tried))
    believed = [loop for loop in found if _has_a_friend(loop, found, anchors, T)]
    counts = LoopCounts(len(tried), **fate, alone=len(found) - len(believed), found=len(believed))
    return believed, counts


def _loop(anchors: PoseAnchors, early: int, late: int, T_expected: F64, sigma_m: float) -> Loop | str:
    """The loop between two anchors, or why there is none."""
    target, cloud = anchors.map_of(early), anchors.cloud_of(late)
    if target is None or abs(T_expected[2, 3]) > SAME_LEVEL_M + 3 * sigma_m:
        return "poor"
    best, rival = _best_two(cloud, target, T_expected, sigma_m)
    if best is None or best.fit < MIN_FIT:
        return "poor"
    if rival > RIVAL * best.fit:
        return "ambiguous"
    try:
        result = register(cloud, best.registration.T_map_vehicle, target, _REGISTRATION)
    except RegistrationError:
        return "poor"
    back = _back(anchors, early, late, T_inverse(result.T_map_vehicle))
    if back is None or not within(apart(result.T_map_vehicle @ back, np.eye(4)), BACK_M, BACK_DEG):
        return "one_way"
    floor = np.diag([FLOOR_RAD**2] * 3 + [FLOOR_M**2] * 3)
    return Loop(early, late, result.T_map_vehicle, result.covariance + floor, best.fit)


def _best_two(cloud: F64, target: MatchMap, T_expected: F64, sigma_m: float) -> tuple[Candidate | None, float]:
    """The best match around the expected pose, and the fit of the best that is another answer (0 without one)."""
    reach_m = float(np.clip(SIGMAS * sigma_m, LEAST_REACH_M, MOST_REACH_M))
    heading = float(np.arctan2(T_expected[1, 0], T_expected[0, 0]))
    around = Around(T_expected[:3, 3], reach_m, heading, np.radians(TURN_DEG))
    candidates, _ = search(cloud, around, target, replace(_SEARCH, step_m=1.5 if reach_m > 6 else 1.0), _REGISTRATION)
    near = [c for c in candidates if _off_m(c.registration.T_map_vehicle, T_expected) < reach_m + 2.0]
    if not near:
        return None, 0.0
    T = np.stack([c.registration.T_map_vehicle for c in near])
    others = [c.fit for c, same in zip(near, near_pose(T, T[0], RIVAL_M, RIVAL_DEG), strict=True) if not same]
    return near[0], max(others, default=0.0)


def _off_m(T: F64, other: F64) -> float:
    return float(np.hypot(*(T[:2, 3] - other[:2, 3])))


def _back(anchors: PoseAnchors, early: int, late: int, T_late_early: F64) -> F64 | None:
    """The match of the early cloud on the late map, from what the match of the late on the early gave."""
    target = anchors.map_of(late)
    if target is None:
        return None
    try:
        return register(anchors.cloud_of(early), T_late_early, target, _REGISTRATION, "wide").T_map_vehicle
    except RegistrationError:
        return None


def _has_a_friend(loop: Loop, loops: Sequence[Loop], anchors: PoseAnchors, T: F64) -> bool:
    """Whether another loop of neighbouring anchors agrees, carried over by the poses between neighbours."""
    return any(_agree(loop, other, anchors, T) for other in _neighbours(loop, loops, anchors))


def _neighbours(loop: Loop, loops: Sequence[Loop], anchors: PoseAnchors) -> Iterator[Loop]:
    for other in loops:
        ends = ((loop.early, other.early), (loop.late, other.late))
        same_drives = all(anchors.drive[a] == anchors.drive[b] for a, b in ends)
        close = all(abs(anchors.way_m[a] - anchors.way_m[b]) < NEIGHBOUR_M for a, b in ends)
        if other is not loop and same_drives and close and loop.late != other.late:
            yield other


def _agree(loop: Loop, other: Loop, anchors: PoseAnchors, T: F64) -> bool:
    carried = T_inverse(T[loop.early]) @ T[other.early] @ other.T_early_late @ T_inverse(T[other.late]) @ T[loop.late]
    way_m = abs(float(anchors.way_m[loop.late] - anchors.way_m[other.late]))
    way_m += abs(float(anchors.way_m[loop.early] - anchors.way_m[other.early]))
    return within(apart(loop.T_early_late, carried), AGREE_M + AGREE_SHARE * way_m, AGREE_DEG)


def apart(T: F64, other: F64) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses."""
    step = T_inverse(T) @ other
    return float(np.linalg.norm(step[:3, 3])), float(np.linalg.norm(log_so3(step[:3, :3])))


def within(off: tuple[float, float], limit_m: float, limit_deg: float) -> bool:
    """Whether a distance [m] and an angle [rad] are both below their limits."""
    return off[0] < limit_m and off[1] < np.radians(limit_deg)
