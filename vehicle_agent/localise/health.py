"""Gating of matches, and the health of the pose with its cause: a wrong pose is distinguished from a stale map, a poor
place.

A *wrong pose* has a rival: another pose that fits better for longer (challenge.py), or GNSS against it from the start,
or rays that contradict the map all around. On a *stale map* rays contradict the map in some places, the rest fits where
odometry and GNSS expect it, and no rival is found. In a *poor place* some direction is constrained by nothing, or next
to nothing stands.
"""

from collections import deque
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_inverse, log_so3
from gnd.vehicle_agent.localise.estimates import Cause, Health
from gnd.vehicle_agent.localise.parameters import HealthParameters
from gnd.vehicle_agent.localise.registration import RegistrationResult
from gnd.vehicle_agent.localise.witness import Testimony

_TESTIMONIES: Final = 4
"""How many of the witness's last ones are averaged."""
_TRUSTED_STANDING_FIT: Final = 0.6
"""Least fit of what stands, beside `_TRUSTED_FIT` of all points."""
_FITTING_HITS: Final = 0.7
"""Share of hits in the better half of the sectors that is no sign of a wrong pose."""
_SUSPICIOUS_GONE: Final = 0.25
"""Share of Gaussians gone from which on a better pose is looked for sooner."""
_WRONG_HITS: Final = 0.5
_WRONG_SHARE: Final = 0.6
"""With hits below, new and gone together above these, the pose is contradicted all around."""
_STALE_SHARE: Final = 0.35
"""Share of points new and of Gaussians gone, added up, that makes a map stale."""
CAUSE_POOR_SIGMA_M: Final = 0.15
_POOR_SIGMA_RAD: Final = 0.003
"""One sigma of position and heading from which on a pose is no longer good."""
_LEAST_STANDING: Final = 25
"""Fewer standing points among the witness's rays are next to nothing."""
_LONGEST_S: Final = 15.0
_MIN_MATCHING_RATIO: Final = 0.5
"""Least share of the points with a Gaussian nearby, for a match to be believed."""
_PARTLY_MATCHED: Final = 0.3
"""Matching ratio from which on a scan that is not believed still supports a pose that submaps hold to be certain:
what is missing is what has changed."""
_LOST_SIGMA_M: Final = 1.0
"""Where the map is stale or the place is poor, it is lost after so long without a believed match, or with so large a
sigma."""
_TRUSTED_FIT: Final = 0.65
"""A pose is degraded until one match has had this fit: where much has changed, a wrong pose can fit best."""
_BETTER_FIT: Final = 0.1
_BETTER_COUNT: Final = 5
"""This many scans in a row that fit better by so much at a pose farther off make the pose suspicious."""
_GATE_M: Final = 0.15
_GATE_M_PER_S: Final = 0.15
_GATE_DEG: Final = 0.4
_GATE_DEG_PER_S: Final = 0.25
"""How far a match may lie from the prediction, at once and for every second without a believed match; three sigmas of
the odometry come on top."""
_GNSS_SIGMAS: Final = 5.0
HEALTH_GNSS_COUNT: Final = 5
"""This many fixes in a row farther than this from the pose mean that the pose is wrong, however well the scan seems to
fit."""

DIRECTIONS = ("roll", "pitch", "heading", "longitudinal", "lateral", "vertical")  # as in `degenerate`
DISPUTED, MOST_DISPUTES = 2, 4  # matches that fit and lie elsewhere, less those that were believed since
FULL_FIT = 0.85  # of a scan that finds nearly all of what it sees in the map


