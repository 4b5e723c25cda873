"""Several poses at once: each is followed by odometry and registration until one of them has clearly won."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_inverse, log_so3
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.localise.initialise import Candidate, InitialPose, near_pose, probabilities, thinned
from gnd.vehicle_agent.localise.match_map import MatchMap
from gnd.vehicle_agent.localise.parameters import RegistrationParameters
from gnd.vehicle_agent.localise.registration import RegistrationResult, fit_of, register

_N_MOST: Final = 8
"""How many are followed."""
_N_POINTS: Final = 1000
"""That each is registered with."""
HYPOTHESIS_APART_M: Final = 0.3
HYPOTHESIS_APART_DEG: Final = 1.0
"""Two poses nearer than this are one."""
HYPOTHESIS_VIEW_M: Final = 2.0
"""The way after which a scan is a new view, and how many views count: what is stale stays so."""
_INNOVATION_M: Final = 0.1
_INNOVATION_DEG: Final = 0.4
"""One sigma of how far a right pose's registration moves it from where odometry has put it."""
_TWIN_M: Final = 0.5
_TWIN_DEG: Final = 2.0
"""Poses nearer than this share their probability."""
HYPOTHESIS_MOST_VIEWS: Final = 3.0
"""So many views count: what is stale stays so."""
HYPOTHESIS_SURE: Final = 0.99
"""Least probability of a winner, after `least_scans` scans."""
HYPOTHESIS_LEAST_SCANS: Final = 3
_AT_ONCE: Final = 0.75
_ALONE: Final = 0.75
"""A fit so good, with a runner-up of less than this share of it, wins at the first."""
_DROPPED: Final = 1e-06
"""A hypothesis this much less probable than the best is given up."""


@dataclass(slots=True, eq=False)
class Hypothesis:
    """A pose that may be the right one: mean fit over so many views; penalties by odometry and GNSS."""

    registration: RegistrationResult
    T_map_vehicle: F64
    mean_fit: float
    fit: float
    views: float = 1.0
    scans: int = 1
    surprise: float = 0.0
    far: float = 0.0

    def take(self, result: RegistrationResult, fit: float, surprise: float, new: float, most: float) -> None:
        """A further scan, which is `new` (0 ... 1) of a view."""
        weight = new / (self.views + new) if self.views + new <= most else new / most
        self.mean_fit += max(weight, 0.2 / (self.scans + 1.0)) * (fit - self.mean_fit)
        self.surprise += 0.3 * (surprise - self.surprise)
        self.views = min(self.views + new, most)
        self.registration, self.T_map_vehicle, self.fit = result, result.T_map_vehicle, fit
        self.scans += 1


