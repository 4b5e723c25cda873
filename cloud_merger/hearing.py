"""Whose statements of which kind count in a tile, as the reports of a window tell it themselves.

A vehicle that says "as it was" wherever others have clearly found a change does not see changes: that it says so is no
evidence against one. Likewise who calls gone, or new, what others clearly see as it was. Such statements, of one kind
and of one vehicle, are not heard in this tile; its others are. Who is most surely wrong goes first, and all is
counted again without it: so of several that are wrong alike each is seen, when the one before does not hide it.

What a vehicle says counts as of the voxel's state, whatever version of the map it was said against: a vehicle that has
a false version and finds it false says "as it was" of the true one.

Whole numbers only, so the same reports give the same on any machine, in any order.
"""

from dataclasses import dataclass, replace
from enum import IntEnum
from fractions import Fraction
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.caps import CAP_MODEL_VOICES, CAP_OWNER_VOICES, Owners, groups_of, owner_of
from gnd.cloud_merger.parameters import MERGE_D_UPDATE, MERGE_NOISE_M
from gnd.cloud_merger.statements import EPOCH, Kind, Report, Rows, Statements, find, is_met, states_at
from gnd.gnd_map.arrays import are_in
from gnd.gnd_map.foliage import follows_season
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.similarity import similarity
from gnd.gnd_map.vehicle_shape import has_vehicle_shape

HEARD_LEAST_VOXELS: Final = 12
"""Of fewer statements of a kind that others can judge nothing is said about a vehicle."""
HEARD_LEAST_OTHERS: Final = 3
"""So many others must say otherwise about a voxel, and more than one more than say the same, the vehicle included."""
HEARD_WRONG_CLAIMS: Final = Fraction(3, 5)
"""Claims of a kind are not heard where this share of those that are clearly wrong or right is wrong, ..."""
HEARD_MISSED: Final = Fraction(4, 5)
"""... "as it was" where it is said of this share of what others have clearly found changed."""

Mask = NDArray[np.bool_]
I64 = NDArray[np.int64]


class Said(IntEnum):
    """What a statement says of its voxel, against the epoch's state."""

    SAME = 0
    GONE = 1
    NEW = 2
    MODIFIED = 3
    OPEN = 4  # nothing that could be judged: a version between is quoted, or a Gaussian was not asked for


@dataclass(frozen=True, slots=True, eq=False)
class Spoken:
    """The statements of a window's reports, each with who says what; sorted by voxel.

    Attributes:
        at: (M,) rows of the statements.
        seat: (M,) number of the voxel.
        report: (M,) number of the report.
        voter: (M,) number of the vehicle; of a report without a name its own.
        said: (M,) `Said`.
        names: of the voters.
        owner: (M,) number of the owner of its vehicle, -1: not known.
        model: (M,) number of its LiDAR's model, -1: not known.
        restated: (M,) GONE or NEW where the vehicle has found such a change against an older version, and the tile
            holds it now: it was right, though it says "as it was" of what is here; OPEN elsewhere.
    """

    at: I64
    seat: I64
    report: I64
    voter: I64
    said: NDArray[np.uint8]
    names: tuple[str, ...]
    owner: I64
    model: I64
    restated: NDArray[np.uint8]

    def take(self, which: Mask | I64) -> "Spoken":
        """Some of them."""
        return Spoken(
            self.at[which],
            self.seat[which],
            self.report[which],
            self.voter[which],
            self.said[which],
            self.names,
            self.owner[which],
            self.model[which],
            self.restated[which],
        )


def spoken_of(
    epoch: Gaussians, statements: Statements, for_epoch: Mask, owners: Owners, has_hearing: bool = True
) -> Spoken:
    """What the reports of a window say, not what is remembered.

    Args:
        epoch: the tile that they are merged into.
        statements: of the window.
        for_epoch: (M,) which of them are in a cluster that says that a voxel is as in the epoch.
        owners: of vehicles, where they are known.
        has_hearing: False: by the rules of before, which took each claim for one against the epoch.
    """
    rows, reports = statements.rows, statements.reports
    at = np.flatnonzero((rows["report"] >= 0) & (rows["report"] < len(reports)))
    of = rows[at]
    names = tuple(dict.fromkeys(one.vehicle or one.report_id for one in reports))
    number = {name: k for k, name in enumerate(names)}
    voter = np.array([number[one.vehicle or one.report_id] for one in reports], np.int64)
    seat = np.unique(of["voxel_id"], return_inverse=True)[1].astype(np.int64)
    said = _said(epoch, of, for_epoch[at]) if has_hearing else _said_by_claims(of, for_epoch[at])
    owner = groups_of([owner_of(one, owners) for one in reports])
    model = groups_of([one.model for one in reports])
    report = of["report"].astype(np.int64)
    restated = np.where(of["kind"] == Kind.NOTHING, Said.GONE, Said.NEW)
    restated = np.where(of["claim"] & (said == Said.SAME) & has_hearing, restated, Said.OPEN).astype(np.uint8)
    return Spoken(at, seat, report, voter[report], said, names, owner[report], model[report], restated)


