"""Which of a tile's decided changes are published, and which wait for a second witness.

GND decides by the majority of those who observed a voxel (5.3); where only one vehicle came by, its word is the
majority. One vehicle may be wrong in all that it says: its pose was, or its LiDAR is mounted otherwise than it
believes. So what a single witness claims is published only while it is little and well supported; more waits until a
second vehicle, or the same vehicle on another drive, has seen it, too.

A pure function of the merged tile and the reports, as the merge itself: every new report decides all anew.
"""

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.merge import MergedTile
from gnd.cloud_merger.statements import REMEMBERED, Report, Statements, Witness, is_met
from gnd.gnd_map.arrays import I32, I64, are_in, unique
from gnd.gnd_map.beside import group_numbers
from gnd.gnd_map.by_object import ByObject
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.settings import check_settings, setting
from gnd.schemas.changes import TileChange
from gnd.tile_store.values import Unconfirmed, WaitingReason

CONFIRMATION_VOUCHED_SHARE: Final = 0.5
"""But if at least this share of all its claims that won was made by others, too, the rest is believed with it, whatever
else speaks against it: its poses were right there, and it sees a construction site from where others do not."""
CONFIRMATION_WELL_KNOWN_M: Final = 0.1
"""The lonely claims of a report whose poses are worse than this, beyond what the merge expects of all, wait however few
they are."""
CONFIRMATION_SECOND_DRIVE_S: Final = 1800.0
"""A vehicle that comes back after so long is a second witness. Passes in a row are one: they share the state of
localisation, the parked cars and the mount."""

Who = Report | Witness
VOUCHED_VOXELS = 12  # so many claims of a vehicle must others share at least before they vouch for the rest
_NS_PER_S = 1_000_000_000
_NS_PER_DAY = 86_400 * _NS_PER_S
_NO_GROUPS: Final[Mapping[str, str]] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class ConfirmationParameters:
    """What a single witness may change."""

    few_voxels: int = setting(8, "So many changed voxels of a tile, ...", least=0)
    few_share: float = setting(
        0.02,
        "... or this share of what the witness saw of the tile, whichever is more, are few. Beyond that all "
        "of its lonely claims in the tile wait.",
        least=0,
        most=1,
    )
    together_voxels: int = setting(
        3,
        "A lonely claim is well supported in a group of changes, voxel beside voxel, in which at least so "
        "many appear or vanish. What has come or gone is larger than a voxel or two; what detection errs "
        "about is not: edges, leaves, a surface that the map just missed. Changes of shape alone are told "
        "less surely.",
        least=1,
    )
    copies: bool = setting(
        True,
        "Whether vehicles that send the same measurements to the bit, which two drives never give, or the same false "
        "claims, are one witness. Not where drives are replayed for several vehicles.",
    )
    parked_h: float = setting(
        18.0,
        "What is new and has the shape of a vehicle must have stood for so long, whoever saw it; each time that "
        "something has gone from there doubles it. 0: it is published as anything else.",
        unit="h",
        least=0,
        most=336,
    )

    def __post_init__(self) -> None:
        check_settings(self, MergerError)


@dataclass(frozen=True, slots=True)
class GatedTile:
    """A tile without what waits.

    Attributes:
        merged: the tile to publish.
        waiting: what does, sorted by vehicle and reason.
        alone: by vehicle, voxels that are changed on its word alone, with those that wait for nothing but the day, ...
        shared: ... and those that are changed on its word and that of others.
    """

    merged: MergedTile
    waiting: tuple[Unconfirmed, ...] = ()
    alone: Mapping[str, int] = field(default_factory=dict)
    shared: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Witness:
    """The changes that won, as one vehicle has part in them: voxels that it alone claims, with its reports, and how
    many others claim, too.
    """

    lonely: Mapping[int, tuple[Who, ...]]
    shared: int


