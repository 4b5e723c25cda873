"""A window of a tile's journal: merged while it is open, folded into the next epoch when it is closed.

A pure function of the tile's state before it and of the set of its reports: any order of work, any crash and any number
of shards end in the same map, bit for bit, and `gnd.cloud_merger.verify` computes any version anew.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.agreement import Agreement, agreement_of
from gnd.cloud_merger.belief import Believed, ShiftTests, believed
from gnd.cloud_merger.caps import Owners, capped
from gnd.cloud_merger.confirmation import ConfirmationParameters, GatedTile, gate, vouching_for
from gnd.cloud_merger.groups import as_one, coincidences_of, copies_of, joined, owned_as_one
from gnd.cloud_merger.hearing import Hearing, Spoken, all_heard, heard, spoken_of, without_silent
from gnd.cloud_merger.memory import (
    ANOTHER_DRIVE_S,
    CLAIMS_OF_VEHICLE,
    CLAIMS_OF_VOXEL,
    MOST_OBSERVERS,
    VOXEL,
    ParkedVoxels,
    TileMemory,
    mark_of,
)
from gnd.cloud_merger.merge import MergedTile, MergeParameters, merge_tile
from gnd.cloud_merger.parked import hold_parked, parked_after
from gnd.cloud_merger.season import hold_season
from gnd.cloud_merger.snapping import Snapping
from gnd.cloud_merger.statements import (
    EPOCH,
    Kind,
    Report,
    Rows,
    Statements,
    Witness,
    find,
    is_met,
    statements_of,
    without_unsure,
)
from gnd.gnd_map.codec import Lattice, snap
from gnd.gnd_map.day import day_of
from gnd.gnd_map.gaussian import Gaussians
from gnd.tile_store.marks import Marked
from gnd.tile_store.values import AgreementTest, Coincidence, VehicleStanding

I32 = NDArray[np.int32]

MOST_CLAIMS: Final = 20_000
"""Of a tile; the newest stay."""
_DENSE: Final = 8_000_000
_NS_PER_S: Final = 1_000_000_000
_NS_PER_DAY: Final = 86_400 * _NS_PER_S


@dataclass(frozen=True, slots=True, eq=False)
class TileState:
    """What a tile's closed windows have come to: the Gaussians that the next window is merged into, and the memory."""

    gaussians: Gaussians
    memory: TileMemory


@dataclass(frozen=True, slots=True, eq=False)
class MergedWindow:
    """What a window gives.

    Attributes:
        reports: of the window.
        believed: those, sorted out.
        agreement: how each agrees with the others, whoever is believed.
        statements: of those that are believed, and of the memory.
        gated: the tile as it may be published, and what waits.
        gaussians: of that tile, on its lattice.
        parked: what has the shape of a vehicle and is held back.
        bases: Gaussians of the versions that the reports refer to, by content hash.
        denied: of each vehicle its claims that somebody else has seen, too, and how many of them are denied.
        coincidences: how far the claims of refuted reports coincide, and who has sent the same measurements.
        unheard: vehicles, once for each kind of statement of theirs that does not count.
        carries_quotes: whether "as in an older version" is remembered as a claim; it was not by the rules of before.
    """

    reports: tuple[Report, ...]
    believed: Believed
    statements: Statements
    gated: GatedTile
    gaussians: Gaussians
    parked: ParkedVoxels
    bases: Mapping[bytes, Gaussians]
    agreement: tuple[AgreementTest, ...] = ()
    carries_quotes: bool = True
    denied: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    coincidences: tuple[Coincidence, ...] = ()
    unheard: tuple[str, ...] = ()

    def standings(self, window: int) -> tuple[VehicleStanding, ...]:
        """How the vehicles stand in it of which there is anything to tell."""
        newest: dict[str, Report] = {}
        for report in sorted(self.reports, key=lambda one: one.turn):
            if report.vehicle:
                newest[report.vehicle] = report
        found = []
        for vehicle, one in sorted(newest.items()):
            alone, shared = self.gated.alone.get(vehicle, 0), self.gated.shared.get(vehicle, 0)
            judged, denied = self.denied.get(vehicle, (0, 0))
            unheard = self.unheard.count(vehicle)
            if alone or shared or judged or unheard:
                day = one.received_ns // _NS_PER_DAY
                found.append(VehicleStanding(vehicle, window, one.last_ns, day, alone, shared, judged, denied, unheard))
        return tuple(found)


