"""Hypotheses about features of a tile, built report by report: what each is, who measured it, who judged it."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from gnd.cloud_merger.features.association import costs, fits, pairs
from gnd.cloud_merger.features.memory import LayerMemory, Own, Remembered, Vote
from gnd.cloud_merger.features.parameters import FeatureMergeParameters
from gnd.cloud_merger.features.rls import PlaceEstimate, step
from gnd.cloud_merger.features.statements import Attributes, Claimed, Statement
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import Feature, feature_id_of
from gnd.gnd_map.features.lane_pieces import is_lane_piece, left_of
from gnd.schemas.feature_change import Seen

FEATURE_MOVED_M: Final = 0.3
"""A map feature that is measured outside the gate has moved only if it is farther off than this."""
FEATURE_MAX_BEGUN: Final = 128
"""A vehicle begins at most so many candidates in a tile; what else it finds must be known already."""

Bases = Mapping[bytes, Mapping[int, tuple[Feature, ...]]]


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """One report's measurement of a feature; `is_found`: anew, not as one of the map's."""

    vehicle: str
    place: PlaceEstimate
    is_found: bool
    attributes: Attributes


@dataclass(slots=True, eq=False)
class FeatureTrack:
    """A hypothesis about one feature.

    Attributes:
        feature_id: of the map's feature, or of who found it first.
        kind: of the feature.
        state: running estimate, for association; it takes every measurement as it comes.
        epoch: the map's feature; None: a candidate.
        quoted: a feature of a later version whose finders are no longer among the reports.
        measured: by number of the report.
        votes: by number of the report; numbers below 0 are those of witnesses of closed windows.
        repeats: how often each vehicle has measured it.
        before: the state that the closed windows leave.
        serial: its number among all of the tile.
        apart: serial numbers of those that a report of a closed window has distinguished from it.
    """

    feature_id: int
    kind: str
    state: PlaceEstimate
    epoch: Feature | None = None
    quoted: Feature | None = None
    measured: dict[int, Measured] = field(default_factory=dict)
    votes: dict[int, Vote] = field(default_factory=dict)
    repeats: dict[str, int] = field(default_factory=dict)
    before: Remembered | None = None
    serial: int = -1
    apart: set[int] = field(default_factory=set)

    @property
    def is_point(self) -> bool:
        """Whether it is a point, not a polyline."""
        return len(self.state.points_m) == 1

    @property
    def is_of_map(self) -> bool:
        """Whether the map, this or a later version of it, knows it."""
        return self.epoch is not None or self.quoted is not None

    def is_apart(self, other: "FeatureTrack") -> bool:
        """Whether a report has distinguished the two."""
        known = other.serial in self.apart or self.serial in other.apart
        return known or not self.votes.keys().isdisjoint(other.votes)

    @property
    def attributes(self) -> Attributes:
        """Those of the map, for what stands elsewhere now."""
        known = self.epoch or self.quoted
        return known.attributes if known else ()

    @property
    def first(self) -> int:
        """Number of the first report that speaks for it; -1 for one that is known from before."""
        return -1 if self.is_of_map or self.before is not None else min(self.measured, default=-1)

    @property
    def witnesses(self) -> int:
        """Vehicles that it rests on; the map counts as two."""
        return self.measurers + (2 if self.is_of_map else 0)

    @property
    def measurers(self) -> int:
        """Vehicles that have measured it."""
        return len(self.repeats) + (0 if self.before is None else self.before.n_forgotten)

    def measure(self, report: int, measured: Measured, parameters: FeatureMergeParameters) -> None:
        """Take a measurement. The n-th of one vehicle weighs what it adds to what n of them weigh."""
        n = self.repeats.get(measured.vehicle, 0) + 1
        adds = parameters.information_of(n) - parameters.information_of(n - 1)
        self.repeats[measured.vehicle] = n
        self.measured[report] = measured
        if adds > 0.0:
            self.state = step(self.state, measured.place.scaled(1.0 / adds))


class FeatureTracks:
    """All hypotheses about the features of a tile; statements are to come in the order of their report ids.

    Args:
        epoch: the map's features.
        bases: contents of the versions that reports refer to, by hash.
        parameters: of the merge.
        memory: of the closed windows; None: none is folded, so what is known is the epoch.
    """

    def __init__(
        self, epoch: Iterable[Feature], bases: Bases, parameters: FeatureMergeParameters, memory: LayerMemory | None
    ) -> None:
        self._parameters, self._bases = parameters, bases
        self.all: list[FeatureTrack] = []
        self._by_id: dict[int, list[FeatureTrack]] = {}
        self._begun: Counter[str] = Counter()
        self._n_serials = 0
        if memory is None:
            for feature in epoch:
                self._begin(_of_map(feature, epoch=feature))
        else:
            self._remember(memory)

    def _remember(self, memory: LayerMemory) -> None:
        """Begin with the state that the closed windows leave."""
        n = len(memory.witnesses)
        for one in memory.tracks:
            votes = {number - n: vote for number, vote in one.votes}
            self._begin(
                FeatureTrack(
                    one.feature_id, one.kind, one.state, one.epoch, one.quoted,
                    votes=votes, repeats=one.repeats, before=one, apart=set(one.apart),
                )
            )  # fmt: skip
            self._begun.update([one.finder] if one.finder else ())
        for one, track in zip(memory.tracks, self.all, strict=True):
            for name in one.names:
                self._by_id.setdefault(name, [track])

    def hear(self, report: int, statement: Statement) -> None:
        """Take all that one report says: verdicts first, then what is found among what it has not judged."""
        judged: set[int] = set()
        claims = list(statement.found)
        for seen in statement.seen:
            for track in self._named(seen.feature_id, statement.base_sha):
                judged.add(id(track))
                elsewhere = self._judge(track, report, statement, seen)
                claims += [] if elsewhere is None else [elsewhere]
        for kind, is_point in sorted({(one.kind, len(one.place.points_m) == 1) for one in claims}):
            like = [one for one in claims if (one.kind, len(one.place.points_m) == 1) == (kind, is_point)]
            self._associate(report, statement, like, judged)

    def _named(self, feature_id: int, base_sha: bytes | None) -> Sequence[FeatureTrack]:
        """The tracks of a map feature; one that only an old version names begins anew, quoted from there."""
        known = self._by_id.get(feature_id, [])
        if known or base_sha is None:
            return known
        for feature in self._bases.get(base_sha, {}).get(feature_id, ()):
            self._begin(_of_map(feature, quoted=feature))
        return self._by_id.get(feature_id, [])

    def _begin(self, track: FeatureTrack) -> FeatureTrack:
        track.serial, self._n_serials = self._n_serials, self._n_serials + 1
        self.all.append(track)
        self._by_id.setdefault(track.feature_id, []).append(track)
        return track

    def _judge(self, track: FeatureTrack, report: int, statement: Statement, seen: Seen) -> Claimed | None:
        """A verdict on a map feature; a claim when it was measured where that feature cannot be.

        Outside the gate the map's feature is not touched: what stands elsewhere is a candidate of its own. Who is right
        is decided when all have been heard (`settle`).
        """
        track.votes[report] = Vote(statement.vehicle, seen.existence, seen.hits)
        if seen.position_m is None or seen.cov_m2 is None or len(track.state.points_m) > 2:
            return None
        place = PlaceEstimate.of(_seen_at(track.state.points_m, seen.position_m), seen.cov_m2)
        if fits(place, track.state, self._parameters):
            track.measure(report, Measured(statement.vehicle, place, False, ()), self._parameters)
            return None
        apart = place.points_m[0] - track.state.points_m[0]
        if np.hypot(apart[0], apart[1]) <= FEATURE_MOVED_M or seen.existence.exist <= seen.existence.absent:
            return None
        name = feature_id_of(statement.report_id, "elsewhere", track.feature_id)
        track.votes[report] = Vote(statement.vehicle, seen.existence, seen.hits, elsewhere=name)
        return Claimed(name, track.kind, place, seen.existence, seen.hits, track.attributes, is_found=False)

    def _associate(self, report: int, statement: Statement, claims: Sequence[Claimed], judged: set[int]) -> None:
        """Claims of one kind and shape, one-to-one among the tracks that this report has not judged."""
        kind, is_point = claims[0].kind, len(claims[0].place.points_m) == 1
        # What a report names that has come before the finder's: the track is there under that very id.
        named = {
            i: track
            for i, one in enumerate(claims)
            for track in self._by_id.get(one.feature_id, [])[:1]
            if id(track) not in judged and report not in track.measured
        }
        rest = [i for i in range(len(claims)) if i not in named]
        open_to = [
            track
            for track in self.all
            if track.kind == kind
            and (len(track.state.points_m) == 1) == is_point
            and id(track) not in judged
            and report not in track.measured
            and not any(track is other for other in named.values())
        ]
        places, states = [claims[i].place for i in rest], [track.state for track in open_to]
        witnesses = [track.witnesses for track in open_to]
        named |= {rest[i]: open_to[j] for i, j in pairs(places, states, witnesses, self._parameters)}
        for i, claim in enumerate(claims):
            self._take(report, statement, claim, named.get(i))

    def _take(self, report: int, statement: Statement, claim: Claimed, track: FeatureTrack | None) -> None:
        measured = Measured(statement.vehicle, claim.place, claim.is_found, claim.attributes)
        if track is None:
            if self._begun[statement.vehicle] >= FEATURE_MAX_BEGUN:
                return
            self._begun[statement.vehicle] += 1
            track = self._begin(FeatureTrack(claim.feature_id, claim.kind, claim.place))  # NFL, Eq. (11)
            track.measured[report], track.repeats[statement.vehicle] = measured, 1
        else:
            self._by_id.setdefault(claim.feature_id, [track])
            track.measure(report, measured, self._parameters)
        track.votes[report] = Vote(statement.vehicle, claim.existence, claim.hits)

    def settle(self) -> None:
        """After the last report: join what turned out to be one, then let those vote against a map feature's place who
        measured it where several vehicles agree that it stands now.
        """
        self._join_all()
        for track in self.all:
            for report, vote in track.votes.items():
                there = self._by_id.get(vote.elsewhere, []) if vote.elsewhere else []
                if any(self._confirms(other) and other is not track for other in there):
                    track.votes[report] = vote.denied

    def _confirms(self, track: FeatureTrack) -> bool:
        return track.measurers >= self._parameters.min_vehicles

    def names_of(self) -> dict[int, list[int]]:
        """All ids under which each track (by `serial`) has been known, in the order in which they came."""
        names: dict[int, list[int]] = {}
        for name, tracks in self._by_id.items():
            for track in tracks:
                names.setdefault(track.serial, []).append(name)
        return names

    def _join_all(self) -> None:
        """Join hypotheses that may be one, the likeliest first: inside the gates of each other, not both the map's, and
        no report has distinguished them. Again with what came of it, until nothing changes.
        """
        while couples := [couple for late in self.all if (couple := self._partner(late)) is not None]:
            changed: set[int] = set()
            for _, early, late in sorted(couples, key=lambda couple: couple[0]):
                if changed.isdisjoint((id(early), id(late))):
                    self._join(early, late)
                    changed |= {id(early), id(late)}

    def _partner(self, late: FeatureTrack) -> tuple[float, FeatureTrack, FeatureTrack] | None:
        """The likeliest earlier hypothesis that may be the same as this one: (cost, earlier, this one)."""
        if late.epoch is not None:
            return None
        number = self.all.index(late)
        early = [track for track in self.all[:number] if _may_be_one(track, late)]
        if not early:
            return None
        cost = costs([late.state], [track.state for track in early], self._parameters)[0]
        k = int(np.argmin(cost))
        return (float(cost[k]), early[k], late) if np.isfinite(cost[k]) else None

    def _join(self, early: FeatureTrack, late: FeatureTrack) -> None:
        """All evidence of the later hypothesis counts for the earlier, in the order of the reports."""
        self.all.remove(late)
        early.apart |= late.apart
        for track in self.all:
            if late.serial in track.apart:
                track.apart.add(early.serial)
        for tracks in self._by_id.values():
            tracks[:] = [early if track is late else track for track in tracks]
        measured = sorted({**early.measured, **late.measured}.items())
        early.votes = dict(sorted({**early.votes, **late.votes}.items()))
        early.measured, early.repeats = {}, {}
        early.before = joined(early.before, late.before)
        known = early.epoch or early.quoted
        if early.before is not None:
            early.state = early.before.state
            early.repeats = early.before.repeats
        elif known is None:
            (number, first), *measured = measured
            early.state, early.measured[number], early.repeats[first.vehicle] = first.place, first, 1
        else:
            early.state = _place_of(known)
        for number, one in measured:
            early.measure(number, one, self._parameters)


def _seen_at(points_m: F64, position_m: F64) -> F64:
    """The points of a feature measured at a position; a piece of a line moves there as a whole, its middle first."""
    if not is_lane_piece(points_m):
        return position_m[None]
    left = left_of(points_m)
    return np.asarray(points_m + (position_m - points_m.mean(axis=0)) @ np.outer(left, left))


def _may_be_one(a: FeatureTrack, b: FeatureTrack) -> bool:
    return a.kind == b.kind and a.is_point == b.is_point and not a.is_apart(b)


def joined(early: Remembered | None, late: Remembered | None) -> Remembered | None:
    """The state of two hypotheses that turned out to be one."""
    if early is None or late is None:
        return early or late
    state = step(early.state, late.state)
    known = early.known if late.known is None else late.known if early.known is None else step(early.known, late.known)
    own = {one.vehicle: one for one in early.measured}
    for one in late.measured:
        other = own.get(one.vehicle)
        own[one.vehicle] = one if other is None else _together(other, one)
    is_late = late.is_published and not early.is_published
    return replace(
        early,
        state=state,
        shown=late.shown if is_late or early.shown is None else early.shown,
        is_published=early.is_published or late.is_published,
        is_settled=early.is_settled or late.is_settled,
        is_away=early.is_away and late.is_away,
        measured=tuple(own.values()),
        known=known,
        vehicles_before=early.vehicles_before + late.vehicles_before,
        ayes_before=early.ayes_before + late.ayes_before,
        hits_before=early.hits_before + late.hits_before,
        day=max(early.day, late.day),
        gone=tuple((dict(early.gone) | dict(late.gone)).items()),
        ayes_gone=tuple((dict(early.ayes_gone) | dict(late.ayes_gone)).items()),
    )


def _together(one: Own, other: Own) -> Own:
    place = step(one.place, other.place)
    is_finder = one.is_finder or other.is_finder
    return Own(
        one.vehicle, one.repeats + other.repeats, place, other.attributes, is_finder, one.earlier + other.earlier
    )


def _of_map(feature: Feature, epoch: Feature | None = None, quoted: Feature | None = None) -> FeatureTrack:
    return FeatureTrack(feature.feature_id, feature.kind, _place_of(feature), epoch, quoted)


def _place_of(feature: Feature) -> PlaceEstimate:
    return PlaceEstimate.of(feature.points_m, feature.cov_m2)
