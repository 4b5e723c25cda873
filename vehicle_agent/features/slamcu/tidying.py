"""What happens to features between looks: settled, moved, made one with another, given up."""

from math import inf
from typing import Final, NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.slamcu.blind import BlindFilter
from gnd.vehicle_agent.features.slamcu.doubt import DoubtStep, PlaceDoubt
from gnd.vehicle_agent.features.slamcu.existence_book import BookEntry, ExistenceBook, FeatureClass
from gnd.vehicle_agent.features.slamcu.identities import LN_NONE, LN_NONE_DOUBTED, NONE, best_identities
from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters
from gnd.vehicle_agent.features.slamcu.rbpf import Rbpf
from gnd.vehicle_agent.features.slamcu.tracked import Tracked

_MOVED_GATE: Final = 14.0
"""A map feature measured this far off (squared Mahalanobis) has moved: deleted here, new there. χ² of 2 degrees of
freedom, 99.9 %."""
_MOVED_M: Final = 2.0
"""And at least this far: less than a lane, more than a pose that is surer than it should be errs by."""
_SETTLE_S: Final = 0.5
"""A feature of the map is compared with its map position when it was out of view for this time."""
_SETTLE_HITS: Final = 60
"""Or when it was measured so often: at a red light nothing leaves the view."""
_HORIZON_FEATURES: Final = 32
"""At most this many features are kept in the particles; the oldest go first."""

SAME_GATE: Final = 9.0
"""Two features within this squared Mahalanobis distance may be one."""
SAME_M: Final = 4.0
"""And at most so far apart."""
ENOUGH_HITS: Final = 6
"""So many measurements of the two together tell whether they are ever measured at once."""
TOGETHER_SHARE: Final = 0.15
"""Two features that are measured at once in this share of the looks that could are two."""
GROUP_M: Final = 12.0
"""Features within this distance may be taken for each other: three lanes."""
SURE: Final = 3.0
"""Identities are decided when they are so much likelier than any others (natural logarithm), whichever of the two
prices a sign has that is gone while another stands in its place."""
ALLOWED: Final = 18.4
"""χ² of 2 degrees of freedom, one in 10,000: no two signs alike put the vehicle farther from its fixes than this."""
UNDECIDED_M: Final = 600.0
"""Or after so much way, in which further signs may have told where the vehicle was."""
ASK_EVERY_S: Final = 1.0
RIVAL_SHARE: Final = 0.25
"""What was measured less often than this share of what stands beside it is no feature of the map that was in view."""
GIVEN_UP: Final = 0.9
"""A new feature with this mass of absence is forgotten."""


class Innovation(NamedTuple):
    """How far from its place in the map a feature was measured."""

    squared: float
    """Mahalanobis distance, squared; 2 degrees of freedom."""
    ln_density: float
    """Natural logarithm of its density, 1/m^2."""


