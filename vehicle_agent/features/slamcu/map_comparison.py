"""Features of the map against what was measured of them: found in place, taken for their neighbour, or moved.

A feature is estimated while it is in sight, and compared with its map position when it has left the view. The panels of
a gantry are distinguished first (`identities.py`). What then lies elsewhere has moved: deleted there, new here (SLAMCU,
section 2.3).

Or it is the vehicle that is not where it believes to be. A vehicle that starts with a GNSS fix may take a new sign for
the map's next to it, and is then sure of a wrong place: each further sign seems to have moved by the same step. So the
last sign that moved is remembered until another one is found in place. When a second one moved alike, neither has: both
get their evidence back, and the place is searched for anew.
"""

from dataclasses import dataclass
from math import inf, radians
from typing import Final, NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.slamcu.blind import BlindFilter
from gnd.vehicle_agent.features.slamcu.identities import LN_NONE, LN_NONE_DOUBTED, NONE, best_identities
from gnd.vehicle_agent.features.slamcu.sensor_model import OTHER_KIND
from gnd.vehicle_agent.features.slamcu.track_list import TrackList
from gnd.vehicle_agent.features.slamcu.tracked_feature import TrackedFeature

MOVED_GATE: Final = 14.0
"""A map feature measured this far off (squared Mahalanobis) has moved. χ² of 2 degrees of freedom, 99.9 %."""
MOVED_M: Final = 2.0
"""And at least this far: less than a lane, more than a pose that is surer than it should be errs by."""
SETTLE_HITS: Final = 60
"""A feature in view is compared after so many measurements: at a red light nothing leaves the view."""
ENOUGH_HITS: Final = 6
"""So many measurements show where a feature is, and whether it is ever measured together with another."""
GROUP_M: Final = 12.0
"""Features within this distance may be taken for each other: three lanes."""
WIDE_GROUP_M: Final = 20.0
"""The same where errors stay with features: along the road they may be many metres."""
RIVAL_SHARE: Final = 0.25
"""What was measured less often than this share of what stands beside it is no feature of the map that was in view."""
SURE: Final = 3.0
"""Identities are decided when they are so much likelier than any others (natural logarithm), whichever of the two
prices a sign has that is gone while another stands in its place."""
UNDECIDED_M: Final = 600.0
"""Or after so much way, in which further signs may have shown where the vehicle was."""
ASK_EVERY_S: Final = 1.0
"""What is undecided is looked at so often."""
ALLOWED: Final = 18.4
"""χ² of 2 degrees of freedom, one in 10,000: no two signs alike put the vehicle farther from its fixes than this."""
ALIKE: Final = 0.5
"""Cosine of the angle between two steps that may be one, and the least ratio of their lengths."""
RECENT_M: Final = 1500.0
"""A sign that moved longer ago is no evidence about the place now."""
LOOSE_M: Final = 4.0
LOOSE_RAD: Final = radians(1.0)
"""Sigmas of the place that is searched for anew: a lane, and what two signs a lane off turn the vehicle by."""


class MapInnovation(NamedTuple):
    """How far from its place in the map a feature was measured."""

    squared: float
    """Mahalanobis distance, squared; 2 degrees of freedom."""
    ln_density: float
    """Natural logarithm of its density, 1/m^2."""


@dataclass(frozen=True, slots=True, eq=False)
class MovedFeature:
    """A feature of the map that was called moved.

    Attributes:
        known: the map's.
        found: what was registered instead.
        hits: measurements that went over to it.
        off_m: (2,) measured minus mapped position.
        odometer_m: when.
    """

    known: TrackedFeature
    found: TrackedFeature
    hits: int
    off_m: F64
    odometer_m: float