def gate(
    epoch: Gaussians,
    merged: MergedTile,
    reports: Iterable[Report],
    parameters: ConfirmationParameters | None = None,
    named: frozenset[str] = frozenset(),
    witnesses: Iterable[Witness] = (),
    contradicted: frozenset[str] = frozenset(),
    over_cap: frozenset[tuple[str, int]] = frozenset(),
    first_of: Mapping[str, str] = _NO_GROUPS,
    vouching: Mapping[int, tuple[str, ...]] | None = None,
) -> GatedTile:
    """Take back the changes that wait for confirmation.

    A tile that the map has not yet (an empty epoch) is published on one vehicle's word: somebody has to be the first,
    there is nothing that its word could damage, and who disagrees later takes it back by vote. Doubtful reports and
    named vehicles wait there, too.

    Args:
        epoch: the tile that the reports were merged into.
        merged: of `merge_tile`.
        reports: those of the merge, in any order.
        parameters: see `ConfirmationParameters`.
        named: vehicles whose reports are shifted again and again: what they alone claim always waits, and they are
            never a second witness of themselves or of each other.
        witnesses: whose claims of earlier windows take part in the merge.
        contradicted: vehicles that others contradict, in this tile or elsewhere: what they alone claim waits, however
            little it is.
        over_cap: vehicles, and days of receipt on which they have changed as much alone as one may.
        first_of: of vehicles that say the same false things who stands for all of them: they are one witness.
        vouching: of `vouching_for`; None: all reports of the cluster that won vouch for a change.
    """
    parameters = parameters or ConfirmationParameters()
    by_report = {report.report_id: report for report in reports}
    by_id = {witness.report_id: witness for witness in witnesses} | by_report
    lonely, shared = _witnesses(merged.provenance if vouching is None else vouching, by_id, named, first_of)
    shared = shared if len(epoch) else {}  # new ground is nobody's loss
    if not lonely:
        return GatedTile(merged, shared=shared)
    waits: dict[int, tuple[str, WaitingReason]] = {}
    alone: dict[str, int] = {}
    isolated = _isolated(epoch, merged, by_report.values(), parameters.together_voxels)
    for vehicle, witness in sorted(lonely.items()):
        seen = seen_of(vehicle, epoch, by_report.values())
        reasons = _waiting_of(witness, seen, None if len(epoch) == 0 else isolated, parameters)
        if vehicle in contradicted and len(epoch):
            reasons = dict.fromkeys(witness.lonely, "contradicted")
        if vehicle in named:
            reasons = dict.fromkeys(witness.lonely, "named")
        if len(epoch):
            alone[vehicle] = len(witness.lonely) - len(reasons)
            reasons |= _beyond_the_day(vehicle, witness, reasons.keys(), over_cap)
        waits |= {voxel: (vehicle, reason) for voxel, reason in reasons.items()}
    if not waits:
        return GatedTile(merged, (), alone, shared)
    return GatedTile(merged.without(waits), _told(waits, merged, epoch, by_report.values()), alone, shared)


