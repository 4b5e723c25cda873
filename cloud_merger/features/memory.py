"""What a tile of a feature layer remembers of its closed windows: of each feature the state of its estimators.

Existence and place are recursive estimates, so they can be carried on: of a feature the votes of the vehicles that
spoke last, the joint measurement of each of the last vehicles (so that one more of the same vehicle
weighs what it adds), and those of all before as one place. What is carried is bounded of each feature, and of what a
vehicle alone has found by vehicle: neither grows with the number of reports.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import zstandard

from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.features.rls import PlaceEstimate
from gnd.cloud_merger.features.statements import Attributes
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.bounded import json_value, zstd_unpacked
from gnd.gnd_map.features import Existence, Feature

_FORMAT: Final = 1
_LEVEL: Final = 3
_MAX_BYTES: Final = 1 << 25
"""Unpacked: eight kilobytes for each of a tile's 4096 features."""


@dataclass(frozen=True, slots=True)
class Vote:
    """One report's verdict on a feature.

    Attributes:
        vehicle: whose.
        existence: its evidence, not discounted.
        hits: looks that detected it.
        elsewhere: name of the claim that the feature stands in another place now; 0: none. It counts as one against
            the feature when several vehicles measure it there.
    """

    vehicle: str
    existence: Existence
    hits: int = 0
    elsewhere: int = 0

    @property
    def denied(self) -> "Vote":
        """The same against the feature."""
        masses = self.existence
        return Vote(self.vehicle, Existence(masses.absent, masses.exist, masses.unknown), self.hits)


@dataclass(frozen=True, slots=True, eq=False)
class Own:
    """The measurements of one vehicle, fused.

    Attributes:
        vehicle: whose.
        repeats: how many.
        place: recursive estimate of them, as if their errors had nothing in common.
        attributes: its newest word.
        is_finder: it found the feature anew.
        earlier: how many of its measurements are in `Remembered.known`; these here weigh what they add to those.
    """

    vehicle: str
    repeats: int
    place: PlaceEstimate
    attributes: Attributes = ()
    is_finder: bool = False
    earlier: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Remembered:
    """A feature, or what may be one, after the closed windows.

    Attributes:
        feature_id: its id.
        kind: of it.
        names: other ids under which reports have known it, the newest last.
        state: running estimate for association.
        epoch: the map's feature; None: it is none.
        quoted: a feature of a later version that nobody here has found.
        shown: as it is published, or was last; None: never.
        is_published: whether it is.
        is_settled: whether it is decided to which tile it belongs.
        is_away: it belongs to the neighbour.
        votes: (number of a witness, its vote), one a vehicle, the newest last.
        measured: of the vehicles that measured it last, in the order of their first measurements.
        known: the map's place with the measurements of all vehicles before those; None: neither.
        vehicles_before: how many these are, ...
        ayes_before: ... how many whose votes are no longer among `votes` voted that it exists, ...
        hits_before: ... and their looks.
        gone: of the newest of those vehicles how often each has measured it: it may come back, ...
        ayes_gone: ... and of the newest of those votes whose and with how many looks.
        apart: numbers of those with which it is not one: a report has distinguished them.
        day: `gnd.gnd_map.day` of the newest receipt of a report that speaks for it.
    """

    feature_id: int
    kind: str
    names: tuple[int, ...]
    state: PlaceEstimate
    epoch: Feature | None
    quoted: Feature | None
    shown: Feature | None
    is_published: bool
    is_settled: bool
    is_away: bool
    votes: tuple[tuple[int, Vote], ...]
    measured: tuple[Own, ...]
    known: PlaceEstimate | None
    vehicles_before: int
    ayes_before: int
    hits_before: int
    apart: frozenset[int]
    day: int
    gone: tuple[tuple[str, int], ...] = ()
    ayes_gone: tuple[tuple[str, int], ...] = ()

    @property
    def repeats(self) -> dict[str, int]:
        """How often each vehicle has measured it, as far as that is known."""
        return dict(self.gone) | {own.vehicle: own.earlier + own.repeats for own in self.measured}

    @property
    def n_forgotten(self) -> int:
        """How many vehicles have measured it of which nothing else is known."""
        return max(self.vehicles_before - len(self.gone), 0)

    @property
    def is_of_map(self) -> bool:
        """Whether the map, this or a later version of it, knows it."""
        return self.epoch is not None or self.quoted is not None

    @property
    def finder(self) -> str:
        """The only vehicle that has measured it, where that has never been published; else ""."""
        alone = self.shown is None and not self.is_of_map and self.vehicles_before == 0 and len(self.measured) == 1
        return self.measured[0].vehicle if alone else ""