class Tidying:
    """Housekeeping of the features of a drive.

    Args:
        parameters: when features settle and leave.
        tracked: the features.
        rbpf: the particles.
        book: their masses.
        blind: where the vehicle is by what has never seen a feature.

    Attributes:
        ln_none: natural logarithm of the density of a feature that is gone while another stands in its place.
        told: what features of the map said when they were settled, until somebody takes it.
    """

    def __init__(
        self, parameters: SlamcuParameters, tracked: Tracked, rbpf: Rbpf, book: ExistenceBook, blind: BlindFilter
    ) -> None:
        self._p, self._tracked, self._rbpf, self._book, self._blind = parameters, tracked, rbpf, book, blind
        self._doubt = PlaceDoubt(tracked, rbpf, book)
        self.ln_none = LN_NONE
        self.told: list[Innovation] = []
        self._odometer_m = self._asked_s = 0.0

    def measured_together(self, detected: list[BookEntry]) -> None:
        """Remember which features were measured in one look."""
        for entry in detected:
            for other in detected:
                if other is not entry:
                    entry.together[other.key] += 1

    def tidy(self, now_s: float, odometer_m: float, t_ns: int, near: list[BookEntry]) -> None:
        """Everything that is due.

        Args:
            now_s: time of the drive.
            odometer_m: way driven.
            t_ns: UTC, for the masses over time.
            near: entries that may be in view.
        """
        self._odometer_m = odometer_m
        for entry in [entry for entry in near if not entry.known and entry in self._tracked.new]:
            self._give_up_or_unite(entry, near, t_ns)
        for entry in list(self._tracked.live):
            if entry.slot is None:
                continue
            out_of_view = now_s - entry.in_view_s > _SETTLE_S
            if self._rbpf.priors[entry.slot] is not None:
                if not self._rbpf.provisional[entry.slot] and now_s - self._asked_s < ASK_EVERY_S:
                    continue
                if out_of_view or entry.pass_hits >= _SETTLE_HITS:
                    self._settle(entry, t_ns)
            elif out_of_view:
                self._leave(entry, odometer_m)
        self._leave_oldest()
        if now_s - self._asked_s >= ASK_EVERY_S:
            self._asked_s = now_s

    def decide(self, t_ns: int) -> None:
        """Nothing more will come: what is undecided is decided by what there is."""
        self._odometer_m = inf
        for entry in list(self._tracked.live):
            if entry.slot is not None and self._rbpf.priors[entry.slot] and not self._rbpf.provisional[entry.slot]:
                self._settle(entry, t_ns)

    def let_go(self) -> None:
        """Estimate nothing any longer: what is new and exists stays where it is, what is not is forgotten."""
        for entry in list(self._tracked.live):
            if not entry.known and self._book.classify(entry) == FeatureClass.NEW:
                self._freeze(entry)
            elif not entry.known:
                self._tracked.drop(entry)
            else:
                self._tracked.leave(entry)
        self._doubt.forget()

    def _settle(self, entry: BookEntry, t_ns: int) -> None:
        """Compare with the position known otherwise, and take that in."""
        if (entry.known and not self._identify(entry, t_ns)) or entry.slot is None:
            return
        weights = self._rbpf.weights(without=(entry.slot,))
        xy_m, cov = self._rbpf.moments(entry.slot, weights)
        moved = self._moved(entry, xy_m, cov)
        if entry.known:
            self.told.append(innovation_of(entry, xy_m, cov))
        if not entry.known:
            self._take(entry, agrees=not moved)
        elif moved and self._is_it_me(entry, xy_m - entry.xy_m):
            self._doubt.look_anew(t_ns)  # and settle when the place has been found
            self._rbpf.settle(entry.slot)
        elif moved:
            self._split(entry, t_ns)
        else:
            self._doubt.found_in_place(entry.odometer_m)
            entry.seen = (xy_m, cov) if entry.seen is None else fused_moments(entry.seen, (xy_m, cov))
            self._rbpf.settle(entry.slot)

    def _is_it_me(self, entry: BookEntry, off_m: F64) -> bool:
        """Whether it is the vehicle that is off by (2,): others say so too, and GNSS, wheels and gyro allow it."""
        if not self._doubt.is_it_me(off_m, self._others_off(entry), entry.odometer_m):
            return False
        pose, cov = self._rbpf.pose(self._rbpf.weights(without=(entry.slot or 0,)))
        belief = self._blind.belief
        there = pose[:2] - off_m - belief.mean[:2]
        squared = float(there @ np.linalg.solve((cov + belief.cov[:3, :3])[:2, :2], there))
        return squared < ALLOWED or not self._blind.has_fixes

    def _others_off(self, entry: BookEntry) -> list[F64]:
        """How far off (2,) other features of the map are that are not where they should be, of those not settled."""
        found = []
        for one in self._tracked.live:
            if one is not entry and one.known and one.slot is not None and self._rbpf.priors[one.slot] is not None:
                xy_m, cov = self._rbpf.moments(one.slot, self._rbpf.weights(without=(one.slot, entry.slot or 0)))
                if one.pass_hits >= ENOUGH_HITS and self._moved(one, xy_m, cov):
                    found.append(xy_m - one.xy_m)
        return found

    def _take(self, entry: BookEntry, *, agrees: bool) -> None:
        """A new feature that was found on an earlier passage already, and settled."""
        assert entry.slot is not None
        if agrees:
            self._rbpf.settle(entry.slot)
        else:
            self._rbpf.priors[entry.slot] = None
        entry.cov = None

    def _identify(self, entry: BookEntry, t_ns: int) -> bool:
        """Give the estimates of features that stand close together to those of the map that they are; False: nobody can
        tell yet, and until then they tell nothing of where the vehicle is.
        """
        group = self._group(entry)
        owned = sum(one.known for one in group)
        if len(group) < 2:
            return True
        slots = [one.slot for one in group if one.slot is not None]
        best = best_identities(self._rbpf, slots, owned, self.ln_none)
        easier = best_identities(self._rbpf, slots, owned, LN_NONE_DOUBTED)
        clear = best.slots == easier.slots and min(best.lead, easier.lead) >= SURE
        if not clear and self._odometer_m - entry.odometer_m < UNDECIDED_M:
            for slot in slots[:owned]:
                self._rbpf.provisional[slot] = False
            return False
        found = list(zip(group, best.slots, strict=False))
        for feature, slot in found:
            if slot == NONE:
                self._split(feature, t_ns)
        for feature, slot in found:
            if slot != NONE and (other := self._tracked.live[slot]) is not feature:
                self._exchange(feature, other, t_ns)
        return True

    def _group(self, entry: BookEntry) -> list[BookEntry]:
        """Features like this one around it that are being estimated, those of the map that are not settled first."""
        alike = [one for one in self._tracked.live if one.kind == entry.kind and self._together(one, entry)]
        unsettled = [one for one in alike if one.known and one.slot is not None and self._rbpf.priors[one.slot]]
        most = max(one.pass_hits for one in alike)
        found = [one for one in alike if not one.known and one.cov is None]
        return unsettled + [one for one in found if one.pass_hits >= RIVAL_SHARE * most]

    def _together(self, one: BookEntry, other: BookEntry) -> bool:
        places = [self._rbpf.mu[each.slot].mean(axis=0) for each in (one, other)]
        return float(np.hypot(*(places[0] - places[1]))) < GROUP_M

    def _exchange(self, one: BookEntry, other: BookEntry, t_ns: int) -> None:
        rest = [(each.hits - each.pass_hits, each.misses - each.pass_misses) for each in (one, other)]
        self._tracked.exchange(one, other)
        for each, (hits, misses) in zip((one, other), rest, strict=True):
            self._book.recount(each, hits + each.pass_hits, misses + each.pass_misses, t_ns)

    def _moved(self, entry: BookEntry, xy_m: F64, cov: F64) -> bool:
        far = float(np.hypot(*(xy_m - entry.xy_m))) > _MOVED_M
        return far and innovation_of(entry, xy_m, cov).squared > _MOVED_GATE

    def _split(self, entry: BookEntry, t_ns: int) -> None:
        """A moved feature is a deleted one and a new one (section 2.3)."""
        assert entry.slot is not None
        xy_m, _ = self._rbpf.moments(entry.slot, self._rbpf.weights(without=(entry.slot,)))
        found, hits = self._tracked.register(entry.kind), entry.pass_hits
        found.xy_m, found.in_view_s, found.odometer_m = xy_m, entry.in_view_s, entry.odometer_m
        found.heights, entry.heights = entry.heights, found.heights
        self._tracked.hand_over(entry, found)
        self._doubt.moved(DoubtStep(entry, found, hits, xy_m - entry.xy_m, entry.odometer_m))
        self._book.recount(found, hits, 0, t_ns)
        self._book.recount(entry, entry.hits - hits, entry.misses + hits, t_ns)

    def _leave(self, entry: BookEntry, odometer_m: float) -> None:
        """Out of view: the map's features at once, new ones when they can learn little more."""
        if entry.known:
            self._tracked.leave(entry)
        elif self._book.classify(entry) != FeatureClass.NEW:
            self._tracked.drop(entry)
        elif odometer_m - entry.odometer_m > self._p.filter.horizon_m:
            self._freeze(entry)

    def _freeze(self, entry: BookEntry) -> None:
        assert entry.slot is not None
        entry.xy_m, cov = self._rbpf.moments(entry.slot, self._rbpf.weights())
        entry.cov = np.array([cov[0, 0], cov[0, 1], cov[1, 1]])
        self._tracked.leave(entry)

    def _leave_oldest(self) -> None:
        while len(self._tracked.live) > _HORIZON_FEATURES:
            oldest = min(self._tracked.live, key=lambda entry: entry.in_view_s)
            if oldest.known:
                self._tracked.leave(oldest)
            else:
                self._freeze(oldest)

    def _give_up_or_unite(self, entry: BookEntry, near: list[BookEntry], t_ns: int) -> None:
        if entry.masses[1] > GIVEN_UP:
            self._tracked.drop(entry)
            return
        for other in near:
            if other is not entry and other.kind == entry.kind and self._same(other, entry):
                self._unite(other, entry, t_ns)
                return

    def _same(self, other: BookEntry, entry: BookEntry) -> bool:
        """Whether a new feature is another one: at one place, and never measured at once."""
        if entry.slot is None or (not other.known and (other.slot is None or other.number > entry.number)):
            return False
        hits = min(entry.hits, max(other.pass_hits, 1))
        if entry.hits + other.pass_hits < ENOUGH_HITS or entry.together[other.key] > TOGETHER_SHARE * hits:
            return False
        weights = self._rbpf.weights()
        off, cov = self._apart(other, entry, weights)
        return float(np.hypot(*off)) < SAME_M and float(off @ np.linalg.solve(cov, off)) < SAME_GATE

    def _apart(self, other: BookEntry, entry: BookEntry, weights: F64) -> tuple[F64, F64]:
        """Mean (2,) and covariance (2, 2) of how far apart two features are."""
        assert entry.slot is not None
        mu, sigma = self._rbpf.mu[entry.slot], self._rbpf.sigma[entry.slot]
        if other.slot is not None:
            off, within = mu - self._rbpf.mu[other.slot], weights @ (sigma + self._rbpf.sigma[other.slot])
        else:
            off, within = mu - other.xy_m, weights @ sigma + (0.0 if other.cov is None else other.cov)
        mean = weights @ off
        off = off - mean
        return mean, (off * weights[:, None]).T @ off + within[[0, 1, 1, 2]].reshape(2, 2)

    def _unite(self, kept: BookEntry, other: BookEntry, t_ns: int) -> None:
        """Each look that measured one of them measured the feature, though the other was missed."""
        hits = kept.hits + other.hits
        self._tracked.unite(kept, other)
        kept.in_view_s = max(kept.in_view_s, other.in_view_s)
        kept.odometer_m = max(kept.odometer_m, other.odometer_m)
        kept.heights += other.heights
        self._book.recount(kept, hits, max(kept.misses - other.hits, 0), t_ns)
        self._tracked.drop(other)


def innovation_of(entry: BookEntry, xy_m: F64, cov: F64) -> Innovation:
    """What a measured position (2,) with covariance (2, 2) says of a feature whose position is known otherwise."""
    assert entry.cov is not None
    off, total = xy_m - entry.xy_m, cov + entry.cov[[0, 1, 1, 2]].reshape(2, 2)
    squared = float(off @ np.linalg.solve(total, off))
    return Innovation(squared, -0.5 * squared - 0.5 * float(np.log((2.0 * np.pi) ** 2 * np.linalg.det(total))))


def fused_moments(one: tuple[F64, F64], other: tuple[F64, F64]) -> tuple[F64, F64]:
    """Two independent estimates (2,), (2, 2) made one."""
    gain = one[1] @ np.linalg.inv(one[1] + other[1])
    return one[0] + gain @ (other[0] - one[0]), one[1] - gain @ one[1]