class MapComparison:
    """Compares features with their map positions, once a passage.

    Args:
        tracks: the features of the drive.
        blind: the vehicle's place by what has never seen a feature.

    Attributes:
        ln_none: natural logarithm of the density of a feature that is gone while another stands in its place.
        innovations: of the features compared, until somebody takes them.
    """

    def __init__(self, tracks: TrackList, blind: BlindFilter) -> None:
        self._tracks, self._particles, self._blind = tracks, tracks.particles, blind
        self.ln_none = LN_NONE
        self.innovations: list[MapInnovation] = []
        self._odometer_m = self._asked_s = 0.0
        self._asks_again = False
        self._last_moved: MovedFeature | None = None
        self._in_place_m = 0.0  # way driven when a feature was last found in place

    def begin_round(self, now_s: float, odometer_m: float) -> None:
        """Time of the drive and way driven of the next comparisons."""
        self._odometer_m, self._asks_again = odometer_m, now_s - self._asked_s >= ASK_EVERY_S
        if self._asks_again:
            self._asked_s = now_s

    def compare_if_due(self, feature: TrackedFeature, t_ns: int, *, out_of_view: bool) -> None:
        """Compare an estimated feature when its passage has ended; one that is undecided every second."""
        is_undecided = not self._particles.provisional[feature.estimated_in]
        if (not is_undecided or self._asks_again) and (out_of_view or feature.pass_hits >= SETTLE_HITS):
            self._compare(feature, t_ns)

    def decide_all(self, t_ns: int) -> None:
        """Nothing more will come: what is undecided is decided by what there is."""
        self._odometer_m = inf
        for feature in list(self._tracks.live):
            if self._tracks.awaits_map(feature) and not self._particles.provisional[feature.estimated_in]:
                self._compare(feature, t_ns)

    def forget_moves(self) -> None:
        """The place is searched for anew: steps from before do not count."""
        self._last_moved = None

    def _compare(self, feature: TrackedFeature, t_ns: int) -> None:
        """Compare with the position known otherwise, and take that in."""
        if (feature.known and not self._identify(feature, t_ns)) or feature.slot is None:
            return
        xy_m, cov = self._tracks.moments(feature)
        moved = self._is_elsewhere(feature, xy_m, cov)
        if feature.known and self._is_of_another_kind(feature):
            self._split(feature, t_ns)
            return
        if not feature.known:  # found on an earlier passage already
            if moved:
                self._particles.priors[feature.slot] = None
            else:
                self._tracks.settle(feature)
            feature.cov = None
            return
        self.innovations.append(innovation_of(feature, xy_m, cov * self._tracks.sensor.places))
        if moved and self._is_the_vehicle(feature, xy_m - feature.xy_m):
            self._search_anew(t_ns)  # and settle when the place has been found
        elif moved:
            self._split(feature, t_ns)
            return
        else:
            self._last_moved, self._in_place_m = None, feature.odometer_m
            before = feature.measured
            if self._tracks.sensor.learns:
                self._tracks.sensor.compared(innovation_of(feature, xy_m, cov).squared)
            feature.measured = (xy_m, cov) if before is None else fused_moments(before, (xy_m, cov))
        self._tracks.settle(feature)
        self._learn(feature)

    def _learn(self, feature: TrackedFeature) -> None:
        """What a feature that was found in place says about errors that stay with features."""
        if self._tracks.sensor.learns and feature.slot is not None and feature.pass_hits >= ENOUGH_HITS:
            errors = self._particles.errors_of(feature.slot, self._particles.weights())
            self._tracks.sensor.settled(*errors, feature.held)

    def _is_elsewhere(self, feature: TrackedFeature, xy_m: F64, cov: F64) -> bool:
        sensor, far = self._tracks.sensor, float(np.hypot(*(xy_m - feature.xy_m))) > MOVED_M
        if not far or not sensor.learns:
            return far and innovation_of(feature, xy_m, cov).squared > MOVED_GATE
        pose, _ = self._particles.pose(self._particles.weights())
        wide = cov * sensor.places + sensor.lasting(float(pose[2]))
        return innovation_of(feature, xy_m, wide).squared > MOVED_GATE

    def _is_of_another_kind(self, feature: TrackedFeature) -> bool:
        """Whether nearly all of its detections name a kind that the map does not."""
        total = sum(feature.named.values())
        kind, most = feature.named.most_common(1)[0] if total else (feature.kind, 0)
        return kind != feature.kind and total >= ENOUGH_HITS and most >= OTHER_KIND * total

    def _split(self, feature: TrackedFeature, t_ns: int) -> None:
        """A moved feature is a deleted one and a new one (section 2.3)."""
        xy_m, _ = self._tracks.moments(feature)
        kind = feature.named.most_common(1)[0][0] if feature.named else feature.kind
        found, hits = self._tracks.register(kind), feature.pass_hits
        found.xy_m, found.in_view_s, found.odometer_m = xy_m, feature.in_view_s, feature.odometer_m
        found.heights, feature.heights = feature.heights, found.heights
        self._tracks.hand_over(feature, found)
        self._last_moved = MovedFeature(feature, found, hits, xy_m - feature.xy_m, feature.odometer_m)
        self._tracks.recount(found, hits, 0, t_ns)
        self._tracks.recount(feature, feature.hits - hits, feature.misses + hits, t_ns)

    # Which estimate is which feature of the map

    def _identify(self, feature: TrackedFeature, t_ns: int) -> bool:
        """Give the estimates of features that stand close together to those of the map that they are; False: that is
        open, and until it is decided they do not weigh the particles.
        """
        group = self._group(feature)
        owned = sum(one.known for one in group)
        if len(group) < 2:
            return True
        slots = [one.estimated_in for one in group]
        best = best_identities(self._particles, slots, owned, self.ln_none)
        easier = best_identities(self._particles, slots, owned, LN_NONE_DOUBTED)
        clear = best.slots == easier.slots and min(best.lead, easier.lead) >= SURE
        if not clear and self._odometer_m - feature.odometer_m < UNDECIDED_M:
            for slot in slots[:owned]:
                self._particles.provisional[slot] = False
            return False
        found = list(zip(group, best.slots, strict=False))
        for one, slot in found:
            if slot == NONE:
                self._split(one, t_ns)
        for one, slot in found:
            if slot != NONE and (other := self._tracks.live[slot]) is not one:
                self._exchange(one, other, t_ns)
        return True

    def _group(self, feature: TrackedFeature) -> list[TrackedFeature]:
        """Features like this one around it that are being estimated, those of the map that await comparison first."""
        here = self._particles.mu[feature.estimated_in].mean(axis=0)
        reach_m = WIDE_GROUP_M if self._tracks.sensor.learns else GROUP_M
        alike = [
            one
            for one in self._tracks.live
            if one.kind == feature.kind
            and float(np.hypot(*(self._particles.mu[one.estimated_in].mean(axis=0) - here))) < reach_m
        ]
        unsettled = [one for one in alike if one.known and self._tracks.awaits_map(one)]
        most = max(one.pass_hits for one in alike)
        found = [one for one in alike if not one.known and one.cov is None]
        return unsettled + [one for one in found if one.pass_hits >= RIVAL_SHARE * most]

    def _exchange(self, one: TrackedFeature, other: TrackedFeature, t_ns: int) -> None:
        rest = [(each.hits - each.pass_hits, each.misses - each.pass_misses) for each in (one, other)]
        self._tracks.exchange(one, other)
        for each, (hits, misses) in zip((one, other), rest, strict=True):
            self._tracks.recount(each, hits + each.pass_hits, misses + each.pass_misses, t_ns)

    # Whether it is the vehicle that is elsewhere

    def _is_the_vehicle(self, feature: TrackedFeature, off_m: F64) -> bool:
        """Whether it is the vehicle that is off by (2,): others are off alike, and GNSS, wheels and gyro allow it."""
        others_m, last = self._others_off(feature), self._last_moved
        if last is not None and feature.odometer_m - last.odometer_m < RECENT_M:
            others_m.append(last.off_m)
        if not (self._particles.weighing and any(alike(off_m, other) for other in others_m)):
            return False
        pose, cov = self._particles.pose(self._particles.weights(without=(feature.slot or 0,)))
        belief = self._blind.belief
        there = pose[:2] - off_m - belief.mean[:2]
        squared = float(there @ np.linalg.solve((cov + belief.cov[:3, :3])[:2, :2], there))
        return squared < ALLOWED or not self._blind.has_fixes

    def _others_off(self, feature: TrackedFeature) -> list[F64]:
        """How far off (2,) other features of the map are that await comparison, and are not where they should be."""
        found = []
        for one in self._tracks.live:
            if one is not feature and one.known and self._tracks.awaits_map(one):
                xy_m, cov = self._tracks.moments(one, feature)
                if one.pass_hits >= ENOUGH_HITS and self._is_elsewhere(one, xy_m, cov):
                    found.append(xy_m - one.xy_m)
        return found

    def _search_anew(self, t_ns: int) -> None:
        """Take the last move back, and make the place uncertain."""
        last, self._last_moved = self._last_moved, None
        if last is not None and last.found in self._tracks.new and last.known in self._tracks.known:
            known, hits = last.known, last.hits
            self._tracks.hand_back(last.found, known)
            self._tracks.recount(known, known.hits + hits, known.misses - hits, t_ns)
        since = [one.estimated_in for one in self._tracks.live if one.odometer_m >= self._in_place_m]
        self._particles.loosen(since, LOOSE_M, LOOSE_RAD)


def alike(one_m: F64, other_m: F64) -> bool:
    """Whether two steps (2,) may be one."""
    lengths = float(np.hypot(*one_m)), float(np.hypot(*other_m))
    return min(lengths) > ALIKE * max(lengths) and float(one_m @ other_m) > ALIKE * lengths[0] * lengths[1]


def innovation_of(feature: TrackedFeature, xy_m: F64, cov: F64) -> MapInnovation:
    """Innovation of a measured position (2,) with covariance (2, 2) against the feature's position in the map."""
    assert feature.cov is not None
    off, total = xy_m - feature.xy_m, cov + feature.cov[[0, 1, 1, 2]].reshape(2, 2)
    squared = float(off @ np.linalg.solve(total, off))
    return MapInnovation(squared, -0.5 * squared - 0.5 * float(np.log((2.0 * np.pi) ** 2 * np.linalg.det(total))))


def fused_moments(one: tuple[F64, F64], other: tuple[F64, F64]) -> tuple[F64, F64]:
    """Two independent estimates (2,), (2, 2) made one."""
    gain = one[1] @ np.linalg.inv(one[1] + other[1])
    return one[0] + gain @ (other[0] - one[0]), one[1] - gain @ one[1]