@dataclass(frozen=True, slots=True, eq=False)
class LayerMemory:
    """See the module's head.

    Attributes:
        tracks: of each feature; in the order in which they began.
        witnesses: reports of closed windows that votes are of, in the order in which they were heard.
    """

    tracks: tuple[Remembered, ...] = ()
    witnesses: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for track in self.tracks:
            numbers = [number for number, _ in track.votes]
            if any(not 0 <= number < len(self.witnesses) for number in numbers):
                raise MergerError(f"votes of witnesses {numbers}, there are {len(self.witnesses)}")
            if any(not 0 <= other < len(self.tracks) for other in track.apart):
                raise MergerError(f"a feature apart from {sorted(track.apart)}, there are {len(self.tracks)}")

    def encode(self) -> bytes:
        """Bytes for the store: JSON, zstd. Floats come back bit for bit."""
        features = _MemoryTable()
        tracks = [_track_row(track, features) for track in self.tracks]
        row = {"format": _FORMAT, "witnesses": self.witnesses, "features": features.rows, "tracks": tracks}
        return zstandard.ZstdCompressor(level=_LEVEL).compress(json.dumps(row, separators=(",", ":")).encode())

    @classmethod
    def decode(cls, body: bytes) -> "LayerMemory":
        """The memory in `body`.

        Raises:
            MergerError: it is damaged or of another format.
        """
        try:
            row = json_value(zstd_unpacked(body, _MAX_BYTES))
            if row["format"] != _FORMAT:
                raise MergerError(f"a memory of layers of format {row['format']}, this release reads {_FORMAT}")
            features = [_feature(one) for one in row["features"]]
            return cls(tuple(_remembered(one, features) for one in row["tracks"]), tuple(row["witnesses"]))
        except (ValueError, KeyError, TypeError, IndexError) as error:
            raise MergerError(f"a memory of {len(body)} bytes cannot be read: {error}") from error


class _MemoryTable:
    """Features, each once: what is published is mostly what the map has."""

    def __init__(self) -> None:
        self.rows: list[Any] = []
        self._number: dict[Feature, int] = {}

    def number(self, feature: Feature | None) -> int:
        if feature is None:
            return -1
        if feature not in self._number:
            self._number[feature] = len(self.rows)
            self.rows.append(_feature_row(feature))
        return self._number[feature]


def _track_row(track: Remembered, features: _MemoryTable) -> list[Any]:
    known = [features.number(one) for one in (track.epoch, track.quoted, track.shown)]
    flags = [int(one) for one in (track.is_published, track.is_settled, track.is_away)]
    counts = [track.vehicles_before, track.ayes_before, track.hits_before, track.day]
    votes = [[number, one.vehicle, _masses(one.existence), one.hits, one.elsewhere] for number, one in track.votes]
    measured = [
        [one.vehicle, one.repeats, _place(one.place), one.attributes, int(one.is_finder), one.earlier]
        for one in track.measured
    ]
    place = None if track.known is None else _place(track.known)
    head = [track.feature_id, track.kind, list(track.names), _place(track.state)]
    return [*head, known, flags, votes, measured, place, counts, sorted(track.apart), track.gone, track.ayes_gone]


def _remembered(row: Sequence[Any], features: Sequence[Feature]) -> Remembered:
    feature_id, kind, names, state, known, flags, votes, measured, place, counts, apart, gone, ayes = row
    epoch, quoted, shown = (None if number < 0 else features[number] for number in known)
    vehicles_before, ayes_before, hits_before, day = counts
    is_published, is_settled, is_away = map(bool, flags)
    return Remembered(
        feature_id,
        kind,
        tuple(names),
        _place_of(state),
        epoch,
        quoted,
        shown,
        is_published,
        is_settled,
        is_away,
        votes=tuple((n, Vote(vehicle, Existence(*m), h, name)) for n, vehicle, m, h, name in votes),
        measured=tuple(
            Own(vehicle, repeats, _place_of(at), _attributes(of), bool(is_finder), earlier)
            for vehicle, repeats, at, of, is_finder, earlier in measured
        ),
        known=None if place is None else _place_of(place),
        vehicles_before=vehicles_before,
        ayes_before=ayes_before,
        hits_before=hits_before,
        apart=frozenset(apart),
        day=day,
        gone=tuple((vehicle, n) for vehicle, n in gone),
        ayes_gone=tuple((vehicle, n) for vehicle, n in ayes),
    )


def _masses(row: Existence) -> list[float]:
    return [row.exist, row.absent, row.unknown, row.conflict]


def _place(place: PlaceEstimate) -> list[Any]:
    return [place.points_m.ravel().tolist(), place.cov_m2.ravel().tolist()]


def _place_of(row: Sequence[Any]) -> PlaceEstimate:
    points_m, cov_m2 = row
    return PlaceEstimate(_array(points_m).reshape(-1, 3), _array(cov_m2).reshape(3, 3))


def _feature_row(one: Feature) -> list[Any]:
    head = [one.feature_id, one.kind, one.points_m.ravel().tolist(), one.cov_m2.tolist(), _masses(one.existence)]
    return [*head, one.attributes, one.part, one.cuts, one.hits, one.vehicles]


def _feature(row: Sequence[Any]) -> Feature:
    feature_id, kind, points_m, cov_m2, masses, attributes, *counts = row
    points = _array(points_m).reshape(-1, 3)
    return Feature(feature_id, kind, points, _array(cov_m2), Existence(*masses), _attributes(attributes), *counts)


def _attributes(row: Iterable[Sequence[str]]) -> Attributes:
    return tuple((key, value) for key, value in row)


def _array(values: Sequence[float]) -> F64:
    return np.array(values, np.float64)
