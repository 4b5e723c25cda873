"""From no pose to the first: search where GNSS says, follow what was found, answer when one pose has won."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vehicle_agent.errors import RegistrationError
from vehicle_agent.localise.estimates import Cause
from vehicle_agent.localise.hypotheses import Hypotheses
from vehicle_agent.localise.initialise import Around, InitialPose, ground_below, search
from vehicle_agent.localise.match_map import MatchMap, MatchMapCache
from vehicle_agent.localise.parameters import LocaliserParameters
from vehicle_agent.localise.registration import register

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where GNSS says that the vehicle is: (3,) in the map frame, one sigma of an axis, and how far it may be off."""

    p_map_m: F64
    sigma_m: float
    reach_m: float


class FirstPose:
    """The search for a pose while there is none; `cause` says why there is none yet."""

    def __init__(self, parameters: LocaliserParameters) -> None:
        self._par = parameters
        self.hypotheses = Hypotheses(parameters.hypotheses, parameters.registration)
        self.cause: Cause = "searching"
        self._since_ns: int | None = None
        self._searched_ns = -(2**62)

    def see(
        self, t_ns: int, points_m: F64, T_before_now: F64, place: Place | None, maps: MatchMapCache
    ) -> InitialPose | None:
        """Take a scan; give the pose when it is sure.

        Args:
            t_ns: of the scan.
            points_m: (N, 3) sampled points, vehicle frame, sweep motion removed.
            T_before_now: (4, 4) the motion since the scan before.
            place: where GNSS says that the vehicle is now, None if it does not.
            maps: the map, linearised where it is needed.
        """
        if place is None and not len(self.hypotheses):
            self.cause = "no_position"
            return None
        at_m = self.hypotheses.best.T_map_vehicle[:3, 3] if place is None else place.p_map_m
        return self._see(t_ns, points_m, T_before_now, place, maps.near(at_m))

    def _see(
        self, t_ns: int, points_m: F64, T_before_now: F64, place: Place | None, match_map: MatchMap
    ) -> InitialPose | None:
        standing = standing_points(points_m, self._par.initialise.above_ground_m)
        self.hypotheses.follow(T_before_now, points_m, standing, match_map)
        if place is not None and t_ns - self._searched_ns >= self._par.health.retry_s * 1e9:
            self._search(t_ns, points_m, place, match_map)
        if place is not None:
            self.hypotheses.see_position(place.p_map_m, place.sigma_m)
        answer = self.hypotheses.answer()
        self.cause = self._why(answer, place, match_map, points_m)
        if answer is None or not self._good_enough(answer, t_ns):
            return None
        return self._with_all_points(answer, points_m, match_map)

    def _search(self, t_ns: int, points_m: F64, place: Place, match_map: MatchMap) -> None:
        self._searched_ns = t_ns
        self._since_ns = t_ns if self._since_ns is None else self._since_ns
        around = Around(place.p_map_m, place.reach_m)
        self.hypotheses.add(search(points_m, around, match_map, self._par.initialise, self._par.registration)[0])

    def _good_enough(self, found: InitialPose, t_ns: int) -> bool:
        """True for a clear answer; one that fits poorly only when waiting has not brought a better one."""
        par = self._par.initialise
        patient = self._since_ns is not None and t_ns - self._since_ns < par.patience_s * 1e9
        return found.found and found.fit >= (par.good_fit if patient else par.min_fit)

    def _why(self, answer: InitialPose | None, place: Place | None, match_map: MatchMap, points_m: F64) -> Cause:
        if answer is None and place is None:
            return "no_position"
        if len(points_m) < self._par.registration.min_matched:
            return "bad_scan"
        if answer is None:
            return "no_match" if _known_at(match_map, place) else "no_map"
        if answer.fit < self._par.initialise.min_fit:
            return "no_match"
        return "searching" if answer.probability >= self._par.hypotheses.sure else "ambiguous"

    def _with_all_points(self, answer: InitialPose, points_m: F64, m: MatchMap) -> InitialPose | None:
        """The same answer, its pose refined once more with all points."""
        try:
            result = register(points_m, answer.registration.T_map_vehicle, m, self._par.registration)
        except RegistrationError:
            return None
        return replace(answer, registration=result)


def standing_points(points_m: F64, above_ground_m: float) -> F64:
    """The points (N, 3) that stand above the ground; the ground fits everywhere."""
    return points_m[points_m[:, 2] > ground_below(points_m) + above_ground_m] if len(points_m) else points_m


def _known_at(m: MatchMap, place: Place | None) -> bool:
    """True when the map holds anything within reach of a place."""
    if place is None or not len(m):
        return False
    far = np.hypot(m.mean_m[:, 0] - place.p_map_m[0], m.mean_m[:, 1] - place.p_map_m[1])
    return bool((far < place.reach_m + 10.0).any())
