"""What of a hypothesis is published: decided report by report, so that nothing changes on one vehicle's word and
nothing moves by a hair.
"""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from cloud_merger.features.association import HEIGHT_KNOWN_M2
from cloud_merger.features.existence import prior_of, verdict
from cloud_merger.features.parameters import FeatureMergeParameters
from cloud_merger.features.rls import Place, balanced, estimate, fused, is_even, step
from cloud_merger.features.shapes import length_of
from cloud_merger.features.statements import Attributes
from cloud_merger.features.tracks import Measured, Track, Vote
from gnd_map.features import Existence, Feature, full_covariance, geodetic_in_tile
from gnd_map.features.feature import MAX_COUNT
from gnd_map.tile_id import TileId


@dataclass(frozen=True, slots=True)
class Outcome:
    """What has come of a hypothesis.

    Attributes:
        published: the feature as it is to be published; None: not at all.
        estimate: all that is known of it now, published or not.
        reports: numbers of the reports that speak for what is published, or for its removal.
    """

    published: Feature | None
    estimate: Feature
    reports: tuple[int, ...]


def outcome_of(tile: TileId, track: Track, parameters: FeatureMergeParameters) -> Outcome | None:
    """What has come of a hypothesis; None when it is the neighbour's."""
    story = _Story(track, parameters)
    for report in sorted(track.votes.keys() | track.measured.keys()):
        story.take(report)
        if not story.is_home(tile):
            return None
    return Outcome(story.shown if story.is_published else None, story.now(), story.witnesses())


@dataclass(frozen=True, slots=True)
class _Cast:
    """A vehicle's vote, of which report, and what it weighs: its evidence, discounted."""

    report: int
    vote: Vote
    weight: Existence