def _said(epoch: Gaussians, rows: Rows, for_epoch: Mask) -> NDArray[np.uint8]:
    """(M,) `Said` of each."""
    is_mapped = find(epoch.voxel_id, rows["voxel_id"]) >= 0
    kind, own = rows["kind"], rows["was"] == np.where(is_mapped, EPOCH, 0)  # said against the epoch's state
    nothing = kind == Kind.NOTHING
    found = np.full(len(rows), Said.OPEN, np.uint8)
    found[nothing & is_mapped & rows["claim"]] = Said.GONE
    found[nothing & ~is_mapped] = Said.SAME
    found[(kind == Kind.QUOTED) & (rows["was"] == EPOCH)] = Said.SAME
    measured = ((kind == Kind.MEASURED) & ~is_met(rows)) | ((kind == Kind.WITHHELD) & own)
    found[measured] = np.where(is_mapped[measured], Said.MODIFIED, Said.NEW)
    # Said against another version: like what stands there now, or nobody has compared the two. Others that were said
    # against that version, too, may be a little more alike, which is no reason to call this one wrong.
    again = np.flatnonzero((kind == Kind.MEASURED) & ~own & is_mapped & ~is_met(rows))
    found[again] = np.where(for_epoch[again] | _is_like(epoch, rows[again]), Said.SAME, Said.OPEN)
    return found


def _said_by_claims(rows: Rows, for_epoch: Mask) -> NDArray[np.uint8]:
    claimed = np.where(rows["kind"] == Kind.NOTHING, Said.GONE, Said.NEW)
    return np.where(rows["claim"], claimed, np.where(for_epoch, Said.SAME, Said.OPEN)).astype(np.uint8)


def _is_like(epoch: Gaussians, rows: Rows) -> Mask:
    was = states_at(epoch, rows["voxel_id"], Kind.QUOTED)
    noise_m = np.sqrt(MERGE_NOISE_M**2 + rows["pose_m2"])
    alike = similarity(
        was["count"] > 0,
        was["mean_m"],
        was["cov_m2"],
        rows["count"] > 0,
        rows["mean_m"],
        rows["cov_m2"],
        "default",
        noise_m=noise_m,
    )
    return np.asarray(alike >= MERGE_D_UPDATE)


@dataclass(frozen=True, slots=True, eq=False)
class Hearing:
    """Who is heard in a tile.

    Attributes:
        counts: (M,) of all statements, whether each counts.
        silent: vehicles (or reports without a name) and the kind of statement of theirs that does not count.
    """

    counts: Mask
    silent: tuple[tuple[str, Said], ...] = ()


def all_heard(statements: Statements) -> Hearing:
    """By the rules of before."""
    return Hearing(np.ones(len(statements.rows), np.bool_))


def heard(epoch: Gaussians, statements: Statements, spoken: Spoken) -> Hearing:
    """Whose statements of which kind count.

    Args:
        epoch: the tile that they are merged into.
        statements: of the window.
        spoken: of `spoken_of` them.
    """
    counts = all_heard(statements).counts
    told = spoken.take(spoken.said != Said.OPEN)
    silent: list[tuple[str, Said]] = []
    if len(told.names) <= HEARD_LEAST_OTHERS:
        return Hearing(counts)
    passing = _Passing(epoch, statements)
    while worst := _worst(told, passing):
        for voter, said in worst:
            out = (told.voter == voter) & (told.said == said)
            counts[told.at[out]] = False
            if said == Said.NEW:  # nor is what it met and did not decide upon
                counts[spoken.at[(spoken.voter == voter) & is_met(statements.rows[spoken.at])]] = False
            told = told.take(~out)
            silent.append((told.names[voter], said))
    return Hearing(counts, tuple(silent))


class _Passing:
    """Voxels in which something has parked or follows the season, by report: nobody is wrong about those."""

    def __init__(self, epoch: Gaussians, statements: Statements) -> None:
        self._epoch, self._statements = epoch, statements
        self._of: dict[int, NDArray[np.int32]] = {}

    def rows(self, told: Spoken, report: int) -> Mask:
        """(M,) which statements are about what passes by the word of one report."""
        if report not in self._of:
            self._of[report] = passing(self._statements.reports[report], self._epoch)
        return are_in(self._statements.rows["voxel_id"][told.at], self._of[report])