@dataclass(frozen=True, slots=True, eq=False)
class _Told:
    """What reports say: their statements without and with caps, what all of those decide, who is heard, and whose the
    vehicles are.
    """

    uncapped: Statements
    statements: Statements
    merged: MergedTile
    spoken: Spoken
    heard: Hearing
    owners: Owners


@dataclass(frozen=True, slots=True, eq=False)
class WindowMerger:
    """Merges windows of one tile (GND section 5).

    Attributes:
        rules: how statements become changes.
        confirmation: what a single vehicle may change.
        shifts: tests of reports, each made once.
        bases: Gaussians by content hash of the versions that the reports refer to.
        named: words about vehicles that do not count, are not believed alone, or have one vote with others (`Marked`).
        snapping: what the last merges have given, on their lattices.
        has_hearing: whether who is clearly wrong in a tile loses its vote there; versions of before were made without.
        owners: of vehicles, where their certificates tell them.
        judges_met: whether what several met and none decides upon is one witness's word, and denied as claims are;
            versions of before were made without.
    """

    rules: MergeParameters
    confirmation: ConfirmationParameters
    shifts: ShiftTests
    bases: Mapping[bytes, Gaussians]
    named: frozenset[str]
    snapping: Snapping = field(default_factory=Snapping)
    has_hearing: bool = True
    owners: Owners = field(default_factory=dict)
    judges_met: bool = True

    def merge(self, state: TileState, reports: Sequence[Report], lattice: Lattice | None) -> MergedWindow:
        """Merge the reports of a window, in any order, into what the windows before it have come to.

        `lattice`: on which the tile lies; None: none.
        """
        rules, agreement, marked = self.rules, Agreement(), Marked.of(self.named)
        if not rules.together:
            reports, state = without_unsure(reports), TileState(state.gaussians, state.memory.without_met())
        unheard: tuple[str, ...] = ()
        alike: tuple[Coincidence, ...] = ()
        out, named = marked.counted_out, marked.shifted
        if rules.has_paper_rules:  # they know neither shift tests nor a gate nor a memory
            in_play = Believed(tuple(reports), (), ())
            statements = statements_of(state.gaussians, reports, self.bases, rules.mode)
            gated, parked = GatedTile(merge_tile(state.gaussians, statements, rules)), state.memory.parked
        else:
            shifts = {one.report_id: self.shifts.of(one, self.bases) for one in reports}
            in_play = believed(reports, shifts, named)
            told = self._told(state, in_play)
            agreement = agreement_of(state.gaussians, told.statements, told.spoken, told.heard, self.judges_met)
            if self.confirmation.copies:
                alike = joined([*coincidences_of(reports, agreement.tests), *copies_of(reports, told.uncapped)])
            is_less = bool(out & {one.vehicle for one in in_play.reports})
            if is_less or self._is_of_groups(state, in_play.reports, marked):
                in_play = in_play.without(out)
                told = self._told(state, in_play, marked.first_of)  # who is refuted does not depend on groups
            statements, merged = told.statements, told.merged
            unheard = tuple(name for name, _ in told.heard.silent)
            if told.heard.silent:
                statements = capped(without_silent(told.uncapped, told.heard), told.owners)
                merged = merge_tile(state.gaussians, statements, rules)
            by, seen = statements.witnesses, in_play.reports
            standing = state.memory.parked, self.bases, self.confirmation.parked_h
            bare, leaves = hold_season(state.gaussians, merged, seen)
            free = hold_parked(state.gaussians, bare, seen, *standing)
            alone = agreement.contradicted | marked.contradicted
            vouching = vouching_for(free.merged, statements) if self.judges_met else None
            more = named, by, alone, marked.over_cap, marked.first_of, vouching
            found = gate(state.gaussians, free.merged, seen, self.confirmation, *more)
            waiting = (*found.waiting, *free.waiting, *leaves, *in_play.set_aside)
            gated = GatedTile(found.merged, waiting, found.alone, found.shared)
            parked = free.voxels
        gaussians = self._on_lattice(gated.merged, reports, lattice)
        return MergedWindow(
            tuple(reports), in_play, statements, gated, gaussians, parked, self.bases, agreement.tests,
            self.has_hearing, agreement.denied, alike, unheard,
        )  # fmt: skip

    def _is_of_groups(self, state: TileState, reports: Sequence[Report], marked: Marked) -> bool:
        """Whether vehicles of a group speak here, now or in what is remembered."""
        voters: list[Report | Witness] = [*reports, *state.memory.witnesses]
        return any(one.vehicle in marked.first_of for one in voters)

    def _told(self, state: TileState, in_play: Believed, first_of: Mapping[str, str] | None = None) -> "_Told":
        """What the reports in play say, and who of them is heard; `first_of`: of each vehicle of a group its first."""
        owners = owned_as_one(self.owners, first_of or {})
        uncapped = statements_of(state.gaussians, in_play.reports, self.bases, "default", state.memory)
        uncapped = as_one(uncapped, first_of or {})
        statements = capped(uncapped, owners) if self.has_hearing else uncapped
        merged = merge_tile(state.gaussians, statements, self.rules)
        spoken = spoken_of(state.gaussians, statements, merged.for_epoch, owners, self.has_hearing)
        found = heard(state.gaussians, statements, spoken) if self.has_hearing else all_heard(statements)
        return _Told(uncapped, statements, merged, spoken, found, owners)

    def _on_lattice(self, merged: MergedTile, reports: Sequence[Report], lattice: Lattice | None) -> Gaussians:
        if lattice is None:
            return merged.gaussians
        if not reports:
            return snap(merged.gaussians, lattice)
        return self.snapping.of(reports[0].change.tile, merged, lattice)