class HealthMonitor:
    """Remembers when a match was last believed, what contradicted the pose since, and what the last scans were like."""

    def __init__(self, parameters: HealthParameters, now_ns: int) -> None:
        self.parameters = parameters
        self.contested = False
        self.beaten = False
        self.certain = False
        """Submaps and odometry leave no doubt: what single scans hold against the pose is the changed world."""
        self.scans_prove = True
        """A single scan that fits well proves the pose; those of a few layers fit in too many places."""
        self.unique = True
        """No other place looks the same (uniqueness.py)."""
        self.degenerate: tuple[str, ...] = ()
        self.matching_ratio = 0.0
        """Of the newest scan's match, believed or not."""
        self._believed_ns = now_ns
        self._far_fixes = 0
        self._offset_m: F64 | None = None
        self._gnss_jumped = False
        self._better_elsewhere = 0
        self._trusted = False
        self._testimonies: deque[Testimony] = deque(maxlen=_TESTIMONIES)
        self._scan: Cause = "none"
        self._sigma = (0.0, 0.0)
        self._disputes, self._full = 0, False

    # --- observations ------------------------------------------------------------------------------------------------

    def believe(self, result: RegistrationResult | None, T_predicted: F64, sigmas: F64, t_ns: int) -> bool:
        """True when the match converged, covers enough of the scan and lies near the prediction; remembered then.

        `sigmas` (6,) of the prediction since the pose before: rotation [rad], translation [m].
        """
        if result is None or not result.converged or result.matching_ratio < _MIN_MATCHING_RATIO:
            return False
        if not self._within_gate(T_inverse(T_predicted) @ result.T_map_vehicle, sigmas, self._gap_s(t_ns)):
            return False
        self._believed_ns = t_ns
        return True

    def doubtful(self, result: RegistrationResult | None) -> bool:
        """True when a wider search is needed."""
        return result is None or not result.converged or result.fit < _TRUSTED_FIT

    def see_wider(self, near: RegistrationResult | None, wide: RegistrationResult | None) -> None:
        """Take a match from the prediction with narrow and with wide reach."""
        fit = 0.0 if near is None else near.fit
        better = wide is not None and wide.fit > fit + _BETTER_FIT
        self._better_elsewhere = self._better_elsewhere + 1 if better else 0

    def see_verdict(self, result: RegistrationResult | None, believed: bool) -> None:
        """Take whether the scan's match was believed. One that fits well and lies elsewhere counts against the pose:
        odometry that goes wrong in small steps looks like that, and so does a first pose at a neighbouring minimum.
        """
        if believed:
            self._disputes = max(self._disputes - 1, 0)
        elif result is not None and result.converged and result.fit >= _TRUSTED_FIT:
            self._disputes = min(self._disputes + 1, MOST_DISPUTES)
            self._full = result.fit >= FULL_FIT

    def prove_first(self) -> None:
        """Another pose fits as well as the first one: it must agree with the next scans."""
        self._disputes, self._full = MOST_DISPUTES, True

    @property
    def disputed(self) -> bool:
        """True when scans fit well elsewhere, one after the other. Where submaps are certain it takes longer, unless
        the scans fit with nearly all their points: where the world has changed, they do not.
        """
        return self._disputes >= (DISPUTED if self._full or not self.certain else MOST_DISPUTES)

    def see_fix(self, offset_m: F64, sigma_m: float) -> None:
        """Take the horizontal offset (2,) of a GNSS fix from the pose at its time.

        A fix that jumped from an agreeing one while the scans went on to match is the GNSS's own error.
        """
        limit_m = _GNSS_SIGMAS * sigma_m
        far = float(np.hypot(*offset_m)) > limit_m
        if far and self._offset_m is not None and float(np.hypot(*(offset_m - self._offset_m))) > 0.5 * limit_m:
            self._gnss_jumped = True
        self._gnss_jumped &= far
        self._far_fixes = self._far_fixes + 1 if far else 0
        self._offset_m = np.asarray(offset_m, np.float64)

    def see_match(self, standing_fit: float, fit: float, degenerate: F64) -> None:
        """Take a believed match: fit of what stands and of all points; directions (K, 6) that it leaves free. A good
        one makes the pose trusted.
        """
        self.degenerate = named_directions(degenerate)
        enough = fit >= _TRUSTED_FIT and standing_fit >= _TRUSTED_STANDING_FIT
        self._trusted |= enough and not self.contested

    def see_testimony(self, testimony: Testimony) -> None:
        """Take the evidence of a scan's rays."""
        self._testimonies.append(testimony)

    def see_scan(self, cause: Cause) -> None:
        """Take what is wrong with the newest scan, whatever its match: "none", "bad_scan", "no_map", "no_motion"."""
        self._scan = cause

    def see_sigma(self, sigma_m: float, sigma_rad: float) -> None:
        """Take the uncertainty of the newest pose."""
        self._sigma = (sigma_m, sigma_rad)

    def distrust(self) -> None:
        """The pose must prove itself again: it was dead reckoned for long."""
        self._trusted = False
        self._testimonies.clear()

    # --- the verdict ----------------------------------------------------------------------------------------------

    def judge(self, t_ns: int) -> tuple[Health, Cause]:
        """`lost`: the pose must not be used; `degraded`: not to be relied on; else `good`; and why."""
        gap_s, par = self._gap_s(t_ns), self.parameters
        if (self.beaten and not self.certain) or self._gnss_contradicts(gap_s):
            return "lost", "wrong_pose"
        if gap_s > par.degraded_after_s:
            cause = self._why_unmatched()
            return ("lost" if gap_s > self._patience_s(cause) else "degraded"), cause
        if self._scan != "none":
            return "degraded", self._scan
        if self.disputed or ((self.contested or self.contradicted(t_ns)) and not self.certain):
            return "degraded", "wrong_pose"
        if self._sigma[0] > CAUSE_POOR_SIGMA_M or self._sigma[1] > _POOR_SIGMA_RAD:
            return "degraded", "poor_place"
        if not self.unique or (not (self._trusted and self.scans_prove) and not self.certain):
            return "degraded", "unconfirmed"
        return "good", "stale_map" if self.stale else "none"

    def health(self, t_ns: int) -> Health:
        """As `judge`, without the cause."""
        return self.judge(t_ns)[0]

    @property
    def trusted(self) -> bool:
        """True when a match has fitted well since the pose was found."""
        return self._trusted

    @property
    def suspicious(self) -> bool:
        """True when a better pose is to be searched soon: a wider match fits better, or the rays contradict the
        map more than a current map would be.
        """
        hits, gone = self._mean("best_hits"), self._mean("gone_share")
        contradicted = gone > _SUSPICIOUS_GONE or hits < _FITTING_HITS
        return self._better_elsewhere >= _BETTER_COUNT or (bool(self._testimonies) and contradicted)

    @property
    def stale(self) -> bool:
        """True when much is new or gone."""
        changed = self._mean("new_share") + self._mean("gone_share")
        return bool(self._testimonies) and changed > _STALE_SHARE

    def gap_s(self, t_ns: int) -> float:
        """Seconds since a match was believed."""
        return self._gap_s(t_ns)

    def _gnss_contradicts(self, gap_s: float) -> bool:
        """Fixes far off in a row, and they did not jump away from a pose that goes on to match."""
        known_wrong = self._gnss_jumped and self._trusted and gap_s <= self.parameters.degraded_after_s
        return self._far_fixes >= HEALTH_GNSS_COUNT and not known_wrong

    def contradicted(self, t_ns: int) -> bool:
        """True when the rays hit nothing all around: of two testimonies, or of one if the match was not believed."""
        last = list(self._testimonies)[-2:]
        enough = 1 if self._gap_s(t_ns) > 0.0 else 2
        if len(last) < enough or max(one.best_hits for one in last[-enough:]) >= _WRONG_HITS:
            return False
        return min(one.new_share + one.gone_share for one in last[-enough:]) > _WRONG_SHARE

    def _why_unmatched(self) -> Cause:
        if self._scan != "none":
            return self._scan
        if self._testimonies and self._testimonies[-1].standing < _LEAST_STANDING:
            return "poor_place"
        if not self._testimonies:
            return "no_match"
        return "stale_map" if self._mean("best_hits") >= _FITTING_HITS else "wrong_pose"

    def _patience_s(self, cause: Cause) -> float:
        """How long dead reckoning may go on: where the map or the place is to blame, the pose was right."""
        known = self._sigma[0] < _LOST_SIGMA_M
        partly = self.certain and self.matching_ratio >= _PARTLY_MATCHED
        blameless = known and (partly or cause in ("stale_map", "poor_place"))
        return _LONGEST_S if blameless else self.parameters.lost_after_s

    def _mean(self, name: str) -> float:
        return float(np.mean([getattr(one, name) for one in self._testimonies])) if self._testimonies else 0.0

    def _gap_s(self, t_ns: int) -> float:
        return (t_ns - self._believed_ns) * 1e-9

    def _within_gate(self, innovation: F64, sigmas: F64, gap_s: float) -> bool:
        shift_m = float(np.linalg.norm(innovation[:3, 3]))
        turn_deg = float(np.degrees(np.linalg.norm(log_so3(innovation[:3, :3]))))
        limit_m = _GATE_M + _GATE_M_PER_S * gap_s + 3.0 * float(np.linalg.norm(sigmas[3:]))
        limit_deg = _GATE_DEG + _GATE_DEG_PER_S * gap_s + np.degrees(3.0 * float(np.linalg.norm(sigmas[:3])))
        return bool(shift_m <= limit_m and turn_deg <= limit_deg)


def named_directions(degenerate: F64) -> tuple[str, ...]:
    """Names of directions (K, 6) (rotation, then position, vehicle frame) by their largest components."""
    largest = sorted({int(k) for k in np.abs(degenerate.reshape(-1, 6)).argmax(axis=1)}, reverse=True)
    return tuple(DIRECTIONS[k] for k in largest)
