"""Vehicles that say the same false things: their refuted reports coincide far beyond chance; and copies.

Of two reports that others contradict in a tile, what both claim is compared with what two would claim alike who chose
as many voxels each among all that both have seen. Two that delete everything agree, and by chance alone: that is a
fault, not a plot. Who coincides in 24 false claims or more, three times beyond chance, counts as one: the vehicles of a
group have one vote in a voxel, are one witness, and silence and name others as vehicles of one owner do.

Nor are two names two witnesses that send the same measurements, right or wrong: noise and poses of two drives differ,
so of the Gaussians that two vehicles measure in the same voxels few are the same to the bit. Where half of them are,
one drive was sent twice.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.agreement import is_denied
from gnd.cloud_merger.caps import Owners
from gnd.cloud_merger.statements import REMEMBERED, Kind, Report, Rows, Statements, Witness
from gnd.gnd_map.by_object import ByObject
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.schemas.changes import TileChange
from gnd.tile_store.marks import GROUPED, Marked, grouped
from gnd.tile_store.sql_standing import GROUP_LEAST_SHARED, first_of
from gnd.tile_store.store import Store
from gnd.tile_store.values import AgreementTest, Coincidence, VehiclePair

FROM_THE_BEGINNING = -(1 << 62)
COPY_LEAST: Final = 12
"""So many measurements of two vehicles in a tile must be the same to the bit, ..."""
COPY_SHARE: Final = 0.5
"""... and this share of the voxels that both have measured."""

# What a vehicle has measured in a voxel: mean and covariance, or the rays that passed where nothing is any more.
_MEASURED: Final = np.dtype([("voxel_id", np.int32), ("told", np.uint32, 9)])
_HASH: Final = np.arange(1, 2 * 10, 2, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15) | np.uint64(1)
Measured = NDArray[Any]  # of dtype _MEASURED


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
    refuted = {test.report_id for test in tests if test.is_refuted or is_denied(test)}
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


def copies_of(reports: Iterable[Report], statements: Statements) -> tuple[Coincidence, ...]:
    """Vehicles two by two of which one has sent what the other has, in the window's reports or, one of them, before.

    `by_chance` is 0: what is expected of two drives is below every limit here.
    """
    told = [(one.vehicle, False, _measured(one.change)) for one in reports if one.vehicle]
    told += [(name, True, rows) for name, rows in _remembered(statements)]
    voters = sorted({(name, is_old) for name, is_old, _ in told})
    number = {voter: k for k, voter in enumerate(voters)}
    voter = np.repeat([number[name, is_old] for name, is_old, _ in told], [len(rows) for _, _, rows in told])
    every = np.concatenate([np.zeros(0, _MEASURED), *(rows for _, _, rows in told)])
    found = []
    for a, b in _alike(_hashed(every), voter):
        (one, is_old), (other, too) = voters[a], voters[b]
        if one != other and not (is_old and too):
            mine, theirs = every[voter == a], every[voter == b]
            shared, common = (len(np.intersect1d(*both)) for both in ((mine, theirs), _ids(mine, theirs)))
            if shared >= max(COPY_LEAST, COPY_SHARE * common):
                found.append(Coincidence(one, other, shared, 0.0, common))
    return joined(found)


def _ids(one: Measured, other: Measured) -> tuple[Measured, Measured]:
    return one["voxel_id"], other["voxel_id"]


def _alike(key: NDArray[np.uint64], voter: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Who, by number, has told the same of enough voxels as whom."""
    order = np.lexsort((voter, key))
    key, voter = key[order], voter[order]
    once = np.append(True, (key[1:] != key[:-1]) | (voter[1:] != voter[:-1]))[: len(key)]
    key, voter = key[once], voter[once]
    n = int(voter.max(initial=-1)) + 1
    shared = np.zeros(n * n, np.int64)
    for apart in range(1, n):
        same = key[apart:] == key[:-apart]
        if not same.any():
            break
        shared += np.bincount(voter[:-apart][same] * n + voter[apart:][same], minlength=n * n)
    return [divmod(pair, n) for pair in np.flatnonzero(shared >= COPY_LEAST).tolist()]


def _hashed(told: Measured) -> NDArray[np.uint64]:
    """(N,) equal for equal rows, and for hardly any others."""
    words = np.concatenate([told["voxel_id"].astype(np.uint32)[:, None], told["told"]], axis=1).astype(np.uint64)
    total: NDArray[np.uint64] = (words * _HASH).sum(axis=1, dtype=np.uint64)
    return total


_OF_CHANGE: Final[ByObject[Measured]] = ByObject(REMEMBERED)


def _measured(change: TileChange) -> Measured:
    """What a report has measured of changed voxels; found once."""

    def made() -> Measured:
        rays = np.zeros((len(change.changed), 9), np.uint32)
        rays[:, :4] = change.evidence
        told = np.where(change.changed.exists[:, None], _as_words(change.changed), rays)
        rows = np.zeros(len(told), _MEASURED)
        rows["voxel_id"], rows["told"] = change.changed.voxel_id, told
        measured: Measured = rows[told.any(axis=1)]
        return measured

    return _OF_CHANGE.of(change, made)


def _as_words(gaussians: Gaussians | Rows) -> NDArray[np.uint32]:
    """(N, 9) the bits of means and covariances."""
    columns = (gaussians["mean_m"], gaussians["cov_m2"]) if isinstance(gaussians, np.ndarray) else (
        gaussians.mean_m, gaussians.cov_m2)  # fmt: skip
    return np.ascontiguousarray(np.concatenate(columns, axis=1), np.float32).view(np.uint32)


def _remembered(statements: Statements) -> list[tuple[str, Measured]]:
    """What vehicles have measured in earlier windows, as far as it is remembered."""
    rows, n = statements.rows, len(statements.reports)
    rows = rows[(rows["report"] >= n) & (rows["kind"] == Kind.MEASURED) & rows["claim"]]
    found = np.zeros(len(rows), _MEASURED)
    found["voxel_id"], found["told"] = rows["voxel_id"], _as_words(rows)
    names = [one.vehicle for one in statements.witnesses]
    return [(names[k], found[rows["report"] == n + k]) for k in np.unique(rows["report"] - n).tolist() if names[k]]


def with_copies(named: frozenset[str], coincidences: Iterable[Coincidence]) -> frozenset[str]:
    """The words of a version with those about who has sent what another one has, enough of it."""
    known = Marked.of(named).first_of
    copies = [
        one
        for one in coincidences
        if one.is_copy
        and one.shared >= GROUP_LEAST_SHARED
        and (one.one not in known or known[one.one] != known.get(one.other))
    ]
    pairs = [VehiclePair(first, vehicle, 0, 0.0) for vehicle, first in known.items() if vehicle != first]
    pairs += [VehiclePair(one.one, one.other, one.shared, 0.0) for one in copies]
    if not copies:
        return named
    words = {grouped(vehicle, first) for vehicle, first in first_of(pairs).items()}
    return frozenset(one for one in named if not one.startswith(GROUPED)).union(words)


def joined(coincidences: Iterable[Coincidence]) -> tuple[Coincidence, ...]:
    """The sums of several windows, by pair; of one that is a copy the copies alone."""
    of: dict[tuple[str, str], list[Coincidence]] = {}
    told = list(coincidences)
    copies = {(one.one, one.other) for one in told if one.is_copy}
    for one in told:
        if one.is_copy or (one.one, one.other) not in copies:
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
