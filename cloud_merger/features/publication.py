"""What of a hypothesis is published: decided report by report, so that nothing changes on one vehicle's word and
nothing moves by a hair.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from gnd.cloud_merger.features.association import HEIGHT_KNOWN_M2
from gnd.cloud_merger.features.drive_shift import DriveShift
from gnd.cloud_merger.features.existence import prior_of, verdict
from gnd.cloud_merger.features.lanes_shift import LateralShift
from gnd.cloud_merger.features.memory import Own, Vote
from gnd.cloud_merger.features.parameters import FeatureMergeParameters
from gnd.cloud_merger.features.rls import PlaceEstimate, balanced, estimate, fused, is_even, step
from gnd.cloud_merger.features.shapes import length_of
from gnd.cloud_merger.features.statements import Attributes
from gnd.cloud_merger.features.tracks import FeatureTrack, Measured
from gnd.gnd_map.features import Existence, Feature, full_covariance, geodetic_in_tile
from gnd.gnd_map.features.feature import MAX_COUNT
from gnd.gnd_map.features.lane_pieces import is_lane_piece
from gnd.gnd_map.tile_id import TileId

FEATURE_VOTERS: Final = 6
"""Of the vehicles that speak of a feature, the so many whose reports are newest vote: so a world that changes again is
followed."""
FEATURE_MOST_WEIGHT: Final = 4.0
"""A vehicle that claims to be surer than all others (and the map) weighs at most this times the second surest, until
another is as sure."""
FEATURE_RENEWAL_MASS: Final = 0.1
"""Published masses are renewed when "exist" has changed by more than this."""

_LEAST_ADDED: Final = 1e-6


@dataclass(frozen=True, slots=True)
class Outcome:
    """What has come of a hypothesis.

    Attributes:
        published: the feature as it is to be published; None: not at all.
        estimate: all that is known of it now, published or not.
        reports: numbers of the reports that speak for what is published, or for its removal.
        is_decided: what is published is not what was published before.
    """

    published: Feature | None
    estimate: Feature
    reports: tuple[int, ...]
    is_decided: bool


def story_of(tile: TileId, track: FeatureTrack, parameters: FeatureMergeParameters) -> "Story":
    """What becomes of a hypothesis, report by report."""
    story = Story(tile, track, parameters)
    for report in sorted(track.votes.keys() | track.measured.keys()):
        if report >= 0:
            story.take(report)
    return story


@dataclass(frozen=True, slots=True)
class _Cast:
    """A vehicle's vote, of which report, and what it weighs: its evidence, discounted."""

    report: int
    vote: Vote
    weight: Existence


