"""What follows every match: witness, challenger and monitor together judge the tracked pose, scan by scan."""

from typing import Final, NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import transform
from gnd.vehicle_agent.local_map import EMPTY
from gnd.vehicle_agent.localise.challenge import Challenger
from gnd.vehicle_agent.localise.estimates import Cause
from gnd.vehicle_agent.localise.first_pose import SearchPlace
from gnd.vehicle_agent.localise.health import HealthMonitor
from gnd.vehicle_agent.localise.initialise import INITIALISE_N_REFINING, INITIALISE_RADIUS_SIGMAS, ground_below, thinned
from gnd.vehicle_agent.localise.match_map import MatchMap
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.localise.registration import REGISTRATION_MIN_MATCHED, RegistrationResult, fit_of
from gnd.vehicle_agent.localise.scan_pool import ScanPool
from gnd.vehicle_agent.localise.uniqueness import Uniqueness
from gnd.vehicle_agent.localise.witness import witnessed

_PERIOD_S: Final = 0.5
_WAY_M: Final = 5.0
_REACH_M: Final = 5.0
"""Around the tracked pose where there is no GNSS."""
_LEAST_KNOWN: Final = 0.3
"""A smaller share of the points in known voxels means that there is no map."""
_MOTION_GAP_S: Final = 0.3
_GAP_S: Final = 2.0
"""After so long without motion samples, or without a believed match, the pose must prove itself again."""

FEWEST_POINTS: Final = 20
"""Of a scan that a sensor in order gives: in an open field four layers see a few dozen points that matter."""


class Matched(NamedTuple):
    """One scan after its match.

    Attributes:
        t_ns: reference time.
        points_m: (N, 3) vehicle frame.
        T_before_now: (4, 4) motion since the scan before.
        T_now: (4, 4) the tracked pose.
        result: the match that was made there.
        believed: whether it counts.
        motion_gap_s: seconds since the scan before without motion samples.
        cause: what is known to be wrong besides.
        repeated: equal to the scan before bit for bit, which no sensor measures.
    """

    t_ns: int
    points_m: F64
    T_before_now: F64
    T_now: F64
    result: RegistrationResult | None
    believed: bool
    motion_gap_s: float = 0.0
    cause: Cause = "none"
    repeated: bool = False


