"""The first pose: search around the GNSS position, follow the candidates, answer when one of them has won."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.localise.estimates import Cause
from gnd.vehicle_agent.localise.hypotheses import HYPOTHESIS_MOST_VIEWS, HYPOTHESIS_SURE, PoseHypotheses
from gnd.vehicle_agent.localise.initialise import AROUND_POSITION, INITIALISE_MIN_FIT, Around, InitialPose, search
from gnd.vehicle_agent.localise.match_map import MatchMap, MatchMapCache
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.localise.registration import REGISTRATION_MIN_MATCHED, register
from gnd.vehicle_agent.localise.scan_pool import ScanPool

INITIALISE_GOOD_FIT: Final = 0.65
INITIALISE_FAIR_FIT: Final = 0.48
"""A fit of `good_fit` is taken at once; one of `fair_fit` when it stays the best for some way: where much has changed,
a pose decimetres off can fit best, and a vehicle that moves soon sees something else."""
_RETRY_S: Final = 0.8
"""Pause between two searches for the first pose."""


@dataclass(frozen=True, slots=True, eq=False)
class SearchPlace:
    """GNSS position of the vehicle: (3,) in the map frame, one sigma of an axis, and how far it may be off."""

    p_map_m: F64
    sigma_m: float
    reach_m: float


class FirstPose:
    """The search for a pose while there is none; `cause`: why there is none yet."""

    def __init__(self, parameters: LocaliserParameters) -> None:
        self._par = parameters
        self.hypotheses = PoseHypotheses(parameters.registration)
        self.cause: Cause = "searching"
        self._pool = ScanPool()
        self._searched_ns = -(2**62)

    def see(
        self, t_ns: int, points_m: F64, T_before_now: F64, place: SearchPlace | None, maps: MatchMapCache
    ) -> InitialPose | None:
        """Take a scan; give the pose when it is sure.

        Args:
            t_ns: of the scan.
            points_m: (N, 3) sampled points, vehicle frame, sweep motion removed.
            T_before_now: (4, 4) the motion since the scan before.
            place: the vehicle's GNSS position now, None without one.
            maps: the map, linearised where it is needed.
        """
        new = self._pool.push(points_m, T_before_now)
        self.hypotheses.move(T_before_now)
        if place is None and not len(self.hypotheses):
            self.cause = "no_position"
            return None
        m = maps.near(self.hypotheses.best.T_map_vehicle[:3, 3] if place is None else place.p_map_m)
        if new or self._pool.stands:
            self.hypotheses.weigh(self._pool.points_m, self._pool.standing_m, m)
        if place is not None:
            self._look_around(t_ns, place, m)
        answer = self.hypotheses.answer()
        self.cause = self._why(answer, place, m, points_m)
        if answer is None or not self._good_enough(answer):
            return None
        return self._with_all_points(answer, points_m, m)

    def _look_around(self, t_ns: int, place: SearchPlace, match_map: MatchMap) -> None:
        """Search, now and then; what is followed is judged by the position too."""
        if t_ns - self._searched_ns >= _RETRY_S * 1e9:
            self._search(t_ns, place, match_map)
        self.hypotheses.see_position(place.p_map_m, place.sigma_m)

    def _search(self, t_ns: int, place: SearchPlace, match_map: MatchMap) -> None:
        self._searched_ns = t_ns
        around = Around(place.p_map_m, place.reach_m)
        points, standing = self._pool.points_m, self._pool.standing_m
        found, _ = search(points, around, match_map, AROUND_POSITION, self._par.registration, standing)
        self.hypotheses.add(found)

    def _good_enough(self, found: InitialPose) -> bool:
        """True for a clear answer that fits well; where much has changed only after some way on which it stayed so."""
        proven = self.hypotheses.best.views >= HYPOTHESIS_MOST_VIEWS
        return found.found and (found.fit >= INITIALISE_GOOD_FIT or (proven and found.fit >= INITIALISE_FAIR_FIT))

    def _why(self, answer: InitialPose | None, place: SearchPlace | None, match_map: MatchMap, points_m: F64) -> Cause:
        if answer is None and place is None:
            return "no_position"
        if len(points_m) < REGISTRATION_MIN_MATCHED:
            return "bad_scan"
        if answer is None:
            return "no_match" if _known_at(match_map, place) else "no_map"
        if answer.fit < INITIALISE_MIN_FIT:
            return "no_match"
        return "searching" if answer.probability >= HYPOTHESIS_SURE else "ambiguous"

    def _with_all_points(self, answer: InitialPose, points_m: F64, m: MatchMap) -> InitialPose | None:
        """The same answer, its pose refined once more with all points."""
        try:
            result = register(points_m, answer.registration.T_map_vehicle, m, self._par.registration)
        except RegistrationError:
            return None
        return replace(answer, registration=result)


def _known_at(m: MatchMap, place: SearchPlace | None) -> bool:
    """True when the map holds anything within reach of a place."""
    if place is None or not len(m):
        return False
    far = np.hypot(m.mean_m[:, 0] - place.p_map_m[0], m.mean_m[:, 1] - place.p_map_m[1])
    return bool((far < place.reach_m + 10.0).any())
