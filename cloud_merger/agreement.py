"""How what each report says of a tile agrees with what others saw within the same half hour.

A vehicle whose statements are contradicted by two or more others, nearly all of them and in tile after tile, is wrong:
its LiDAR is mounted otherwise than it believes, its poses are bad, or it lies. No truth is needed for that, and no
vehicle is its own witness. Single contradictions are normal: things move, and are seen from one side only.

A function of the window's reports alone, not of who is believed: so who is named depends on the journal, in any order.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.statements import Kind, Report, Statements
from gnd.gnd_map.arrays import are_in
from gnd.gnd_map.foliage import follows_season
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.vehicle_shape import has_vehicle_shape
from gnd.tile_store.values import AgreementTest

JUDGED_VOXELS: Final = 12
"""Fewer statements that others can judge say nothing about a report."""
REFUTED_CLAIMS: Final = 0.6
"""A report is refuted where others contradict this share of the changes that it claims, ..."""
REFUTED_QUOTES: Final = 0.8
"""... or where it says "as it was" of this share of what they have clearly found changed before it came."""
DENIED_CLAIM: Final = 2
DENIED_QUOTE: Final = 3
"""So many others must contradict a statement, and more than say it, the vehicle itself among them. Of a claim those who
came later contradict: what has just changed is contradicted by nobody who came before. Of "as it was" those who came
earlier do."""
CONTRADICTED_VOXELS: Final = 8
CONTRADICTED_SHARE: Final = 0.5
"""Who is contradicted in so many voxels of a tile, and in this share of what others can judge, is not believed alone
there: of two vehicles that say the opposite nobody knows who is right."""

Mask = NDArray[np.bool_]
I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """What the reports of a window say about each other.

    Attributes:
        tests: of each report that others can judge.
        contradicted: the vehicles that are not believed alone in this tile.
    """

    tests: tuple[AgreementTest, ...] = ()
    contradicted: frozenset[str] = frozenset()


def agreement_of(epoch: Gaussians, statements: Statements, for_epoch: Mask) -> Agreement:
    """How the reports of a window agree.

    Args:
        epoch: the tile that the reports are merged into.
        statements: of all reports of the window, believed or not.
        for_epoch: (M,) which of them say that a voxel is as in the epoch.
    """
    reports, rows = statements.reports, statements.rows
    if len({one.vehicle for one in reports}) < 2 or not len(for_epoch):
        return Agreement()
    told = np.flatnonzero((rows["report"] >= 0) & (rows["report"] < len(reports)))
    time_ns = np.array([one.last_ns for one in reports], np.int64)[rows["report"][told]]
    told = told[np.lexsort((rows["report"][told], time_ns, rows["voxel_id"][told]))]
    rows, quotes = rows[told], for_epoch[told] & ~rows["claim"][told]
    claim = rows["claim"]
    gone, there = claim & (rows["kind"] == Kind.NOTHING), claim & (rows["kind"] != Kind.NOTHING)
    (gone_before, gone_after), (there_before, there_after), (quotes_before, quotes_after) = (
        _around(rows["voxel_id"], which) for which in (gone, there, quotes)
    )
    contradicted = _contradicted(
        reports,
        rows["report"],
        claim,
        np.where(gone, gone_before + gone_after, there_before + there_after),
        quotes_before + quotes_after,
    )
    # who agrees counts whenever it came, and so does the vehicle itself: three that lie first must not make those wrong
    # who come after them, before the others have
    agree = np.where(gone, gone_before + gone_after, there_before + there_after)
    judged = claim & (agree + quotes_after >= DENIED_CLAIM)
    refuted = judged & (quotes_after >= DENIED_CLAIM) & (quotes_after > agree + 1)
    # Of "as it was" only what others have clearly found changed says something, whether the vehicle says so or not:
    # what one of them claims wrongly all others quote, and a vehicle that never sees a change would agree with most.
    before, still = np.maximum(gone_before, there_before), quotes_before + quotes_after
    changed = (claim | quotes) & (before >= DENIED_QUOTE) & (before > still + 1)
    quoted = quotes & (before + still >= DENIED_QUOTE)
    tests = []
    for number, report in enumerate(reports):
        own = rows["report"] == number
        of_it = _Statements(own & judged, own & refuted, own & quoted, own & changed, claim)
        tests.append(_test_of(reports, report, rows["voxel_id"], of_it, epoch))
    return Agreement(tuple(one for one in tests if one is not None), contradicted)


@dataclass(frozen=True, slots=True, eq=False)
class _Statements:
    """(M,) of one report: claims that others can judge, those that they refute, what it says is as it was and others
    speak of, too, what they have clearly found changed before; and which rows are claims.
    """

    claims: Mask
    refuted: Mask
    quotes: Mask
    changed: Mask
    claim: Mask


def _around(voxel_id: NDArray[np.int32], which: Mask) -> tuple[I64, I64]:
    """(M,) how many rows of `which` come before and behind each row in its voxel; `voxel_id` is sorted."""
    first = np.append(True, voxel_id[1:] != voxel_id[:-1])[: len(voxel_id)]
    group = np.cumsum(first) - 1
    until = np.cumsum(which)
    start: I64 = (until - which)[first][group]
    total = np.bincount(group, weights=which).astype(np.int64)[group]
    before: I64 = until - which - start
    return before, total - before - which


def _contradicted(
    reports: Sequence[Report], report: NDArray[np.int32], claim: Mask, agree: I64, deny: I64
) -> frozenset[str]:
    """Vehicles of whose claims others deny many; somebody else must have seen the voxel."""
    judged, denied = claim & (agree + deny > 0), claim & (deny > agree)
    n_judged = np.bincount(report[judged], minlength=len(reports))
    n_denied = np.bincount(report[denied], minlength=len(reports))
    found = (n_denied >= CONTRADICTED_VOXELS) & (n_denied >= CONTRADICTED_SHARE * n_judged)
    return frozenset(one.vehicle for one, is_found in zip(reports, found, strict=True) if is_found and one.vehicle)


def _test_of(
    reports: Sequence[Report], report: Report, voxel_id: NDArray[np.int32], own: _Statements, epoch: Gaussians
) -> AgreementTest | None:
    claims, wrong_claims = int(own.claims.sum()), int(own.refuted.sum())
    changed, missed = int(own.changed.sum()), int((own.changed & ~own.claim).sum())
    if max(claims, changed, int(own.quotes.sum())) < JUDGED_VOXELS:
        return None  # else there is a test, whatever it says: those who come later may clear whom the first made wrong
    by_claims = claims >= JUDGED_VOXELS and wrong_claims >= REFUTED_CLAIMS * claims
    if by_claims:  # what parks and leaves that come differ from drive to drive, and are nobody's fault
        lasting = ~are_in(voxel_id, _passing(report, voxel_id[own.claims], epoch))
        claims, wrong_claims = int((own.claims & lasting).sum()), int((own.refuted & lasting).sum())
        by_claims = claims >= JUDGED_VOXELS and wrong_claims >= REFUTED_CLAIMS * claims
    by_quotes = changed >= JUDGED_VOXELS and missed >= REFUTED_QUOTES * changed
    if by_quotes:  # what had parked may have gone again
        parked = [_passing(one, voxel_id[own.changed], epoch) for one in reports if one is not report]
        lasting = ~are_in(voxel_id, np.unique(np.concatenate(parked)).astype(np.int32))
        changed, missed = int((own.changed & lasting).sum()), int((own.changed & lasting & ~own.claim).sum())
        by_quotes = changed >= JUDGED_VOXELS and missed >= REFUTED_QUOTES * changed
    return AgreementTest(
        report_id=report.report_id,
        vehicle=report.vehicle,
        at_ns=report.last_ns,
        claims=claims,
        refuted_claims=wrong_claims,
        quotes=changed,
        refuted_quotes=missed,
        is_refuted=by_claims or by_quotes,
    )


def _passing(report: Report, claimed: NDArray[np.int32], epoch: Gaussians) -> NDArray[np.int32]:
    """Voxels of a report's claims that have the shape of a standing vehicle, come or gone, or follow the season."""
    grid, changed = VoxelGrid.of(report.change.tile), report.change.changed
    come = changed.take(changed.exists & ~are_in(changed.voxel_id, epoch.voxel_id))
    left = np.intersect1d(changed.voxel_id[~changed.exists], epoch.voxel_id).astype(np.int32)
    stood = epoch.take(are_in(epoch.voxel_id, left))
    rest = epoch.take(~are_in(epoch.voxel_id, left))
    found = [
        come.voxel_id[has_vehicle_shape(grid, epoch, come)],
        stood.voxel_id[has_vehicle_shape(grid, rest, stood)],
        follows_season(grid, epoch, left, come),
    ]
    return np.intersect1d(np.concatenate(found), claimed).astype(np.int32)