class Judge:
    """Judges one track from its first scan to its end."""

    def __init__(self, parameters: LocaliserParameters, origin_m: F64, now_ns: int) -> None:
        self._par = parameters
        self._origin_m = np.ascontiguousarray(origin_m, dtype=np.float64)
        self.monitor = HealthMonitor(parameters.health, now_ns)
        self.challenger = Challenger(parameters)
        self.uniqueness = Uniqueness(parameters)
        self._pool = ScanPool()
        self._witness_ns = -(2**62)
        self._way_m = 0.0
        self._T_looked_now = np.eye(4)  # motion since the last scan that had points enough to look at
        self._place: SearchPlace | None = None

    def begin(self, points_m: F64, T_now: F64, place: SearchPlace | None, match_map: MatchMap) -> None:
        """Take the first scan (N, 3) of the track, at its pose (4, 4), and its GNSS position."""
        self._pool.push(points_m, np.eye(4))
        self.uniqueness.see(self._pool.newest_standing_m, np.eye(4), T_now, place, match_map)
        self.monitor.unique = self.uniqueness.proven

    def see_position(self, p_map_m: F64, sigma_m: float, T_now: F64) -> None:
        """Take the GNSS position (3,) of the vehicle, tracked at `T_now` (4, 4), with one sigma of an axis."""
        self.monitor.see_fix(p_map_m[:2] - T_now[:2, 3], sigma_m)
        self._place = SearchPlace(p_map_m, sigma_m, INITIALISE_RADIUS_SIGMAS * sigma_m)

    def see(self, scan: Matched, match_map: MatchMap) -> None:
        """Take a scan: evidence of its rays, how well it fits, whether another pose fits better."""
        self.uniqueness.tested = False  # a scan that is too poor to compare does not reach it
        if scan.motion_gap_s > _MOTION_GAP_S or self.monitor.gap_s(scan.t_ns) > _GAP_S:
            self.monitor.distrust()
            self.uniqueness.distrust(moved=scan.motion_gap_s > _MOTION_GAP_S)
        self.monitor.see_scan(self._what_is_wrong(scan, match_map))
        self.monitor.matching_ratio = 0.0 if scan.result is None else scan.result.matching_ratio
        self._way_m += float(np.linalg.norm(scan.T_before_now[:3, 3]))
        self._T_looked_now = self._T_looked_now @ scan.T_before_now
        if len(scan.points_m) < REGISTRATION_MIN_MATCHED:
            return
        scan, self._T_looked_now = scan._replace(T_before_now=self._T_looked_now), np.eye(4)
        new = self._pool.push(scan.points_m, scan.T_before_now)
        self.uniqueness.see(
            self._pool.newest_standing_m, scan.T_before_now, scan.T_now, self._place, match_map, believed=scan.believed
        )
        self.monitor.unique = self.uniqueness.proven
        self._ask(scan, match_map)
        self._challenge(scan, new or self._pool.stands, match_map)
        if scan.result is not None and scan.believed:
            fit = fit_of(
                thinned(self._pool.standing_m, INITIALISE_N_REFINING),
                scan.T_now,
                match_map,
                self._par.registration,
            )
            self.monitor.see_match(fit, scan.result.fit, scan.result.degenerate)

    def _ask(self, scan: Matched, match_map: MatchMap) -> None:
        """The witness, now and then, and whenever a match is not believed."""
        rested = scan.t_ns - self._witness_ns >= _PERIOD_S * 1e9 or self._way_m >= _WAY_M
        if scan.believed and not rested:
            return
        self._witness_ns, self._way_m = scan.t_ns, 0.0
        below_m = ground_below(scan.points_m)
        self.monitor.see_testimony(witnessed(scan.points_m, self._origin_m, below_m, scan.T_now, match_map))

    def _challenge(self, scan: Matched, new: bool, match_map: MatchMap) -> None:
        place = self._place or SearchPlace(scan.T_now[:3, 3], _REACH_M, _REACH_M)
        self._place = None
        monitor = self.monitor
        doubtful = not scan.believed or monitor.doubtful(scan.result) or monitor.suspicious or not monitor.trusted
        self.challenger.see(
            scan.t_ns, self._pool.points_m, self._pool.standing_m, scan.T_now, scan.T_before_now, place, match_map,
            doubtful=doubtful, new=new, any_heading=not monitor.trusted or monitor.contradicted(scan.t_ns),
        )  # fmt: skip
        monitor.contested, monitor.beaten = self.challenger.contested, self.challenger.beaten

    def _what_is_wrong(self, scan: Matched, match_map: MatchMap) -> Cause:
        """With the scan itself, whatever it matches."""
        if scan.repeated or len(scan.points_m) < FEWEST_POINTS:
            return "bad_scan"
        if len(scan.points_m) < REGISTRATION_MIN_MATCHED:
            return "poor_place"
        known = _known_ratio(scan, match_map) if scan.result is None else scan.result.known_ratio
        if known < _LEAST_KNOWN:
            return "no_map"
        return "no_motion" if scan.motion_gap_s > _MOTION_GAP_S else scan.cause


def _known_ratio(scan: Matched, m: MatchMap) -> float:
    """Share of the points that lie in voxels of held tiles."""
    g = np.floor(transform(scan.T_now, scan.points_m) @ m.A.T + m.b).astype(np.int64)
    inside = ((g >= 0) & (g < m.index.shape)).all(axis=1)
    return float((m.index[tuple(g[inside].T)] >= EMPTY).sum() / max(len(g), 1))
