"""How what each report says of a tile agrees with what others saw within the same half hour.

A vehicle whose statements are contradicted by two or more others, nearly all of them and in tile after tile, is wrong:
its LiDAR is mounted otherwise than it believes, its poses are bad, or it lies. No truth is needed for that, and no
vehicle is its own witness. Single contradictions are normal: things move, and are seen from one side only.

A function of the window's reports alone, not of who is believed: so who is named depends on the journal, in any order.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.caps import CAP_OWNER_NAMES
from gnd.cloud_merger.confirmation import seen_by
from gnd.cloud_merger.hearing import Hearing, Said, Spoken, passing
from gnd.cloud_merger.statements import Report, Statements, find, is_met
from gnd.gnd_map.arrays import are_in
from gnd.gnd_map.gaussian import Gaussians
from gnd.tile_store.values import AgreementTest

JUDGED_VOXELS: Final = 12
"""Fewer statements that others can judge say nothing about a report."""
REFUTED_CLAIMS: Final = 0.6
"""A report is refuted where others contradict this share of the changes that it claims, ..."""
REFUTED_SEEN: Final = 0.15
"""... and those are as much as this share of what it has seen there and they could judge: where nothing has changed all
that an honest vehicle claims is wrong, at edges and in leaves, and is contradicted as surely as a lie, ..."""
NEW_VOXELS: Final = 10
REFUTED_NEW: Final = 0.8
"""... or where they contradict this share of what it says has come, at least so many voxels, however little that is of
what it has seen: an honest vehicle errs less about that than about what has gone or changed, ..."""
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
        denied: of each vehicle its claims that somebody else has seen, too, and how many of them more deny than say the
            same; a vote by what it met counts as a claim here.
    """

    tests: tuple[AgreementTest, ...] = ()
    contradicted: frozenset[str] = frozenset()
    denied: Mapping[str, tuple[int, int]] = field(default_factory=dict)


def agreement_of(
    epoch: Gaussians, statements: Statements, spoken: Spoken, found: Hearing, judges_met: bool = True
) -> Agreement:
    """How the reports of a window agree.

    Args:
        epoch: the tile that the reports are merged into.
        statements: of all reports of the window, believed or not.
        spoken: what they say.
        found: who is heard; the others are judged and judge nobody.
        judges_met: whether votes by what vehicles met can be denied; they could not by the rules of before.

    Nobody is refuted for such a vote, for others decide, too, whether there is one.
    """
    reports = statements.reports
    if len(spoken.names) < 2 or not len(spoken.at):
        return Agreement()
    time_ns = np.array([one.last_ns for one in reports], np.int64)[spoken.report]
    told = spoken.take(np.lexsort((spoken.report, time_ns, spoken.seat)))
    heard, gone, there = found.counts[told.at], told.said == Said.GONE, np.isin(told.said, (Said.NEW, Said.MODIFIED))
    claim = gone | there
    same = told.said == Said.SAME
    (gone_before, gone_after), (there_before, there_after), (same_before, same_after) = (
        _voices_around(told, which & heard) for which in (gone, there, same)
    )
    agree = np.where(gone, gone_before + gone_after, there_before + there_after)
    met = is_met(statements.rows[told.at]) & judges_met
    met_before, met_after = _voices_around(told, met & heard) if met.any() else (0, 0)
    is_spoken_of = there_before + there_after + same_before + same_after > 0  # not only by those who met something, too
    say_so = np.where(met, agree + met_before + met_after, agree)
    n_judged, n_denied = _denied(
        len(reports), told.report, claim | (met & is_spoken_of), say_so, same_before + same_after
    )
    # what the tile holds now was claimed rightly against an older version
    settled = np.bincount(told.report[(told.restated != Said.OPEN) & (same_before + same_after > 0)])
    n_settled = np.pad(settled, (0, len(reports) - len(settled)))
    # who agrees counts whenever it came, and so does the vehicle itself: three that lie first must not make those wrong
    # who come after them, before the others have
    restated = (told.restated != Said.OPEN) & (same_before + same_after >= DENIED_CLAIM)
    judged = claim & (agree + same_after >= DENIED_CLAIM) | restated
    refuted = claim & judged & (same_after >= DENIED_CLAIM) & (same_after > agree + 1)
    # Of "as it was" only what others have clearly found changed says something, whether the vehicle says so or not:
    # what one of them claims wrongly all others quote, and a vehicle that never sees a change would agree with most.
    before, still = np.maximum(gone_before, there_before), same_before + same_after
    changed = (told.said != Said.OPEN) & (before >= DENIED_QUOTE) & (before > still + 1)
    quoted = same & (before + still >= DENIED_QUOTE)
    voxel_id, tests = statements.rows["voxel_id"][told.at], []
    seen = _seen_again(reports, epoch)
    for number, report in enumerate(reports):
        own = told.report == number
        of_it = _Statements(own & judged, own & refuted, own & quoted, own & changed, claim)
        tests.append(_test_of(reports, report, voxel_id, of_it, epoch, seen[number]))
    contradicted = _contradicted(reports, n_judged, n_denied)
    denied = _by_vehicle(reports, n_judged + n_settled, n_denied)
    return Agreement(tuple(one for one in tests if one is not None), contradicted, denied)


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


