"""Is there a better pose than the tracked one? Rivals are searched now and then, followed beside it, and judged."""

from dataclasses import replace
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.localise.first_pose import INITIALISE_FAIR_FIT, INITIALISE_GOOD_FIT, SearchPlace
from gnd.vehicle_agent.localise.hypotheses import (
    HYPOTHESIS_APART_DEG,
    HYPOTHESIS_APART_M,
    HYPOTHESIS_LEAST_SCANS,
    HYPOTHESIS_VIEW_M,
    PoseHypotheses,
)
from gnd.vehicle_agent.localise.initialise import (
    AROUND_POSITION,
    HYPOTHESIS_GAIN,
    INITIALISE_MIN_FIT,
    INITIALISE_N_REFINING,
    Around,
    near_pose,
    search,
    thinned,
)
from gnd.vehicle_agent.localise.match_map import MatchMap
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.localise.registration import fit_of

_PERIOD_S: Final = 2.0
_DOUBTFUL_S: Final = 0.8
"""Pause between two searches, and when the pose is in doubt."""
_TURN_DEG: Final = 12.0
"""Headings within this of the tracked one."""
_N_REFINED: Final = 5
"""How many are refined."""
_LEAD: Final = 0.03
"""A rival must fit better by this much to be one."""
_PRIOR: Final = 6.0
"""How much likelier the tracked pose is before anything is seen."""
_MOST_VIEWS: Final = 8.0
"""How many views may be against it."""
_CONTESTED: Final = -2.0
_BEATEN: Final = 4.0
_DROPPED: Final = -12.0
"""Odds of a rival from which on the tracked pose is degraded, is lost, and below which the rival is given up. All odds
are logarithms."""
_NEAR_M: Final = 1.0
_NEAR_DEG: Final = 3.0
"""A rival nearer than this must fit well to win."""


class Challenger:
    """Follows rivals of the tracked pose: poses elsewhere, consistent with GNSS, that fit better.

    The tracked pose has been right so far, so a rival must make up for that: where a facade has moved, a pose
    decimetres off fits better for some metres.
    """

    def __init__(self, parameters: LocaliserParameters) -> None:
        self._par = parameters
        self._how = replace(AROUND_POSITION, n_refined=_N_REFINED, n_kept=_N_REFINED)
        self.rivals = PoseHypotheses(parameters.registration, _MOST_VIEWS)
        self._searched_ns = -(2**62)
        self.searched = False
        """With the newest view."""
        self._T_tracked = np.eye(4)
        self._way_m = 0.0
        self._own_fits: list[tuple[float, float]] = []  # since there are rivals: fit, share of a view

    def see(
        self, t_ns: int, points_m: F64, standing_m: F64, T_tracked: F64, T_before_now: F64, place: SearchPlace,
        match_map: MatchMap, *, doubtful: bool, new: bool, any_heading: bool = False,
    ) -> None:  # fmt: skip
        """Take a view with its tracked pose (4, 4); search when it is time, sooner when the pose is `doubtful`.

        `points_m` (N, 3) and those that stand above the ground in the vehicle frame; `T_before_now` (4, 4) the motion
        since the one before; `place` to search around; `new`: not the view before seen again;
        `any_heading`: the heading is in doubt too.
        """
        self._T_tracked, self.searched = T_tracked, False
        self.rivals.move(T_before_now)
        self._way_m += float(np.hypot(*T_before_now[:2, 3]))
        if len(self.rivals) and new:
            self._weigh(points_m, standing_m, T_tracked, match_map)
        if t_ns - self._searched_ns >= (_DOUBTFUL_S if doubtful and not any_heading else _PERIOD_S) * 1e9:
            self._searched_ns, self.searched = t_ns, True
            turn_rad = np.pi if any_heading else np.radians(_TURN_DEG)
            self._search(points_m, standing_m, T_tracked, _around(place, T_tracked, turn_rad), match_map)

    def rest(self, t_ns: int) -> None:
        """All around has just been searched: wait for the next time."""
        self._searched_ns = t_ns

    @property
    def odds(self) -> float:
        """Logarithm of how much likelier the best rival is than the tracked pose; -inf without one."""
        if not len(self.rivals):
            return -np.inf
        best = self.rivals.best
        ahead = best.mean_fit - self._own_mean()
        return float(HYPOTHESIS_GAIN * best.views * ahead - best.surprise - _PRIOR)

    @property
    def contested(self) -> bool:
        """True when a rival makes the tracked pose doubtful."""
        return self.odds > _CONTESTED and self.rivals.best.mean_fit >= INITIALISE_MIN_FIT

    @property
    def beaten(self) -> bool:
        """True when a rival has won: one nearby only if it fits well, because a facade that has moved looks like it."""
        if self.odds <= _BEATEN:
            return False
        best = self.rivals.best
        near = near_pose(best.T_map_vehicle[None], self._T_tracked, _NEAR_M, _NEAR_DEG)[0]
        least = INITIALISE_GOOD_FIT if near else INITIALISE_FAIR_FIT
        return bool(best.scans >= HYPOTHESIS_LEAST_SCANS and best.mean_fit >= least)

    def _weigh(self, points_m: F64, standing_m: F64, T_tracked: F64, match_map: MatchMap) -> None:
        self.rivals.weigh(points_m, standing_m, match_map)
        self.rivals.drop_near(T_tracked)
        if not len(self.rivals):
            self._own_fits.clear()
            return
        share, self._way_m = min(1.0, self._way_m / HYPOTHESIS_VIEW_M), 0.0
        self._take_own(standing_m, T_tracked, match_map, share)
        if self.odds < _DROPPED:
            self.rivals.clear()
            self._own_fits.clear()

    def _search(self, points_m: F64, standing_m: F64, T_tracked: F64, around: Around, match_map: MatchMap) -> None:
        par, own = self._par, self._fit(standing_m, T_tracked, match_map)
        found, _ = search(points_m, around, match_map, self._how, par.registration, standing_m)
        apart = HYPOTHESIS_APART_M, HYPOTHESIS_APART_DEG
        rivals = [
            one
            for one in found
            if one.fit > own + _LEAD and not near_pose(one.registration.T_map_vehicle[None], T_tracked, *apart)[0]
        ]
        if rivals and not self._own_fits:
            self._own_fits.append((own, 1.0))
            self._way_m = 0.0
        self.rivals.add(rivals)

    def _take_own(self, standing_m: F64, T_tracked: F64, match_map: MatchMap, new: float) -> None:
        self._own_fits.append((self._fit(standing_m, T_tracked, match_map), max(new, 0.05)))
        if len(self._own_fits) > 200:
            del self._own_fits[0]

    def _own_mean(self) -> float:
        """Mean fit of the tracked pose over the views of the best rival."""
        left, total, weight = self.rivals.best.views, 0.0, 0.0
        for fit, share in reversed(self._own_fits):
            take = min(share, left)
            total, weight, left = total + take * fit, weight + take, left - take
            if left <= 0.0:
                break
        return total / max(weight, 1e-9)

    def _fit(self, standing_m: F64, T: F64, match_map: MatchMap) -> float:
        few = thinned(standing_m, INITIALISE_N_REFINING)
        return fit_of(few, T, match_map, self._par.registration)


def _around(place: SearchPlace, T_tracked: F64, turn_rad: float) -> Around:
    return Around(place.p_map_m, place.reach_m, float(np.arctan2(T_tracked[1, 0], T_tracked[0, 0])), turn_rad)
