"""Whether to believe a match, whether to believe the pose, and why not: tells a wrong pose from a stale map from a poor
place.

A *wrong pose* has a rival: another pose that fits better for longer (challenge.py), or GNSS against it from the start,
or rays that contradict the map all around. On a *stale map* rays contradict the map in some places, the rest fits where
odometry and GNSS expect it, and no rival is found. In a *poor place* some direction is constrained by nothing, or next
to nothing stands.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.se3 import T_inverse, log_so3
from gnd.vehicle_agent.localise.doubt_parameters import CauseParameters
from gnd.vehicle_agent.localise.estimates import Cause, Health
from gnd.vehicle_agent.localise.parameters import HealthParameters
from gnd.vehicle_agent.localise.registration import RegistrationResult
from gnd.vehicle_agent.localise.witness import Testimony

F64 = NDArray[np.float64]

DIRECTIONS = ("roll", "pitch", "heading", "longitudinal", "lateral", "vertical")  # as in `degenerate`
DISPUTED, MOST_DISPUTES = 2, 4  # matches that fit and lie elsewhere, less those that were believed since
FULL_FIT = 0.85  # of a scan that finds nearly all of what it sees in the map


class HealthMonitor:
    """Remembers when a match was last believed, what contradicted the pose since, and what the last scans were like."""

    def __init__(self, parameters: HealthParameters, now_ns: int, causes: CauseParameters | None = None) -> None:
        self.parameters = parameters
        self.causes = causes or CauseParameters()
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
        self._testimonies: deque[Testimony] = deque(maxlen=self.causes.testimonies)
        self._scan: Cause = "none"
        self._sigma = (0.0, 0.0)
        self._disputes, self._full = 0, False

    # --- what is told to it ------------------------------------------------------------------------------------------

    def believe(self, result: RegistrationResult | None, T_predicted: F64, sigmas: F64, t_ns: int) -> bool:
        """True when the match converged, covers enough of the scan and lies near the prediction; remembered then.

        `sigmas` (6,) of the prediction since the pose before: rotation [rad], translation [m].
        """
        if result is None or not result.converged or result.matching_ratio < self.parameters.min_matching_ratio:
            return False
        if not self._within_gate(T_inverse(T_predicted) @ result.T_map_vehicle, sigmas, self._gap_s(t_ns)):
            return False
        self._believed_ns = t_ns
        return True

    def doubtful(self, result: RegistrationResult | None) -> bool:
        """True when a wider search is worth its time."""
        return result is None or not result.converged or result.fit < self.parameters.trusted_fit

    def see_wider(self, near: RegistrationResult | None, wide: RegistrationResult | None) -> None:
        """Take a match from the prediction with narrow and with wide reach."""
        fit = 0.0 if near is None else near.fit
        better = wide is not None and wide.fit > fit + self.parameters.better_fit
        self._better_elsewhere = self._better_elsewhere + 1 if better else 0

    def see_verdict(self, result: RegistrationResult | None, believed: bool) -> None:
        """Take whether the scan's match was believed. One that fits well and lies elsewhere speaks against the pose:
        odometry that goes wrong in small steps looks like that, and so does a first pose at a neighbouring minimum.
        """
        if believed:
            self._disputes = max(self._disputes - 1, 0)
        elif result is not None and result.converged and result.fit >= self.parameters.trusted_fit:
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
        limit_m = self.parameters.gnss_sigmas * sigma_m
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
        enough = fit >= self.parameters.trusted_fit and standing_fit >= self.causes.trusted_standing_fit
        self._trusted |= enough and not self.contested

    def see_testimony(self, testimony: Testimony) -> None:
        """Take what the rays of a scan say."""
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

    # --- what it says ---------------------------------------------------------------------------------------------

    def judge(self, t_ns: int) -> tuple[Health, Cause]:
        """`lost`: the pose is worth nothing; `degraded`: not to be relied on; else `good`; and why."""
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
        if self._sigma[0] > self.causes.poor_sigma_m or self._sigma[1] > self.causes.poor_sigma_rad:
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
        """True when it is worth to look for a better pose soon: a wider match fits better, or the rays contradict the
        map more than a current map would be.
        """
        hits, gone = self._mean("best_hits"), self._mean("gone_share")
        contradicted = gone > self.causes.suspicious_gone or hits < self.causes.fitting_hits
        return self._better_elsewhere >= self.parameters.better_count or (bool(self._testimonies) and contradicted)

    @property
    def stale(self) -> bool:
        """True when much is new or gone."""
        changed = self._mean("new_share") + self._mean("gone_share")
        return bool(self._testimonies) and changed > self.causes.stale_share

    def gap_s(self, t_ns: int) -> float:
        """Seconds since a match was believed."""
        return self._gap_s(t_ns)

    def _gnss_contradicts(self, gap_s: float) -> bool:
        """Fixes far off in a row, and they did not jump away from a pose that goes on to match."""
        known_wrong = self._gnss_jumped and self._trusted and gap_s <= self.parameters.degraded_after_s
        return self._far_fixes >= self.parameters.gnss_count and not known_wrong

    def contradicted(self, t_ns: int) -> bool:
        """True when the rays hit nothing all around: of two testimonies, or of one if the match was not believed."""
        last = list(self._testimonies)[-2:]
        enough = 1 if self._gap_s(t_ns) > 0.0 else 2
        if len(last) < enough or max(one.best_hits for one in last[-enough:]) >= self.causes.wrong_hits:
            return False
        return min(one.new_share + one.gone_share for one in last[-enough:]) > self.causes.wrong_share

    def _why_unmatched(self) -> Cause:
        if self._scan != "none":
            return self._scan
        if self._testimonies and self._testimonies[-1].standing < self.causes.least_standing:
            return "poor_place"
        if not self._testimonies:
            return "no_match"
        return "stale_map" if self._mean("best_hits") >= self.causes.fitting_hits else "wrong_pose"

    def _patience_s(self, cause: Cause) -> float:
        """How long dead reckoning is worth something: where the map or the place is to blame, the pose was right."""
        known = self._sigma[0] < self.causes.lost_sigma_m
        partly = self.certain and self.matching_ratio >= self.causes.partly_matched
        blameless = known and (partly or cause in ("stale_map", "poor_place"))
        return self.causes.longest_s if blameless else self.parameters.lost_after_s

    def _mean(self, name: str) -> float:
        return float(np.mean([getattr(one, name) for one in self._testimonies])) if self._testimonies else 0.0

    def _gap_s(self, t_ns: int) -> float:
        return (t_ns - self._believed_ns) * 1e-9

    def _within_gate(self, innovation: F64, sigmas: F64, gap_s: float) -> bool:
        par = self.parameters
        shift_m = float(np.linalg.norm(innovation[:3, 3]))
        turn_deg = float(np.degrees(np.linalg.norm(log_so3(innovation[:3, :3]))))
        limit_m = par.gate_m + par.gate_m_per_s * gap_s + 3.0 * float(np.linalg.norm(sigmas[3:]))
        limit_deg = par.gate_deg + par.gate_deg_per_s * gap_s + np.degrees(3.0 * float(np.linalg.norm(sigmas[:3])))
        return bool(shift_m <= limit_m and turn_deg <= limit_deg)


def named_directions(degenerate: F64) -> tuple[str, ...]:
    """Names of directions (K, 6) (rotation, then position, vehicle frame) by their largest components."""
    largest = sorted({int(k) for k in np.abs(degenerate.reshape(-1, 6)).argmax(axis=1)}, reverse=True)
    return tuple(DIRECTIONS[k] for k in largest)
