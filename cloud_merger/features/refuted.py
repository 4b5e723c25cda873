"""Which reports about features the other vehicles contradict again and again: those of a vehicle that was lost.

A lost vehicle judges every sign as gone, and finds each once more beside its place. One such verdict may be a change of
the world that it was the first to see; so a report is refuted only when in most of its tiles it stands alone against
two vehicles or more, and no other says the same of anything there. A refuted report says nothing in the merge, and its
vehicle is named by its account.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.cloud_merger.features.statements import Statement
from gnd.cloud_merger.features.tracks import FeatureTrack
from gnd.tile_store.values import REFUTED_SHARE, REFUTED_TESTS, ShiftTest

OPPOSING: Final = 2
"""So many other vehicles must say otherwise."""
BESIDE_M: Final = 40.0
"""What a lost vehicle found is one of the features around, at most so far off."""
STATES: Final = ("exist", "absent")


@dataclass(frozen=True, slots=True)
class Heard:
    """What the other vehicles say of one report's verdicts in one tile.

    Attributes:
        number: of the report among the statements.
        vehicle: whose.
        agreed: verdicts that another vehicle shares.
        alone: verdicts against which `OPPOSING` others or more stand, and for which nobody.
        off_m: how far from their twins the features lie that it alone has found; 0: none has one.
    """

    number: int
    vehicle: str
    agreed: int
    alone: int
    off_m: float

    @property
    def is_contradicted(self) -> bool:
        """Whether more of it is contradicted than shared."""
        return self.alone > self.agreed


def heard(tracks: Sequence[FeatureTrack]) -> tuple[Heard, ...]:
    """What of each report can be compared; after views have voted (`add_views`). One vote a vehicle: its newest."""
    agreed: Counter[int] = Counter()
    alone: Counter[int] = Counter()
    off_m: dict[int, list[float]] = {}
    vehicles: dict[int, str] = {}
    believed = [track for track in tracks if _ayes(track) >= OPPOSING]
    for track in tracks:
        newest = {vote.vehicle: (number, vote.existence.state) for number, vote in sorted(track.votes.items())}
        clear = {vehicle: vote for vehicle, vote in newest.items() if vote[1] in STATES}
        counts = Counter(state for _, state in clear.values())
        for vehicle, (number, state) in clear.items():
            same, other = counts[state] - 1, sum(counts.values()) - counts[state]
            vehicles[number] = vehicle
            if same:
                agreed[number] += 1
            elif other >= OPPOSING:
                alone[number] += 1
                if state == "exist" and (twin_m := _twin_m(track, believed)):
                    off_m.setdefault(number, []).append(twin_m)
    return tuple(
        Heard(number, vehicles[number], agreed[number], alone[number], float(np.mean(off_m.get(number, [0.0]))))
        for number in sorted(agreed.keys() | alone.keys())
        if number >= 0  # those of closed windows have had their test
    )


def tests_of(
    found: Iterable[Heard], statements: Sequence[Statement], last_ns: Mapping[str, int]
) -> tuple[ShiftTest, ...]:
    """Its lines in the accounts of the vehicles, sorted by report id."""
    return tuple(
        ShiftTest(
            report_id := statements[one.number].report_id, one.vehicle, last_ns[report_id], one.is_contradicted,
            one.off_m if one.is_contradicted else 0.0, 0.0,
        )
        for one in found
    )  # fmt: skip


def left_out(statements: Sequence[Statement], tests: Iterable[ShiftTest], refuted: Mapping[str, str]) -> frozenset[str]:
    """The reports that say nothing about a tile: those refuted, and what else their vehicles say alone in this tile: a
    lost stretch does not end where a report does.
    """
    lost = set(refuted.values())
    alone = {test.report_id for test in tests if test.is_explained and test.vehicle in lost}
    return frozenset(one.report_id for one in statements if one.report_id in refuted or one.report_id in alone)


def refuted_of(tests: Iterable[ShiftTest]) -> dict[str, str]:
    """The reports that are refuted, and whose each is, of the tests of all tiles of a layer; as a store tells it."""
    made: Counter[str] = Counter()
    against: Counter[str] = Counter()
    vehicles: dict[str, str] = {}
    for test in tests:
        vehicles[test.report_id] = test.vehicle
        made[test.report_id] += 1
        against[test.report_id] += test.is_explained
    return {
        report: vehicles[report]
        for report, n in made.items()
        if against[report] >= max(REFUTED_TESTS, REFUTED_SHARE * n)
    }


def _ayes(track: FeatureTrack) -> int:
    return len({vote.vehicle for vote in track.votes.values() if vote.existence.state == "exist"})


def _twin_m(track: FeatureTrack, believed: Sequence[FeatureTrack]) -> float:
    """How far off the nearest feature of its kind is that others agree on; 0: there is none."""
    at = track.state.points_m[0, :2]
    far = [
        float(np.hypot(*(one.state.points_m[0, :2] - at)))
        for one in believed
        if one is not track and one.kind == track.kind and len(one.state.points_m) == 1
    ]
    return min((one for one in far if one <= BESIDE_M), default=0.0)