def _beyond_the_day(
    vehicle: str, witness: _Witness, waiting: Collection[int], over_cap: frozenset[tuple[str, int]]
) -> dict[int, WaitingReason]:
    """Of the claims that nothing else holds back those of days on which the vehicle has changed as much as it may."""
    days = {day for name, day in over_cap if name == vehicle}
    if not days:
        return {}
    rest = ((voxel, reports) for voxel, reports in witness.lonely.items() if voxel not in waiting)
    return {voxel: "day" for voxel, reports in rest if {one.received_ns // _NS_PER_DAY for one in reports} <= days}


def vouching_for(merged: MergedTile, statements: Statements) -> Mapping[int, tuple[str, ...]]:
    """Of each change the reports that vouch for it: those that claim it. Where it is new by what several met and none
    decides upon, all of them are one witness, told by the first report: nobody answers for such a vote, so any two that
    lie together could publish as much as they like.
    """
    rows = statements.rows[merged.for_change] if len(merged.for_change) else statements.rows[:0]
    rows = rows[rows["report"] >= 0]
    met = is_met(rows)
    rows = rows[are_in(rows["voxel_id"], np.intersect1d(rows["voxel_id"][met], merged.changed))]
    if not len(rows):
        return merged.provenance
    ids, found = statements.report_ids, dict(merged.provenance)
    voxels, begin = np.unique(rows["voxel_id"], return_index=True)
    for voxel, own in zip(voxels.tolist(), np.split(rows, begin[1:]), strict=True):
        claims = own["report"][~is_met(own)].tolist()
        first = min(ids[number] for number in own["report"].tolist())
        found[voxel] = tuple(dict.fromkeys(ids[number] for number in claims)) or (first,)
    return found


def _witnesses(
    provenance: Mapping[int, tuple[str, ...]],
    by_id: Mapping[str, Who],
    named: frozenset[str],
    first_of: Mapping[str, str],
) -> tuple[dict[str, _Witness], Mapping[str, int]]:
    """By vehicle, its part in the changes that won, of those that claim any alone; and what each claims with others.
    Named vehicles do not confirm each other either, nor do those of a group.
    """
    drive = _drives(by_id.values(), CONFIRMATION_SECOND_DRIVE_S, named)
    drive |= {one: (first_of[who.vehicle], 0) for one, who in by_id.items() if who.vehicle in first_of}
    lonely: dict[str, dict[int, tuple[Who, ...]]] = defaultdict(dict)
    shared: Counter[str] = Counter()
    voxels: dict[tuple[str, ...], list[int]] = defaultdict(list)
    for voxel, ids in provenance.items():
        voxels[ids].append(voxel)
    for ids, told in voxels.items():
        vehicles = {by_id[one].vehicle for one in ids}
        if len({drive[one] for one in ids}) == 1 or vehicles <= named:
            lonely[min(vehicles)] |= dict.fromkeys(told, tuple(by_id[one] for one in ids))
        else:
            shared.update(dict.fromkeys(vehicles, len(told)))
    return {vehicle: _Witness(own, shared[vehicle]) for vehicle, own in lonely.items()}, dict(shared)


def _drives(reports: Iterable[Who], second_drive_s: float, named: frozenset[str]) -> dict[str, tuple[str, int]]:
    """Of each report, who saw the tile when: vehicle and number of its drive."""
    found: dict[str, tuple[str, int]] = {}
    number, until_ns, before = 0, 0, ""
    for report in sorted(reports, key=lambda one: (one.vehicle, one.first_ns, one.report_id)):
        if report.vehicle != before:
            number, until_ns, before = 0, report.last_ns, report.vehicle
        elif report.first_ns - until_ns >= second_drive_s * _NS_PER_S and report.vehicle not in named:
            number += 1
        until_ns = max(until_ns, report.last_ns)
        found[report.report_id] = (report.vehicle, number)
    return found


def _isolated(epoch: Gaussians, merged: MergedTile, reports: Iterable[Report], together_voxels: int) -> frozenset[int]:
    """The changed voxels, whoever claims them, in whose group too few appear or vanish."""
    tile = next((report.change.tile for report in reports), None)
    if tile is None or not merged.provenance:
        return frozenset()
    voxels = np.array(sorted(merged.provenance), np.int32)
    there, was = (are_in(voxels, ids) for ids in (merged.delta.put.voxel_id, epoch.voxel_id))
    together = changes_together(*VoxelGrid.of(tile).unravel(voxels), there != was)
    return frozenset(voxels[together < together_voxels].tolist())


def changes_together(x: I64, y: I64, floor: I64, counts: NDArray[np.bool_]) -> I64:
    """(N,) how many of those that count are in the group of each voxel, voxel beside voxel; `floor` ascends."""
    group = group_numbers(x, y, floor)
    return np.bincount(group, weights=counts, minlength=len(x)).astype(np.int64)[group]


def _waiting_of(
    witness: _Witness, seen: int, isolated: frozenset[int] | None, parameters: ConfirmationParameters
) -> dict[int, WaitingReason]:
    """The lonely claims of one vehicle that wait, and why; none where others vouch for it in this tile. `isolated`:
    None on new ground, where nothing is too much or too little.
    """
    waits: dict[int, WaitingReason] = {}
    if witness.shared >= max(VOUCHED_VOXELS, CONFIRMATION_VOUCHED_SHARE * (witness.shared + len(witness.lonely))):
        return waits
    for voxel, reports in witness.lonely.items():
        if all(report.is_doubtful for report in reports):
            waits[voxel] = "doubtful"
        elif all(report.pose_m2 > CONFIRMATION_WELL_KNOWN_M**2 for report in reports):
            waits[voxel] = "poses"
    rest = witness.lonely.keys() - waits.keys()
    if isolated is None:
        return waits
    if len(rest) > max(parameters.few_voxels, parameters.few_share * seen):
        return waits | dict.fromkeys(rest, "share")
    return waits | dict.fromkeys(rest & isolated, "isolated")


def seen_of(vehicle: str, epoch: Gaussians, reports: Iterable[Report]) -> int:
    """Voxels of the tile that a vehicle observed and that hold something, before or by its word."""
    own = [seen_by(report.change, epoch) for report in reports if report.vehicle == vehicle]
    if not own:
        return 0  # it spoke in an earlier window
    return len(own[0]) if len(own) == 1 else len(unique(np.concatenate(own)))


_SEEN: Final[ByObject[tuple[Gaussians, I32]]] = ByObject(REMEMBERED)


def seen_by(change: TileChange, epoch: Gaussians) -> I32:
    """Sorted ids of the voxels of the tile `epoch` that a report observed and that hold something, before or by its
    word. Found once for each epoch, which is held so that no other gets its id.
    """

    def made() -> tuple[Gaussians, I32]:
        before = change.observed[are_in(change.observed, epoch.voxel_id)]
        return epoch, np.asarray(unique(np.concatenate([before, change.changed.voxel_id])))

    return _SEEN.of(change, made, id(epoch))[1]


def _told(
    waits: Mapping[int, tuple[str, WaitingReason]], merged: MergedTile, epoch: Gaussians, reports: Collection[Report]
) -> tuple[Unconfirmed, ...]:
    """What waits, by vehicle and reason."""
    told: dict[tuple[str, WaitingReason], list[int]] = defaultdict(list)
    for voxel, why in waits.items():
        told[why].append(voxel)
    return tuple(
        Unconfirmed(
            vehicle=vehicle,
            report_ids=tuple(sorted({one for voxel in voxels for one in merged.provenance[voxel]})),
            voxels=len(voxels),
            seen=max(seen_of(vehicle, epoch, reports), len(voxels)),  # "as in an older version" claims, too
            reason=reason,
        )
        for (vehicle, reason), voxels in sorted(told.items())
    )