class _Story:
    """A hypothesis after some of its reports."""

    def __init__(self, track: Track, parameters: FeatureMergeParameters) -> None:
        self._track, self._parameters = track, parameters
        known = track.epoch
        self._known = None if known is None else Place.of(known.points_m, known.cov_m2)
        self.shown: Feature | None = track.epoch
        self.is_published = known is not None
        self._prior = prior_of(track, parameters)
        self._masses = self._prior
        self._votes: dict[str, _Cast] = {}  # the newest of each vehicle, the newest last
        self._measured: dict[str, list[Measured]] = {}
        self._state: Place | None = self._known
        self._is_stale = False
        self._longest_m = 0.0  # of the measured polylines
        self._least_m2 = [] if self._known is None else [self._known.least_m2]
        self._is_even, self._has_repeats = True, False
        self._finders: set[str] = set()
        self._first_confirmed: Place | None = None
        known = track.epoch or track.quoted
        self._is_settled = known is not None or len(track.state.points_m) > 1

    def take(self, report: int) -> None:
        """One more report."""
        is_new = False
        if report in self._track.measured:
            is_new = self._measure(self._track.measured[report])
        if report in self._track.votes:
            vote = self._track.votes[report]
            self._votes.pop(vote.vehicle, None)
            self._votes[vote.vehicle] = _Cast(report, vote, vote.existence.discounted(self._parameters.reliability))
            self._masses = verdict(self._prior, (cast.weight for cast in self._newest()), self._parameters)
        self._decide()
        if self.is_published:
            self._renew(is_new)

    def _measure(self, measured: Measured) -> bool:
        """Whether the vehicle measures it for the first time."""
        own = self._measured.setdefault(measured.vehicle, [])
        own.append(measured)
        length_m = length_of(measured.place.points_m)
        is_longer = self._known is None and length_m > self._longest_m
        self._longest_m = max(self._longest_m, length_m)
        self._least_m2.append(measured.place.least_m2)
        was_even, self._is_even = self._is_even, is_even(self._least_m2, self._parameters.most_weight)
        self._has_repeats |= len(own) > 1
        if self._has_repeats or is_longer or not (was_even and self._is_even):
            self._is_stale = True
        elif not self._is_stale:
            self._state = measured.place if self._state is None else step(self._state, measured.place)
        self._finders |= {measured.vehicle} if measured.is_found else set()
        if not self._is_settled and len(self._finders) >= self._parameters.min_vehicles:
            self._first_confirmed = self._place()
        return len(own) == 1

    def _place(self) -> Place:
        """The estimate of all vehicles, each with what its measurements say together."""
        if self._is_stale or self._state is None:
            each = [
                fused([one.place for one in own], self._parameters.information_of(len(own)))
                for own in self._measured.values()
            ]
            each.sort(key=lambda place: -length_of(place.points_m))  # the longest piece of a line lends its vertices
            self._state, self._is_stale = self._estimate(each), False
        return self._state

    def _estimate(self, each: list[Place]) -> Place:
        if not each and self._known is None:
            return self._track.state  # quoted from an older version, measured by nobody since
        return estimate(balanced(each, self._known, self._parameters.most_weight), self._known)

    def _newest(self) -> list[_Cast]:
        return list(self._votes.values())[-self._parameters.voters :]

    def _sides(self) -> tuple[list[int], list[int]]:
        """Reports that vote for it, and against it; one a vehicle."""
        newest = [(cast.report, cast.vote.existence.state) for cast in self._newest()]
        return [r for r, state in newest if state == "exist"], [r for r, state in newest if state == "absent"]

    def _decide(self) -> None:
        """Published when enough different vehicles say that it exists and their mass wins; gone likewise."""
        ayes, noes = self._sides()
        state = self._masses.state
        if not self.is_published and len(ayes) >= self._parameters.min_vehicles and state == "exist":
            self.is_published, self.shown = True, self.shown or self._first_shown()
        elif self.is_published and len(noes) >= self._parameters.min_vehicles and state == "absent":
            self.is_published = False

    def _first_shown(self) -> Feature:
        quoted = self._track.quoted
        enough = len(self._measured) >= self._parameters.min_vehicles
        return self.now() if quoted is None or enough else replace(quoted, existence=self._masses)

    def _renew(self, is_new: bool) -> None:
        shown = self.shown
        assert shown is not None  # what is published is shown
        enough = len(self._measured) >= self._parameters.min_vehicles
        if is_new and enough and self._is_worth_it(shown):
            self.shown = self.now()
            return
        ayes, noes = self._sides()
        change = self._masses.exist - shown.existence.exist
        agree = len(ayes if change > 0 else noes) >= self._parameters.min_vehicles
        if agree and abs(change) > self._parameters.renewal_mass:
            self.shown = replace(shown, existence=self._masses)

    def _is_worth_it(self, shown: Feature) -> bool:
        """Whether the estimate is surer than the published one by the gain, or farther from it than its sigma."""
        place, was = self._place(), full_covariance(shown.cov_m2)
        gain = self._parameters.renewal_gain
        before, after = (np.minimum(np.diag(cov), HEIGHT_KNOWN_M2) for cov in (was, place.cov_m2))
        if gain == 1.0 or (before >= gain * after * (1 - 1e-9)).any():
            return True
        if len(place.points_m) != len(shown.points_m):
            return True
        apart = (place.points_m - shown.points_m).T
        return bool((apart * np.linalg.solve(was, apart)).sum(axis=0).max() > 1.0)

    def now(self) -> Feature:
        """The feature as all reports so far have it."""
        place, known = self._place(), self._track.epoch or self._track.quoted
        ayes = [cast.vote for cast in self._votes.values() if cast.vote.existence.state == "exist"]
        hits = sum(vote.hits for vote in ayes)
        begun = known or Feature(
            self._track.feature_id, self._track.kind, place.points_m, place.six(), attributes=self._agreed()
        )
        return replace(
            begun,
            points_m=place.points_m,
            cov_m2=place.six(),
            existence=self._masses,
            hits=min(hits + begun.hits, MAX_COUNT),
            vehicles=max(len(ayes), begun.vehicles),
        )

    def _agreed(self) -> Attributes:
        """What enough vehicles say of it, and more than say otherwise; of each vehicle its newest word."""
        newest = [own[-1].attributes for own in self._measured.values()]
        said = Counter(pair for attributes in newest for pair in attributes)
        of_key: dict[str, list[tuple[int, str]]] = {}
        for (key, value), n in said.items():
            of_key.setdefault(key, []).append((-n, value))
        best = {key: min(values) for key, values in of_key.items()}
        return tuple((key, value) for key, (n, value) in sorted(best.items()) if -n >= self._parameters.min_vehicles)

    def is_home(self, tile: TileId) -> bool:
        """Whether it belongs to this tile: it lay here when it was first confirmed by vehicles that found it."""
        if self._is_settled or self._first_confirmed is None:
            return True
        place, self._is_settled = self._first_confirmed, True
        lat, lon, _ = geodetic_in_tile(tile, place.points_m)
        return TileId.from_geodetic(float(lat[0]), float(lon[0])) == tile

    def witnesses(self) -> tuple[int, ...]:
        """Reports on the winning side."""
        state = "exist" if self.is_published else "absent"
        return tuple(sorted(cast.report for cast in self._votes.values() if cast.vote.existence.state == state))