def provenance_of(windows: Iterable[MergedWindow]) -> dict[int, tuple[str, ...]]:
    """The reports of each voxel that windows, one after the other, have changed: those of its last change."""
    found: dict[int, tuple[str, ...]] = {}
    for window in windows:
        found |= window.gated.merged.provenance
    return found


def fold(state: TileState, window: MergedWindow) -> TileState:
    """The state after a window that is closed: settled evidence as the epoch and its support, the rest as claims."""
    rows, merged = window.statements.rows, window.gated.merged
    is_changed = find(merged.changed, rows["voxel_id"]) >= 0
    for_change = merged.for_change if len(merged.for_change) else np.zeros(len(rows), bool)
    for_epoch = merged.for_epoch if len(merged.for_epoch) else np.zeros(len(rows), bool)
    agrees = np.where(is_changed, for_change, for_epoch)
    reports = window.believed.reports
    n = len(window.statements.reports)
    fresh = np.array([state.memory.is_fresh(one) for one in window.statements.reports] + [False], bool)
    is_fresh = np.append(fresh[:n], False)[np.where((rows["report"] >= 0) & (rows["report"] < n), rows["report"], n)]
    statements = _with_older_quotes(window.statements, state.gaussians) if window.carries_quotes else window.statements
    claims, witnesses = _claims_left(statements, agrees, is_fresh & agrees, is_changed)
    voxels = _observed(state.memory, window, merged.changed, agrees)
    parked = parked_after(state.memory.parked, window.parked, window.gaussians.voxel_id, reports, window.bases)
    return TileState(window.gaussians, TileMemory(voxels, claims, witnesses, _voters(state.memory, reports), parked))


