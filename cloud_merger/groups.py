"""Vehicles that say the same false things: their refuted reports coincide far beyond chance.

Of two reports that others contradict in a tile, what both claim is compared with what two would claim alike who chose
as many voxels each among all that both have seen. Two that delete everything agree, and by chance alone: that is a
fault, not a plot. Who coincides in 24 false claims or more, three times beyond chance, counts as one: the vehicles of a
group have one vote in a voxel, are one witness, and silence and name others as vehicles of one owner do.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.caps import Owners
from gnd.cloud_merger.statements import Report, Statements, Witness
from gnd.gnd_map.classes import ChangeClass
from gnd.schemas.changes import TileChange
from gnd.tile_store.sql_standing import first_of
from gnd.tile_store.store import Store
from gnd.tile_store.values import AgreementTest, Coincidence

FROM_THE_BEGINNING = -(1 << 62)


@dataclass(frozen=True, slots=True)
class VehicleGroup:
    """Vehicles of which each says the same false things as another.

    Attributes:
        vehicles: two or more, sorted.
        shared: voxels that two of them claim alike, each pair counted.
        by_chance: how many of those would coincide by chance.
    """

    vehicles: tuple[str, ...]
    shared: int
    by_chance: float


def groups_of(store: Store) -> list[VehicleGroup]:
    """The groups of a store, by their first vehicle."""
    pairs = store.pairs_of_groups()
    first = first_of(pairs)
    found = []
    for name in sorted(set(first.values())):
        own = [pair for pair in pairs if first[pair.one] == name]
        vehicles = tuple(sorted(vehicle for vehicle in first if first[vehicle] == name))
        found.append(VehicleGroup(vehicles, sum(one.shared for one in own), sum(one.by_chance for one in own)))
    return found


def coincidences_of(reports: Iterable[Report], tests: Iterable[AgreementTest]) -> tuple[Coincidence, ...]:
    """How far the claims of the vehicles that are refuted in a window coincide, two by two."""
    refuted = {test.report_id for test in tests if test.is_refuted}
    told: dict[str, TileChange] = {}
    for report in sorted(reports, key=lambda one: one.turn):
        if report.report_id in refuted and report.vehicle:
            told[report.vehicle] = report.change  # the newest
    return tuple(_coincidence(one, told[one], other, told[other]) for one, other in combinations(sorted(told), 2))


def _coincidence(one: str, first: TileChange, other: str, second: TileChange) -> Coincidence:
    seen = np.intersect1d(first.observed, second.observed)
    mine, theirs = (_claims(change, seen) for change in (first, second))
    shared, by_chance = len(np.intersect1d(mine, theirs)), len(mine) * len(theirs) / max(len(seen), 1)
    return Coincidence(one, other, shared, by_chance, min(len(mine), len(theirs)))


def _claims(change: TileChange, seen: NDArray[np.int32]) -> NDArray[np.int64]:
    """Voxels with what is claimed of them, something or nothing, as one number."""
    ids = change.changed.voxel_id.astype(np.int64)
    found: NDArray[np.int64] = (2 * ids + (change.change_class != ChangeClass.DELETED))[np.isin(ids, seen)]
    return found


def joined(coincidences: Iterable[Coincidence]) -> tuple[Coincidence, ...]:
    """The sums of several windows, by pair."""
    of: dict[tuple[str, str], list[Coincidence]] = {}
    for one in coincidences:
        of.setdefault((one.one, one.other), []).append(one)
    return tuple(
        Coincidence(
            *pair, sum(one.shared for one in own), sum(one.by_chance for one in own), sum(one.least for one in own)
        )
        for pair, own in sorted(of.items())
    )


def as_one(statements: Statements, first_of_group: Mapping[str, str]) -> Statements:
    """The statements in which the vehicles of a group have one vote in each voxel, those of earlier windows, too."""
    voters: list[Report | Witness] = [*statements.reports, *statements.witnesses]
    names = [first_of_group.get(one.vehicle, "") for one in voters]
    number = {name: k for k, name in enumerate(sorted({name for name in names if name}))}
    if not number:
        return statements
    group = np.array([number.get(name, -1) for name in names] + [-1], np.int64)[statements.rows["report"]]
    at = np.flatnonzero(group >= 0)
    seat = statements.rows["voxel_id"][at].astype(np.int64) * len(number) + group[at]
    _, seat, many = np.unique(seat, return_inverse=True, return_counts=True)
    rows = statements.rows.copy()
    rows["weight"][at] /= many[seat]
    return replace(statements, rows=rows)


def owned_as_one(owners: Owners, first_of_group: Mapping[str, str]) -> Owners:
    """The owners, with a group as if it was one."""
    return {**owners, **{one: ((FROM_THE_BEGINNING, f"&{first}"),) for one, first in first_of_group.items()}}