class PoseHypotheses:
    """Follows poses over consecutive scans. Which is right shows in the mean fit of what stands above the ground
    (standing still tells nothing new), by how far registration moves each from where odometry has put it, and by GNSS.
    """

    def __init__(self, registration: RegistrationParameters, most_views: float = HYPOTHESIS_MOST_VIEWS) -> None:
        self._most_views = most_views
        self._registration = registration
        self._held: list[Hypothesis] = []
        self._way_m = 0.0  # since the last view

    def __len__(self) -> int:
        return len(self._held)

    def add(self, candidates: list[Candidate]) -> None:
        """Take poses of the present scan; those that are followed already are left out."""
        for one in candidates:
            if not self._near(one.registration.T_map_vehicle).any():
                result = one.registration
                self._held.append(Hypothesis(result, result.T_map_vehicle, one.fit, one.fit))
        self._prune()

    def see_position(self, p_map_m: F64, sigma_m: float) -> None:
        """Take the GNSS position now: (3,), of which the height is not used; one sigma of an axis."""
        for one in self._held:
            one.far = 0.5 * float(np.sum((one.T_map_vehicle[:2, 3] - p_map_m[:2]) ** 2)) / sigma_m**2

    def move(self, T_before_now: F64) -> None:
        """Move every pose by odometry (4, 4)."""
        self._way_m += float(np.hypot(*T_before_now[:2, 3]))
        for one in self._held:
            one.T_map_vehicle = one.T_map_vehicle @ T_before_now

    def weigh(self, points_m: F64, standing_m: F64, match_map: MatchMap) -> None:
        """Register every pose with a view: `points_m` (N, 3) in the vehicle frame, and those of them that stand above
        the ground. A pose that matches nothing is given up.
        """
        new, self._way_m = min(1.0, self._way_m / HYPOTHESIS_VIEW_M), 0.0
        few, standing = thinned(points_m, _N_POINTS), thinned(standing_m, _N_POINTS)
        self._held = [one for one in self._held if self._weighed(one, few, standing, match_map, new)]
        self._prune()

    def _weighed(self, one: Hypothesis, points_m: F64, standing_m: F64, m: MatchMap, new: float) -> bool:
        result = self._registered(points_m, one.T_map_vehicle, m)
        if result is None:
            return False
        fit = fit_of(standing_m, result.T_map_vehicle, m, self._registration)
        one.take(result, fit, self._surprise(one.T_map_vehicle, result.T_map_vehicle), new, self._most_views)
        return True

    @property
    def best(self) -> Hypothesis:
        """The most probable one; there must be one."""
        return self._held[int(np.argmax(self._probabilities()))]

    @property
    def probability(self) -> float:
        """Of the best one and its twins, 0 without any; the others and "none of them" share the rest."""
        if not self._held:
            return 0.0
        twins = self._near(self.best.T_map_vehicle, _TWIN_M, _TWIN_DEG)
        return float(self._probabilities()[twins].sum())

    def drop_near(self, T_map_vehicle: F64) -> None:
        """Give up what has come to the same pose (4, 4)."""
        same = self._near(T_map_vehicle)
        self._held = [one for one, is_same in zip(self._held, same, strict=True) if not is_same]

    def clear(self) -> None:
        """Follow none."""
        self._held = []

    def answer(self) -> InitialPose | None:
        """The best pose as it stands now; `found` when it has won."""
        if not self._held:
            return None
        best = self.best
        twins = self._near(best.T_map_vehicle, _TWIN_M, _TWIN_DEG)
        fits = np.array([one.mean_fit for one in self._held])
        runner_up = float(fits[~twins].max(initial=0.0))
        at_once = best.mean_fit >= _AT_ONCE and runner_up <= _ALONE * best.mean_fit
        won = at_once or (best.scans >= HYPOTHESIS_LEAST_SCANS and self.probability >= HYPOTHESIS_SURE)
        return InitialPose(best.registration, best.mean_fit, runner_up, len(fits), won, self.probability)

    def _registered(self, points: F64, predicted: F64, m: MatchMap) -> RegistrationResult | None:
        try:
            return register(points, predicted, m, self._registration, "near")
        except RegistrationError:
            return None

    def _surprise(self, T_predicted: F64, T_found: F64) -> float:
        """Half the squared distance between two poses in sigmas, at most 8."""
        off = T_inverse(T_predicted) @ T_found
        shift = float(np.hypot(off[0, 3], off[1, 3])) / _INNOVATION_M
        turn = float(np.degrees(np.linalg.norm(log_so3(off[:3, :3])))) / _INNOVATION_DEG
        return min(0.5 * (shift**2 + turn**2), 8.0)

    def _probabilities(self) -> F64:
        """(K,) of what is followed."""
        if not self._held:
            return np.empty(0)
        fits = np.array([one.mean_fit for one in self._held])
        views = max(one.views for one in self._held)
        return probabilities(fits, views, np.array([one.surprise + one.far for one in self._held]))

    def _near(self, T: F64, apart_m: float | None = None, apart_deg: float | None = None) -> NDArray[np.bool_]:
        """(K,) which poses lie near another, by default so near that they are one."""
        held = np.stack([one.T_map_vehicle for one in self._held]) if self._held else np.empty((0, 4, 4))
        return near_pose(held, T, apart_m or HYPOTHESIS_APART_M, apart_deg or HYPOTHESIS_APART_DEG)

    def _prune(self) -> None:
        """Leave out what has become improbable, what has run into a better one, and the least probable beyond the
        number that is followed.
        """
        p = self._probabilities()
        order = [k for k in np.argsort(-p, kind="stable") if p[k] >= _DROPPED * p.max()]
        held, self._held = self._held, []
        for k in order[: 2 * _N_MOST]:
            if len(self._held) < _N_MOST and not self._near(held[k].T_map_vehicle).any():
                self._held.append(held[k])