def _with_older_quotes(statements: Statements, epoch: Gaussians) -> Statements:
    """The same, with what is said "as in an older version" as a claim where the tile holds something else now: who has
    an old map and still finds it true denies the newest version as much as who has that and finds it false.
    """
    rows = statements.rows.copy()
    nothing = (rows["kind"] == Kind.NOTHING) & (find(epoch.voxel_id, rows["voxel_id"]) >= 0)
    held = (rows["kind"] == Kind.QUOTED) & (rows["was"] != EPOCH)
    rows["claim"] |= (rows["report"] >= 0) & (nothing | held)
    rows["kind"][held & (rows["report"] >= 0)] = Kind.MEASURED
    return replace(statements, rows=rows)


def _claims_left(
    statements: Statements, agrees: NDArray[np.bool_], confirms: NDArray[np.bool_], is_changed: NDArray[np.bool_]
) -> tuple[Rows, tuple[Witness, ...]]:
    """Claims against what the tile holds now, of each voxel the newest: each confirmation takes the oldest away."""
    rows, who = statements.rows, _voters_of(statements)
    at = np.flatnonzero((rows["claim"] | is_met(rows)) & ~agrees & (rows["report"] >= 0))
    if not len(at):
        return rows[:0], ()
    order = sorted(range(len(who)), key=lambda k: (who[k].received_ns, who[k].report_id, k))
    rank = np.empty(len(who), np.int64)
    rank[order] = np.arange(len(who))
    at = at[np.lexsort((-rank[rows["report"][at]], rows["voxel_id"][at]))]  # by voxel, the newest first
    number = {vehicle: k for k, vehicle in enumerate(dict.fromkeys(one.vehicle for one in who))}
    vehicle = np.array([number[one.vehicle] if one.vehicle else len(number) + k for k, one in enumerate(who)])
    voxel = rows["voxel_id"][at].astype(np.int64)
    voter = voxel * (len(number) + len(who)) + vehicle[rows["report"][at]]
    at = at[_turn(voter) < CLAIMS_OF_VEHICLE]
    voxel_id = rows["voxel_id"][at]
    confirmed, n = np.unique(rows["voxel_id"][confirms], return_counts=True)
    cancelled = np.append(n, 0)[find(confirmed.astype(np.int32), voxel_id)]
    claimed = np.bincount(np.unique(voxel_id, return_inverse=True)[1])[np.unique(voxel_id, return_inverse=True)[1]]
    stays = _turn(voxel_id.astype(np.int64)) < np.minimum(claimed - cancelled, CLAIMS_OF_VOXEL)
    at = at[stays]
    if len(at) > MOST_CLAIMS:
        at = at[np.sort(np.argsort(-rank[rows["report"][at]], kind="stable")[:MOST_CLAIMS])]
    at = at[np.lexsort((rank[rows["report"][at]], rows["voxel_id"][at]))]
    claims: Rows = rows[at].copy()
    claims["denies"] &= ~is_changed[at]
    claims["was"] = np.where((claims["was"] == EPOCH) & ~is_changed[at], EPOCH, 0)
    kept, claims["report"] = np.unique(claims["report"], return_inverse=True)
    return claims, tuple(_witness(who[k]) for k in kept.tolist())


def _voters_of(statements: Statements) -> list[Report | Witness]:
    return [*statements.reports, *statements.witnesses]