def passing(report: Report, epoch: Gaussians) -> NDArray[np.int32]:
    """Sorted ids of a report's changed voxels that have the shape of a standing vehicle, come or gone, or follow the
    season.
    """
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
    return np.unique(np.concatenate(found)).astype(np.int32)


def _worst(told: Spoken, passes: _Passing) -> list[tuple[int, Said]]:
    """Whose statements of which kind are most surely wrong more often than may be: one, or several that are so alike,
    for names decide nothing.
    """
    n, found = len(told.names), list[tuple[Fraction, int, Said]]()
    for said in (Said.SAME, Said.GONE, Said.NEW, Said.MODIFIED):
        wrong, judged = _missed(told) if said == Said.SAME else _refuted(told, said)
        limit = HEARD_MISSED if said == Said.SAME else HEARD_WRONG_CLAIMS
        n_wrong, of = (np.bincount(told.voter[which], minlength=n) for which in (wrong, judged))
        for voter in np.flatnonzero(_beyond(n_wrong, of, limit)).tolist():
            own = told.voter == voter
            reports = np.unique(told.report[own if said != Said.SAME else ~own]).tolist()
            lasting = ~np.logical_or.reduce([passes.rows(told, one) for one in reports]) & own
            left, of_left = int((wrong & lasting).sum()), int((judged & lasting).sum())
            if _beyond(np.array([left]), np.array([of_left]), limit)[0]:
                found.append((_sureness(left, of_left, limit), voter, said))
    most = max((sure for sure, _, _ in found), default=Fraction(0))
    return [(voter, said) for sure, voter, said in found if sure == most]


def _beyond(wrong: I64, judged: I64, limit: Fraction) -> Mask:
    return np.asarray((judged >= HEARD_LEAST_VOXELS) & (limit.denominator * wrong >= limit.numerator * judged))


def _sureness(wrong: int, judged: int, limit: Fraction) -> Fraction:
    """How surely a share is beyond the limit: the square of its distance in standard deviations. Twenty of twenty say
    less than five hundred of six hundred.
    """
    return (wrong - limit * judged) ** 2 / (judged * limit * (1 - limit))


def _refuted(told: Spoken, said: Said) -> tuple[Mask, Mask]:
    """(M,) which claims of a kind are clearly wrong, and which are clearly wrong or right; the rest is open."""
    same, gone, there = _tally(told)
    own = gone if said == Said.GONE else there
    is_claim = told.said == said
    wrong = is_claim & (same >= HEARD_LEAST_OTHERS) & (same > own + 1)
    right = is_claim & (own >= HEARD_LEAST_OTHERS) & (own > same + 1)
    was_right = told.restated == (Said.GONE if said == Said.GONE else Said.NEW)
    was_right &= (same >= HEARD_LEAST_OTHERS) & (same > np.maximum(gone, there) + 1)
    return wrong, wrong | right | was_right


def _missed(told: Spoken) -> tuple[Mask, Mask]:
    """(M,) which "as it was" is said of what others have clearly found changed, and all statements about such."""
    same, gone, there = _tally(told)
    others = np.maximum(gone - (told.said == Said.GONE), there - np.isin(told.said, (Said.NEW, Said.MODIFIED)))
    changed = np.asarray((others >= HEARD_LEAST_OTHERS) & (others > same + 1))
    return changed & (told.said == Said.SAME), changed


def _tally(told: Spoken) -> tuple[I64, I64, I64]:
    """(M,) how many say of each statement's voxel that it is as it was, gone, new or another."""
    same, gone, there = (
        _voices(told, np.isin(told.said, which)) for which in ((Said.SAME,), (Said.GONE,), (Said.NEW, Said.MODIFIED))
    )
    return same, gone, there


def _voices(told: Spoken, which: Mask) -> I64:
    """(M,) how many say so in the voxel of each statement; of the vehicles of another owner, and of another model, at
    most so many are heard.
    """
    by_owner = _voices_of(told.seat, which, told.owner, CAP_OWNER_VOICES)
    return np.minimum(by_owner, _voices_of(told.seat, which, told.model, CAP_MODEL_VOICES))


def _voices_of(seat: I64, which: Mask, group: I64, most: int) -> I64:
    n = int(seat.max(initial=-1)) + 1
    found = np.bincount(seat[which & (group < 0)], minlength=n).astype(np.int64)[seat]
    for number in np.unique(group[group >= 0]).tolist():
        own = np.bincount(seat[which & (group == number)], minlength=n).astype(np.int64)[seat]
        found += np.where(group == number, own, np.minimum(own, most))
    return found


def without_silent(statements: Statements, found: Hearing) -> Statements:
    """The statements that count."""
    return statements if found.counts.all() else replace(statements, rows=statements.rows[found.counts])