def _voices_around(told: Spoken, which: Mask) -> tuple[I64, I64]:
    """The same of statements; of an owner of other vehicles one is heard."""
    before, after = _around(told.seat, which & (told.owner < 0))
    for owner in np.unique(told.owner[told.owner >= 0]).tolist():
        own = told.owner == owner
        own_before, own_after = _around(told.seat, which & own)
        before += np.where(own, own_before, np.minimum(own_before, CAP_OWNER_NAMES))
        after += np.where(own, own_after, np.minimum(own_after, CAP_OWNER_NAMES))
    return before, after


def _seen_again(reports: Sequence[Report], epoch: Gaussians) -> list[int]:
    """Of each report how many voxels of the tile before the window it has seen that so many others have seen later,
    too, that they could contradict it.
    """
    number = {name: k for k, name in enumerate(dict.fromkeys(_name_of(one) for one in reports))}
    last_ns = np.full((len(number), len(epoch)), np.iinfo(np.int64).min)
    found = [find(epoch.voxel_id, seen_by(one.change, epoch)) for one in reports]
    rows = [at[at >= 0] for at in found]
    for one, at in zip(reports, rows, strict=True):
        own = last_ns[number[_name_of(one)]]
        own[at] = np.maximum(own[at], one.last_ns)
    n_again = []
    for one, at in zip(reports, rows, strict=True):
        later = last_ns[:, at] > one.last_ns
        others = later.sum(axis=0) - later[number[_name_of(one)]]
        n_again.append(int((others >= DENIED_CLAIM).sum()))
    return n_again


def _name_of(report: Report) -> str:
    """Of its vehicle; of a report without one its own."""
    return report.vehicle or report.report_id


def is_denied(test: AgreementTest) -> bool:
    """Whether most of what a report claims is contradicted, however little that is of what it has seen."""
    return test.claims >= JUDGED_VOXELS and test.refuted_claims >= REFUTED_CLAIMS * test.claims


def _around(seat: I64, which: Mask) -> tuple[I64, I64]:
    """(M,) how many rows of `which` come before and behind each row in its voxel; `seat` is sorted."""
    first = np.append(True, seat[1:] != seat[:-1])[: len(seat)]
    group = np.cumsum(first) - 1
    until = np.cumsum(which)
    start: I64 = (until - which)[first][group]
    total = np.bincount(group, weights=which).astype(np.int64)[group]
    before: I64 = until - which - start
    return before, total - before - which


def _denied(n: int, report: I64, claim: Mask, agree: I64, deny: I64) -> tuple[I64, I64]:
    """(n,) claims of each report of whose voxels somebody else has spoken, too, and how many of them are denied."""
    judged, denied = claim & (agree + deny > 0), claim & (deny > agree)
    return np.bincount(report[judged], minlength=n), np.bincount(report[denied], minlength=n)


def _by_vehicle(reports: Sequence[Report], n_judged: I64, n_denied: I64) -> dict[str, tuple[int, int]]:
    found: dict[str, tuple[int, int]] = defaultdict(lambda: (0, 0))
    for report, judged, denied in zip(reports, n_judged.tolist(), n_denied.tolist(), strict=True):
        if report.vehicle:
            before = found[report.vehicle]
            found[report.vehicle] = before[0] + judged, before[1] + denied
    return dict(found)


def _contradicted(reports: Sequence[Report], n_judged: I64, n_denied: I64) -> frozenset[str]:
    """Vehicles of whose claims others deny many."""
    found = (n_denied >= CONTRADICTED_VOXELS) & (n_denied >= CONTRADICTED_SHARE * n_judged)
    return frozenset(one.vehicle for one, is_found in zip(reports, found, strict=True) if is_found and one.vehicle)


def _test_of(
    reports: Sequence[Report],
    report: Report,
    voxel_id: NDArray[np.int32],
    own: _Statements,
    epoch: Gaussians,
    seen_again: int,
) -> AgreementTest | None:
    claims, wrong_claims = int(own.claims.sum()), int(own.refuted.sum())
    changed, missed = int(own.changed.sum()), int((own.changed & ~own.claim).sum())
    if max(claims, changed, int(own.quotes.sum())) < JUDGED_VOXELS:
        return None  # else there is a test, whatever it says: those who come later may clear whom the first made wrong
    is_new = ~are_in(voxel_id, epoch.voxel_id)
    seen = seen_again + int((own.claims & is_new).sum())
    by_claims = claims >= JUDGED_VOXELS and wrong_claims >= REFUTED_CLAIMS * claims
    if by_claims:  # what parks and leaves that come differ from drive to drive, and are nobody's fault
        lasting = ~are_in(voxel_id, passing(report, epoch))
        claims, wrong_claims = int((own.claims & lasting).sum()), int((own.refuted & lasting).sum())
        come = lasting & is_new
        n_come, wrong_come = int((own.claims & come).sum()), int((own.refuted & come).sum())
        by_claims = claims >= JUDGED_VOXELS and wrong_claims >= max(REFUTED_CLAIMS * claims, REFUTED_SEEN * seen)
        by_claims |= n_come >= NEW_VOXELS and wrong_come >= REFUTED_NEW * n_come
    by_quotes = changed >= JUDGED_VOXELS and missed >= REFUTED_QUOTES * changed
    if by_quotes:  # what had parked may have gone again
        parked = [passing(one, epoch) for one in reports if one is not report]
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
        seen=seen,
    )