def _turn(key: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N,) how many rows with the same key come before each row."""
    order = np.argsort(key, kind="stable")
    first = np.append(True, key[order][1:] != key[order][:-1])[: len(key)]
    start = np.maximum.accumulate(np.where(first, np.arange(len(key)), 0))
    turn = np.empty(len(key), np.int64)
    turn[order] = np.arange(len(key)) - start
    return turn


def _witness(one: Report | Witness) -> Witness:
    return Witness(*(getattr(one, name) for name in Witness.__slots__))


def _observed(memory: TileMemory, window: MergedWindow, changed: I32, agrees: NDArray[np.bool_]) -> NDArray[Any]:
    """The remembered voxels after the window: who confirmed what the tile holds now, and when it was last observed."""
    rows, reports = window.statements.rows, window.statements.reports
    disputed = np.unique(rows["voxel_id"])
    own = [rows["report"] == k for k in range(len(reports))]
    met = rows["voxel_id"][is_met(rows)]
    seen = [
        np.union1d(one.change.observed, met[rows["report"][is_met(rows)] == k]) if len(met) else one.change.observed
        for k, one in enumerate(reports)
    ]
    confirmed = [
        np.concatenate([ids[find(disputed, ids) < 0], rows["voxel_id"][mine & agrees]])
        for ids, mine in zip(seen, own, strict=True)
    ]
    every = np.concatenate([memory.voxels["voxel_id"], *seen, np.zeros(0, np.int32)])
    table = _WindowTable(np.unique(every).astype(np.int32) if len(every) else np.zeros(0, np.int32))
    found = np.zeros(len(table.voxel_id), VOXEL)
    found["voxel_id"] = table.voxel_id
    found[table.at(memory.voxels["voxel_id"])] = memory.voxels
    found["observers"][table.at(changed)] = 0  # another state, confirmed by nobody before this window
    observers = found["observers"].astype(np.int64)
    for one, ids in sorted(_by_vehicle(reports, confirmed), key=lambda pair: pair[0].turn):
        at = table.at(ids)
        mark = mark_of(one.vehicle)
        is_new = (found["last"][at] != mark) | (observers[at] == 0)
        if not memory.is_fresh(one):
            is_new &= observers[at] == 0  # its vote of half an hour ago
        observers[at[is_new]] += 1
        found["last"][at] = mark
    found["observers"] = np.minimum(observers, MOST_OBSERVERS)
    for one, ids in zip(reports, seen, strict=True):
        at = table.at(ids)
        found["day"][at] = np.maximum(found["day"][at], day_of(one.last_ns))
    return found


def _by_vehicle(reports: Sequence[Report], confirmed: Sequence[I32]) -> Iterable[tuple[Report, I32]]:
    """Of each vehicle its newest report and all voxels that any of its reports confirms."""
    of: dict[str, list[int]] = {}
    for k, one in enumerate(reports):
        of.setdefault(one.vehicle or one.report_id, []).append(k)
    for own in of.values():
        ids = confirmed[own[0]] if len(own) == 1 else np.unique(np.concatenate([confirmed[k] for k in own]))
        yield max((reports[k] for k in own), key=lambda one: one.turn), ids


class _WindowTable:
    """Rows of sorted voxel ids by number: a dense table where they lie close together, as those of a tile do."""

    def __init__(self, voxel_id: I32) -> None:
        self.voxel_id = voxel_id
        self._low = int(voxel_id[0]) if len(voxel_id) else 0
        width = int(voxel_id[-1]) - self._low + 1 if len(voxel_id) else 0
        self._row = None if width > _DENSE else np.zeros(width, np.int32)
        if self._row is not None:
            self._row[voxel_id - self._low] = np.arange(len(voxel_id))

    def at(self, ids: I32) -> NDArray[np.int64]:
        """Row of each id, all of which are here."""
        if self._row is None:
            return np.searchsorted(self.voxel_id, ids)
        return self._row[ids - self._low].astype(np.int64)


def _voters(memory: TileMemory, reports: Sequence[Report]) -> dict[str, int]:
    """Who voted within the last half hour of the window, and when."""
    voters = dict(memory.voters)
    for one in reports:
        if one.vehicle:
            voters[one.vehicle] = max(one.received_ns, voters.get(one.vehicle, one.received_ns))
    since_ns = max(voters.values(), default=0) - round(ANOTHER_DRIVE_S * _NS_PER_S)
    return {vehicle: at_ns for vehicle, at_ns in sorted(voters.items()) if at_ns > since_ns}