class Story:
    """A hypothesis after some of its reports; see `Remembered` for the attributes."""

    def __init__(self, tile: TileId, track: FeatureTrack, parameters: FeatureMergeParameters) -> None:
        self.track, self._tile, self._parameters = track, tile, parameters
        known, before = track.epoch, track.before
        self.known = None if known is None else PlaceEstimate.of(known.points_m, known.cov_m2)
        self.shown: Feature | None = known
        self.is_published, self.is_away = known is not None, False
        self.is_settled = track.is_of_map or not track.is_point
        self.measured: dict[str, Own] = {}
        self.last: dict[str, int] = {}  # number of each vehicle's newest measurement
        self.votes: dict[str, _Cast] = {}  # the newest of each vehicle, the newest last
        self.vehicles_before = self.ayes_before = self.hits_before = 0
        self.gone: dict[str, int] = {}
        self.ayes_gone: dict[str, int] = {}
        if before is not None:
            self.known, self.shown, self.is_published = before.known, before.shown, before.is_published
            self.is_settled, self.is_away = before.is_settled, before.is_away
            self.measured = {own.vehicle: own for own in before.measured}
            self.vehicles_before, self.ayes_before = before.vehicles_before, before.ayes_before
            self.hits_before = before.hits_before
            self.gone, self.ayes_gone = dict(before.gone), dict(before.ayes_gone)
        self._before = self.shown if self.is_published else None
        self._prior = prior_of(track)
        self.masses = self._prior
        self._state: PlaceEstimate | None = self.known
        self._shift: DriveShift | LateralShift
        self._begin_shift()
        self._is_stale = bool(self.measured)
        self._longest_m = max((length_of(place.points_m) for place in self._places()), default=0.0)
        self._least_m2 = {vehicle: self._fused(own).least_m2 for vehicle, own in self.measured.items()}
        self._is_even = self._even()
        self._first_confirmed: PlaceEstimate | None = None
        if before is not None:
            self._recall()

    def _recall(self) -> None:
        """Hear the votes of closed windows again: what the newest reports show may give them another meaning."""
        for number in sorted(n for n in self.track.votes if n < 0):
            self._cast(number)
        self._weigh()
        if self.is_away:
            return
        self._confirm()
        self._decide()
        self._go_home()

    def _places(self) -> list[PlaceEstimate]:
        return [*([] if self.known is None else [self.known]), *(own.place for own in self.measured.values())]

    def take(self, report: int) -> None:
        """One more report."""
        is_new = False
        if report in self.track.measured:
            is_new = self._measure(report, self.track.measured[report])
        if report in self.track.votes:
            self._cast(report)
        if self.is_away:
            return  # only who measured it is remembered
        self._weigh()
        self._decide()
        if self.is_published:
            self._renew(is_new)
        self._go_home()

    def _cast(self, report: int) -> None:
        vote = self.track.votes[report]
        self.votes.pop(vote.vehicle, None)
        if vote.vehicle in self.ayes_gone:  # it is back
            self.ayes_before, self.hits_before = (
                self.ayes_before - 1,
                self.hits_before - self.ayes_gone.pop(vote.vehicle),
            )
        self.votes[vote.vehicle] = _Cast(report, vote, vote.existence.discounted(self._parameters.reliability))

    def _weigh(self) -> None:
        self.masses = verdict(self._prior, (cast.weight for cast in self._newest()))

    def _measure(self, report: int, measured: Measured) -> bool:
        """Whether the vehicle measures it for the first time."""
        vehicle, own = measured.vehicle, self.measured.get(measured.vehicle)
        earlier = self.gone.pop(vehicle, 0) if own is None else own.earlier
        place = measured.place if earlier == 0 else measured.place.scaled(1.0 / max(self._adds(earlier), _LEAST_ADDED))
        is_new = own is None and earlier == 0
        if own is None:
            self.vehicles_before -= earlier > 0
            own = Own(vehicle, 1, place, measured.attributes, measured.is_found, earlier)
        else:
            is_finder = own.is_finder or measured.is_found
            own = Own(vehicle, own.repeats + 1, step(own.place, place), measured.attributes, is_finder, earlier)
        self.measured[vehicle], self.last[vehicle] = own, report
        length_m = length_of(place.points_m)
        is_longer = self.grows and length_m > self._longest_m
        self._longest_m = max(self._longest_m, length_m)
        self._least_m2[vehicle] = self._fused(own).least_m2
        was_even, self._is_even = self._is_even, self._even()
        if not is_new or is_longer or self.is_away or not (was_even and self._is_even):
            self._is_stale = True
        elif not self._is_stale:
            self._state = place if self._state is None else step(self._state, place)
            self._shift_by([place])
        self._confirm()
        return is_new

    def _confirm(self) -> None:
        """Take down where it lies when enough vehicles have found it."""
        finders = sum(own.is_finder for own in self.measured.values())
        if not self.is_settled and finders >= self._parameters.min_vehicles:
            self._first_confirmed = self.place()

    @property
    def grows(self) -> bool:
        """Whether it takes the vertices of the longest piece that anybody has measured: the map's own stay."""
        return self.track.epoch is None

    def _even(self) -> bool:
        known_m2 = None if self.known is None else self.known.least_m2
        return is_even(list(self._least_m2.values()), known_m2, FEATURE_MOST_WEIGHT)

    def _adds(self, earlier: int) -> float:
        """What one more measurement of a vehicle weighs beside so many."""
        return self._parameters.information_of(earlier + 1) - self._parameters.information_of(earlier)

    def _fused(self, own: Own) -> PlaceEstimate:
        return fused(own.place, own.repeats, self._parameters.information_of(own.repeats))

    def place(self) -> PlaceEstimate:
        """The estimate of all vehicles, each with what its measurements say together and a shift of its own."""
        state, added_m2 = self._unshifted(), self._shift.added_m2()
        if not added_m2.any():
            return state
        cov = state.cov_m2.copy()
        cov[:2, :2] += added_m2
        return PlaceEstimate(state.points_m, cov)

    def _unshifted(self) -> PlaceEstimate:
        """The same, if each drive's covariance were all that it is off by."""
        if self._is_stale or self._state is None:
            each = list(self.balanced().values())
            self._state, self._is_stale = self._estimate(list(each)), False
            self._begin_shift()
            self._shift_by(each)
        return self._state

    @property
    def _known_drives(self) -> int:
        """How many vehicles' measurements what is known already holds."""
        epoch = self.track.epoch
        return max(self.vehicles_before + (0 if epoch is None else epoch.vehicles), 1)

    def _begin_shift(self) -> None:
        """Begin to compare drives: points in two dimensions, pieces of lines across; other polylines not at all."""
        self._shift = LateralShift() if is_lane_piece(self.track.state.points_m) else DriveShift()
        self._shift_by([] if self.known is None else [self.known], self._known_drives)

    def _shift_by(self, places: Iterable[PlaceEstimate], drives: int = 1) -> None:
        for place in places if len(self.track.state.points_m) <= 2 else ():
            self._shift.add(place, drives)

    def balanced(self) -> dict[str, PlaceEstimate]:
        """What the measurements of each vehicle say together, and weigh beside those of the others."""
        each = [self._fused(own) for own in self.measured.values()]
        return dict(zip(self.measured, balanced(each, self.known, FEATURE_MOST_WEIGHT), strict=True))

    def _estimate(self, each: list[PlaceEstimate]) -> PlaceEstimate:
        known = self.known
        if not each and known is None:
            return self.track.state  # quoted from an older version, measured by nobody since
        if self.grows and known is not None and len(known.points_m) > 1:
            each, known = [known, *each], None
        each.sort(key=lambda place: -length_of(place.points_m))  # the longest piece of a line lends its vertices
        return estimate(each, known)

    def _newest(self) -> list[_Cast]:
        return list(self.votes.values())[-FEATURE_VOTERS:]

    def _sides(self) -> tuple[list[int], list[int]]:
        """Reports that vote for it, and against it; one a vehicle."""
        newest = [(cast.report, cast.vote.existence.state) for cast in self._newest()]
        return [r for r, state in newest if state == "exist"], [r for r, state in newest if state == "absent"]

    def _decide(self) -> None:
        """Published when enough different vehicles say that it exists and their mass wins; gone likewise."""
        ayes, noes = self._sides()
        state = self.masses.state
        if not self.is_published and len(ayes) >= self._parameters.min_vehicles and state == "exist":
            self.is_published, self.shown = True, self.shown or self._first_shown()
        elif self.is_published and len(noes) >= self._parameters.min_vehicles and state == "absent":
            self.is_published = False

    @property
    def _n_measured(self) -> int:
        return len(self.measured) + self.vehicles_before

    def _first_shown(self) -> Feature:
        quoted = self.track.quoted
        enough = self._n_measured >= self._parameters.min_vehicles
        return self.now() if quoted is None or enough else replace(quoted, existence=self.masses)

    def _renew(self, is_new: bool) -> None:
        shown = self.shown
        assert shown is not None  # what is published is shown
        enough = self._n_measured >= self._parameters.min_vehicles
        if is_new and enough and self._is_worth_it(shown):
            self.shown = self.now()
            return
        ayes, noes = self._sides()
        change = self.masses.exist - shown.existence.exist
        agree = len(ayes if change > 0 else noes) >= self._parameters.min_vehicles
        if agree and abs(change) > FEATURE_RENEWAL_MASS:
            self.shown = replace(shown, existence=self.masses)

    def _is_worth_it(self, shown: Feature) -> bool:
        """Whether the estimate is surer than the published one by the gain, or less sure, or farther from it than its
        sigma.
        """
        place, was = self.place(), full_covariance(shown.cov_m2)
        gain = self._parameters.renewal_gain
        before, after = (np.minimum(np.diag(cov), HEIGHT_KNOWN_M2) for cov in (was, place.cov_m2))
        without_shift = np.minimum(np.diag(self._unshifted().cov_m2), HEIGHT_KNOWN_M2)
        if gain == 1.0 or (before >= gain * without_shift * (1 - 1e-9)).any() or (after > gain * before).any():
            return True
        if len(place.points_m) != len(shown.points_m):
            return True
        apart = (place.points_m - shown.points_m).T
        return bool((apart * np.linalg.solve(was, apart)).sum(axis=0).max() > 1.0)

    def now(self) -> Feature:
        """The feature as all reports so far have it."""
        place, known = self.place(), self.track.epoch or self.track.quoted
        ayes = [cast.vote for cast in self.votes.values() if cast.vote.existence.state == "exist"]
        hits, n_ayes = self.hits_before + sum(vote.hits for vote in ayes), self.ayes_before + len(ayes)
        begun = known or Feature(
            self.track.feature_id, self.track.kind, place.points_m, place.six(), attributes=self._agreed()
        )
        return replace(
            begun,
            points_m=place.points_m,
            cov_m2=place.six(),
            existence=self.masses,
            hits=min(hits + begun.hits, MAX_COUNT),
            vehicles=max(min(n_ayes, MAX_COUNT), begun.vehicles),
        )

    def _agreed(self) -> Attributes:
        """What enough vehicles say of it, and more than say otherwise; of each vehicle its newest word."""
        newest = [own.attributes for own in self.measured.values()]
        counts = Counter(pair for attributes in newest for pair in attributes)
        of_key: dict[str, list[tuple[int, str]]] = {}
        for (key, value), n in counts.items():
            of_key.setdefault(key, []).append((-n, value))
        best = {key: min(values) for key, values in of_key.items()}
        return tuple((key, value) for key, (n, value) in sorted(best.items()) if -n >= self._parameters.min_vehicles)

    def _go_home(self) -> None:
        """Decide to which tile it belongs: that where it lay when it was first confirmed by vehicles that found it."""
        if self.is_settled or self._first_confirmed is None:
            return
        place, self.is_settled = self._first_confirmed, True
        lat, lon, _ = geodetic_in_tile(self._tile, place.points_m)
        self.is_away = TileId.from_geodetic(float(lat[0]), float(lon[0])) != self._tile

    def outcome(self) -> Outcome | None:
        """What has come of it; None when it is the neighbour's."""
        if self.is_away:
            return None
        published = self.shown if self.is_published else None
        return Outcome(published, self.now(), self._witnesses(), published is not self._before)

    def _witnesses(self) -> tuple[int, ...]:
        """Reports on the winning side."""
        state = "exist" if self.is_published else "absent"
        return tuple(sorted(cast.report for cast in self.votes.values() if cast.vote.existence.state == state))
