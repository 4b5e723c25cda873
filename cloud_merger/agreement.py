"""How what each report says of a tile agrees with what others saw within the same half hour.

A vehicle whose statements are contradicted by two or more others, nearly all of them and in tile after tile, is wrong:
its LiDAR is mounted otherwise than it believes, its poses are bad, or it lies. No truth is needed for that, and no
vehicle is its own witness. Single contradictions are normal: things move, and are seen from one side only.

A function of the window's reports alone, not of who is believed: so who is named depends on the journal, in any order.
"""

from collections.abc import Sequence
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
"""... or this share of what it says is as it was, where they say that it has changed: that is missed more easily."""
DENIED_CLAIM: Final = 2
DENIED_QUOTE: Final = 3
"""So many others must contradict a statement, and more than twice as many as agree with it."""

Mask = NDArray[np.bool_]
I64 = NDArray[np.int64]


def agreement_tests(epoch: Gaussians, statements: Statements, for_epoch: Mask) -> tuple[AgreementTest, ...]:
    """The test of each report that others can judge.

    Args:
        epoch: the tile that the reports are merged into.
        statements: of all reports of the window, believed or not.
        for_epoch: (M,) which of them say that a voxel is as in the epoch.
    """
    reports, rows = statements.reports, statements.rows
    if len({one.vehicle for one in reports}) < 1 + DENIED_CLAIM or not len(rows):
        return ()
    told = np.flatnonzero((rows["report"] >= 0) & (rows["report"] < len(reports)))
    rows, quotes = rows[told], for_epoch[told] & ~rows["claim"][told] if len(for_epoch) else np.zeros(len(told), bool)
    voxel = np.unique(rows["voxel_id"], return_inverse=True)[1]
    gone = rows["claim"] & (rows["kind"] == Kind.NOTHING)
    there = rows["claim"] & (rows["kind"] != Kind.NOTHING)
    n_gone, n_there, n_quotes = (_counted(voxel, which) for which in (gone, there, quotes))
    agree = np.where(gone, n_gone, np.where(there, n_there, n_quotes)) - 1
    deny = np.where(rows["claim"], n_quotes, np.maximum(n_gone, n_there))
    least = np.where(rows["claim"], DENIED_CLAIM, DENIED_QUOTE)
    refuted = (deny >= least) & (deny > 2 * agree)
    judged = (agree + deny >= least) & (rows["claim"] | quotes)
    tests = []
    for number, report in enumerate(reports):
        own = rows["report"] == number
        tests.append(_test_of(report, rows["voxel_id"], own & judged, own & refuted & judged, rows["claim"], epoch))
    return tuple(one for one in tests if one is not None)


def _counted(voxel: I64, which: Mask) -> I64:
    """(M,) how many rows of `which` each row's voxel has."""
    return np.bincount(voxel[which], minlength=int(voxel.max(initial=0)) + 1)[voxel]


def _test_of(
    report: Report, voxel_id: NDArray[np.int32], judged: Mask, refuted: Mask, claim: Mask, epoch: Gaussians
) -> AgreementTest | None:
    claims, quotes = int((judged & claim).sum()), int((judged & ~claim).sum())
    if max(claims, quotes) < JUDGED_VOXELS:
        return None
    wrong_claims, wrong_quotes = int((refuted & claim).sum()), int((refuted & ~claim).sum())
    by_claims = claims >= JUDGED_VOXELS and wrong_claims >= REFUTED_CLAIMS * claims
    if by_claims:  # what parks and leaves that come differ from drive to drive, and are nobody's fault
        lasting = ~are_in(voxel_id, _passing(report, voxel_id[judged & claim], epoch))
        claims, wrong_claims = int((judged & claim & lasting).sum()), int((refuted & claim & lasting).sum())
        by_claims = claims >= JUDGED_VOXELS and wrong_claims >= REFUTED_CLAIMS * claims
    by_quotes = quotes >= JUDGED_VOXELS and wrong_quotes >= REFUTED_QUOTES * quotes
    return AgreementTest(
        report_id=report.report_id,
        vehicle=report.vehicle,
        at_ns=report.last_ns,
        claims=claims,
        refuted_claims=wrong_claims,
        quotes=quotes,
        refuted_quotes=wrong_quotes,
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


def of_vehicles(reports: Sequence[Report], vehicles: frozenset[str]) -> frozenset[str]:
    """Ids of the reports that some vehicles have made."""
    return frozenset(one.report_id for one in reports if one.vehicle in vehicles)
