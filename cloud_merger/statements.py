"""What the reports of a tile say, voxel by voxel.

A report is a statement about the world for every voxel that its drive observed: "Gaussian G is here", "nothing is
here", or "as in base version v". The last is resolved by the hash of v, so a report against an older version is
rebased, not lost.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.together import met_together
from gnd.gnd_map.accumulate import N_MIN_CELLS
from gnd.gnd_map.arrays import unique
from gnd.gnd_map.by_object import ByObject
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.day import day_of
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.jit import kernel
from gnd.gnd_map.tile import diff
from gnd.schemas.changes import TileChange
from gnd.schemas.course import Course

if TYPE_CHECKING:
    from gnd.cloud_merger.memory import TileMemory

Mode = Literal["paper", "paper-observers", "default"]
"""Rules of the merge. The GND paper's rules with the two readings of the ratio that ξ_update bounds (5.3, "the ratio of
the number of merged voxels to the number of information uploads"): "paper" as printed, of all uploads about the voxel;
"paper-observers" with the observers as denominator, of all vehicles that observed it, the silent ones too."""
EPOCH = 1  # the number of the epoch's own Gaussian among the states of a voxel
REMEMBERED: Final = 2048
NO_BASE = b""  # hash in the report of a vehicle that had no map of the tile


class Kind(IntEnum):
    """What a statement says about a voxel."""

    NOTHING = 0
    QUOTED = 1  # the Gaussian of the base version, seen to be still there
    MEASURED = 2
    WITHHELD = 3  # new or modified, but the Gaussian was not asked for


# One statement. `report` indexes Statements.report_ids; `was` numbers the voxel's state in the version that it was made
# against (0: nothing there; equal numbers in a voxel: equal states), so that one sees whether one statement denies what
# another quotes; `denies` marks a MEASURED or WITHHELD one that denies the epoch's own Gaussian; `pose_m2` is the
# variance of a MEASURED one by its poses, beyond what is expected of all; count 0 for NOTHING and WITHHELD; mean
# relative to the voxel centre along tile ENU axes; covariance xx, xy, xz, yy, yz, zz.
STATEMENT = np.dtype(
    [
        ("voxel_id", np.int32),
        ("report", np.int32),
        ("kind", np.uint8),
        ("was", np.int64),
        ("denies", np.bool_),
        ("claim", np.bool_),
        ("weight", np.float64),
        ("pose_m2", np.float64),
        ("count", np.int32),
        ("cells", np.int32),
        ("mean_m", np.float32, 3),
        ("cov_m2", np.float32, 6),
    ]
)
Rows = NDArray[Any]  # of dtype STATEMENT
_BYTES: Final = np.dtype((np.void, STATEMENT.itemsize))
_NO_ROWS: Final = np.zeros(0, _BYTES)


@dataclass(frozen=True, slots=True)
class Report:
    """One report's part about one tile.

    Attributes:
        report_id: orders the reports.
        change: what it says.
        weight: of its votes, see `MergeParameters.report_of`.
        pose_m2: variance of what it measured by its poses, see `MergeParameters.pose_m2_of`.
        vehicle: who made it: of a vehicle's reports about a voxel the newest is its vote. "": not known, then each
            report is a vote.
        first_ns: time of the first scan that it rests on, UTC.
        last_ns: time of the last.
        is_doubtful: the vehicle does not fully believe it; the merge does not look at this.
        course: where the vehicle drives in its own frame, None where it does not know.
        received_ns: when it came, by the clock of the cloud.
        model: of its LiDAR.
    """

    report_id: str
    change: TileChange
    weight: float = 1.0
    pose_m2: float = 0.0
    vehicle: str = ""
    first_ns: int = 0
    last_ns: int = 0
    is_doubtful: bool = False
    course: Course | None = None
    received_ns: int = 0
    model: str = ""

    @property
    def turn(self) -> tuple[int, int, str]:
        """Orders the reports of one vehicle: the newest is its word."""
        return self.last_ns, self.received_ns, self.report_id


@dataclass(frozen=True, slots=True)
class Witness:
    """A report of an earlier window of which a claim is remembered; attributes as `Report`."""

    report_id: str
    vehicle: str
    first_ns: int
    last_ns: int
    received_ns: int
    is_doubtful: bool
    pose_m2: float


@dataclass(frozen=True, slots=True)
class Statements:
    """Statements sorted by voxel, then by report id, then what is remembered; at most one a voxel and vehicle.

    Attributes:
        reports: (R,) sorted by id.
        witnesses: (W,) of remembered claims.
        rows: STATEMENT (M,); `report` numbers reports, then witnesses; -1: the support of what is published.
    """

    reports: tuple[Report, ...]
    rows: Rows
    witnesses: tuple[Witness, ...] = ()

    @property
    def report_ids(self) -> tuple[str, ...]:
        """(R + W,) of reports and witnesses."""
        return (*(one.report_id for one in self.reports), *(one.report_id for one in self.witnesses))


def statements_of(
    epoch: Gaussians,
    reports: Iterable[Report],
    bases: Mapping[bytes, Gaussians],
    mode: Mode = "default",
    memory: "TileMemory | None" = None,
) -> Statements:
    """Every statement about the voxels on which not all agree with the epoch tile.

    A voxel of which every report says "as in the epoch" stays as it is whatever the parameters, so it is left out.

    Args:
        epoch: the tile that all reports of this window are merged into.
        reports: in any order; of a report id that comes again the last one counts.
        bases: Gaussians of the tile's versions by hash. Of an unknown base, "as in base version" abstains.
        mode: "paper" takes the uploaded changes only; the others every observed voxel.
        memory: of the windows before; None: there are none.
    """
    ordered = sorted({report.report_id: report for report in reports}.values(), key=lambda r: r.report_id)
    known = {} if mode == "paper" else {NO_BASE: Gaussians.empty(), **bases}
    claims = np.zeros(0, STATEMENT) if memory is None else memory.claims_beside(ordered)
    met = _met(epoch, ordered) if mode == "default" else np.zeros(0, STATEMENT)
    voxels = _disputed(epoch, ordered, known)
    if len(claims) + len(met):
        voxels = unique(np.concatenate([voxels, claims["voxel_id"], met["voxel_id"]]))
    quoted = _numbered_states(voxels, epoch, known)
    rows = _one_vote_a_vehicle(_with(met, _spoken(voxels, ordered, quoted)), ordered)
    if memory is not None and len(memory.voxels) + len(claims):
        claims = claims.copy()
        claims["report"] += len(ordered)
        day = max((day_of(one.last_ns) for one in ordered), default=0)
        rows = stacked([rows, claims, memory.support_rows(voxels, epoch, day)])
        rows = rows[np.argsort(rows["voxel_id"], kind="stable")]
    return Statements(tuple(ordered), rows, () if memory is None else memory.witnesses)


def _met(epoch: Gaussians, reports: Sequence[Report]) -> Rows:
    """STATEMENT rows of reports about voxels that they are unsure of and that all together decide: no claims, for no
    vehicle has made them.
    """
    if not any(len(one.change.unsure) for one in reports):
        return np.zeros(0, STATEMENT)
    found = met_together(
        epoch, [one.change.unsure for one in reports], [_called_new(one) for one in reports], *_voters(reports)
    )
    rows = np.zeros(len(found.voxel_id), STATEMENT)
    rows["voxel_id"], rows["report"], rows["kind"] = found.voxel_id, found.report, Kind.MEASURED
    rows["weight"] = np.array([one.weight for one in reports])[found.report]
    rows["pose_m2"] = np.array([one.pose_m2 for one in reports])[found.report]
    rows["count"] = rows["cells"] = N_MIN_CELLS
    rows["mean_m"], rows["cov_m2"] = found.mean_m, found.cov_m2
    return rows


_DECIDED: Final[ByObject[TileChange]] = ByObject(REMEMBERED)


def without_unsure(reports: Iterable[Report]) -> tuple[Report, ...]:
    """The reports without what their vehicles met and did not decide upon: of such voxels they say nothing."""
    return tuple(replace(one, change=_decided(one.change)) if len(one.change.unsure) else one for one in reports)


def _decided(change: TileChange) -> TileChange:
    return _DECIDED.of(change, lambda: replace(change, unsure=Gaussians.empty()))


def _called_new(report: Report) -> NDArray[np.int32]:
    told = changed_of(report.change)
    there = told.speaks & (told.rows["kind"] != Kind.NOTHING) & (report.change.change_class == ChangeClass.NEW)
    ids: NDArray[np.int32] = report.change.changed.voxel_id[there]
    return ids


def _with(met: Rows, rows: Rows) -> Rows:
    """Both, by voxel, then by report."""
    if not len(met):
        return rows
    both = stacked([rows, met])
    return both[np.lexsort((both["report"], both["voxel_id"]))]


def is_met(rows: Rows) -> NDArray[np.bool_]:
    """(M,) which statements, remembered ones, too, are about what no vehicle decides upon alone."""
    return np.asarray((rows["kind"] == Kind.MEASURED) & ~rows["claim"])


def _voters(reports: Sequence[Report]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(R,) number of each report's vehicle, of one without a name its own, and (R,) its place in time."""
    number = {vehicle: k for k, vehicle in enumerate(sorted({one.vehicle for one in reports if one.vehicle}))}
    vehicle = np.array([number.get(one.vehicle, len(number) + k) for k, one in enumerate(reports)], np.int64)
    turn = np.empty(len(reports), np.int64)
    turn[sorted(range(len(reports)), key=lambda k: reports[k].turn)] = np.arange(len(reports))
    return vehicle, turn


def _one_vote_a_vehicle(rows: Rows, reports: Sequence[Report]) -> Rows:
    """Of several statements of a vehicle about one voxel only the newest; where that withholds its Gaussian, the newest
    that measured one against the same state instead: it says the same, and more.
    """
    vehicles = {one.vehicle for one in reports if one.vehicle}
    if len(vehicles) == len(reports) or not len(rows):
        return rows
    vehicle, turn = _voters(reports)
    voter = rows["voxel_id"].astype(np.int64) * (len(vehicles) + len(reports)) + vehicle[rows["report"]]
    order = np.lexsort((turn[rows["report"]], voter))
    last = np.append(voter[order][1:] != voter[order][:-1], True)
    group = np.cumsum(last) - last
    newest = order[last][group]  # of each row in this order, the newest row of its voter
    shown = (rows["kind"][order] == Kind.MEASURED) & (rows["was"][order] == rows["was"][newest])
    shown &= rows["kind"][newest] == Kind.WITHHELD
    best = np.lexsort((np.arange(len(order)), shown, group))
    chosen = order[best[np.append(group[best][1:] != group[best][:-1], True)]]
    spoken: Rows = rows[np.sort(chosen)]
    return spoken


def _disputed(epoch: Gaussians, reports: Sequence[Report], known: Mapping[bytes, Gaussians]) -> NDArray[np.int32]:
    """Sorted ids of voxels that a report changes, or whose quoted base differs from the epoch."""
    ids = [np.zeros(0, np.int32)]
    ids += [report.change.changed.voxel_id for report in reports]
    ids += [_differing(epoch, known[sha]) for sha in {report.change.base_sha for report in reports} & set(known)]
    return np.asarray(unique(np.concatenate(ids)))


_DIFFERING: Final[ByObject[tuple[Gaussians, NDArray[np.int32]]]] = ByObject(512)


def _differing(epoch: Gaussians, base: Gaussians) -> NDArray[np.int32]:
    """Ids of the voxels in which two versions differ; the base is held, so that no other object gets its id."""

    def made() -> tuple[Gaussians, NDArray[np.int32]]:
        delta = diff(epoch, base)
        return base, np.concatenate([delta.removed, delta.put.voxel_id])

    return np.zeros(0, np.int32) if base is epoch else _DIFFERING.of(epoch, made, id(base))[1]


def _numbered_states(
    voxels: NDArray[np.int32], epoch: Gaussians, known: Mapping[bytes, Gaussians]
) -> dict[bytes, Rows]:
    """What each known base holds at each of the disputed voxels; `was` is 1 for the epoch's own Gaussian."""
    of_epoch = states_at(epoch, voxels, Kind.QUOTED)
    found: dict[bytes, Rows] = {}
    for number, (sha, base) in enumerate(sorted(known.items()), start=2):
        if base is epoch:  # the usual case
            found[sha] = of_epoch.copy()
            found[sha]["was"] = np.where(of_epoch["count"] > 0, EPOCH, 0)
            continue
        rows = states_at(base, voxels, Kind.QUOTED)
        rows["was"] = np.where(rows["count"] > 0, number, 0)
        for earlier in (of_epoch, *found.values()):
            same = same_state(rows, earlier) & (rows["was"] == number)
            rows["was"][same] = np.where(earlier is of_epoch, EPOCH, earlier["was"])[same]
        found[sha] = rows
    return found


def same_state(a: Rows, b: Rows) -> NDArray[np.bool_]:
    """Where two columns of statements hold the same Gaussian, to the bit."""
    same = (a["count"] == b["count"]) & (a["mean_m"] == b["mean_m"]).all(axis=1)
    return np.asarray(same & (a["cov_m2"] == b["cov_m2"]).all(axis=1))


def _spoken(voxels: NDArray[np.int32], reports: Sequence[Report], quoted: Mapping[bytes, Rows]) -> Rows:
    """The reports' statements about those of `voxels` that each observed, by voxel, then by report; of a report
    without a base only its changes speak.
    """
    laid_out = [changed_of(one.change) for one in reports]
    changed = stacked([one.rows for one in laid_out])
    number = {sha: k for k, sha in enumerate(quoted)}
    base = np.array([number.get(one.change.base_sha, -1) for one in reports], np.int64)
    seat, report, at = _who_speaks(
        voxels,
        base,
        *_end_to_end([one.change.observed for one in reports], np.int32),
        *_end_to_end([one.rows["voxel_id"] for one in laid_out], np.int32),
        _end_to_end([one.speaks for one in laid_out], np.bool_)[0],
    )
    held = stacked(list(quoted.values()))
    here = np.where(base[report] >= 0, base[report] * len(voxels) + seat, -1)
    rows = stacked([held, changed])[np.where(at >= 0, len(held) + at, here)]
    mine = np.flatnonzero(at >= 0)
    was = np.append(held["was"], 0)[here[mine]]
    denies = _end_to_end([one.denies for one in laid_out], np.bool_)[0]
    rows["was"][mine] = was
    rows["denies"][mine] = (was == EPOCH) & denies[at[mine]]
    rows["claim"][mine] = True
    rows["report"] = report
    rows["weight"] = np.array([one.weight for one in reports])[report]
    pose_m2 = np.array([one.pose_m2 for one in reports])[report]
    rows["pose_m2"] = np.where(rows["kind"] == Kind.MEASURED, pose_m2, 0.0)
    return rows


def stacked(parts: Sequence[Rows]) -> Rows:
    """STATEMENT rows one behind the other. As bytes: numpy compares the fields of records one by one."""
    return np.concatenate([_NO_ROWS, *(part.view(_BYTES) for part in parts)]).view(STATEMENT)


def _end_to_end(parts: Sequence[NDArray[Any]], dtype: type[np.generic]) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """The parts one behind the other, and (len(parts) + 1,) where each begins."""
    begin = np.cumsum([0, *(len(part) for part in parts)])
    return np.concatenate([np.zeros(0, dtype), *parts]), begin


@kernel
def _who_speaks(
    voxels: NDArray[np.int32], base: NDArray[np.int64], observed: NDArray[np.int32],
    observed_begin: NDArray[np.int64], changed: NDArray[np.int32], changed_begin: NDArray[np.int64],
    speaks: NDArray[np.bool_],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:  # fmt: skip
    """(M,) each, sorted by voxel, then by report: index of the voxel, the report, and its row among the changed ones,
    -1 where it says "as in the base".
    """
    n, most = 0, len(voxels) * len(base)
    seat, report, at = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most, np.int64)
    for k in range(len(voxels)):
        for r in range(len(base)):
            if index_of(voxels[k], observed[observed_begin[r] : observed_begin[r + 1]]) < 0:
                continue
            own = index_of(voxels[k], changed[changed_begin[r] : changed_begin[r + 1]])
            is_said = speaks[changed_begin[r] + own] if own >= 0 else base[r] >= 0
            if is_said:
                seat[n], report[n], at[n] = k, r, changed_begin[r] + own if own >= 0 else -1
                n += 1
    return seat[:n].copy(), report[:n].copy(), at[:n].copy()


@kernel
def index_of(wanted: int, ids: NDArray[np.int32]) -> int:
    """Index of an id among sorted ones, -1 where it is missing; `find` of one, for kernels."""
    low, high = 0, len(ids)
    while low < high:
        middle = (low + high) // 2
        if ids[middle] < wanted:
            low = middle + 1
        else:
            high = middle
    return low if low < len(ids) and ids[low] == wanted else -1


def states_at(gaussians: Gaussians, voxel_id: NDArray[np.int32], kind: Kind) -> Rows:
    """STATEMENT (len(voxel_id),): what `gaussians` holds at each voxel, NOTHING where they hold none."""
    at = find(gaussians.voxel_id, voxel_id)
    rows = np.zeros(len(voxel_id), STATEMENT)
    there = np.flatnonzero(at >= 0)
    rows[there] = _states(gaussians, at[there], kind)
    rows["voxel_id"] = voxel_id
    return rows


def _states(gaussians: Gaussians, at: NDArray[np.int64], kind: Kind) -> Rows:
    rows = np.zeros(len(at), STATEMENT)
    for name in ("voxel_id", "count", "cells", "mean_m", "cov_m2"):
        rows[name] = getattr(gaussians, name)[at]
    rows["kind"] = np.where(rows["count"] > 0, kind, Kind.NOTHING)
    return rows


@dataclass(frozen=True, slots=True, eq=False)
class Changed:
    """What a report says of the voxels that it found changed: STATEMENT (N,); which speak, and may deny, (N,) bool."""

    change: TileChange
    rows: Rows
    speaks: NDArray[np.bool_]
    denies: NDArray[np.bool_]

    @classmethod
    def made(cls, change: TileChange) -> "Changed":
        """Lay it out."""
        rows = _states(change.changed, np.arange(len(change.changed)), Kind.MEASURED)
        rows["kind"] = _kinds_of_changed(change)
        return cls(change, rows, _speaks_of_changed(change), np.isin(rows["kind"], (Kind.MEASURED, Kind.WITHHELD)))


_CHANGED: Final[ByObject[Changed]] = ByObject(REMEMBERED)


def changed_of(change: TileChange) -> Changed:
    """What a report says of the voxels that it found changed; laid out once, for a window is merged again and again."""
    return _CHANGED.of(change, lambda: Changed.made(change))


def _kinds_of_changed(change: TileChange) -> NDArray[np.uint8]:
    """(N,) the `Kind` of statement that each changed entry makes, if it speaks."""
    kinds = np.where(change.changed.exists, Kind.MEASURED, Kind.NOTHING).astype(np.uint8)
    kinds[is_withheld(change)] = Kind.WITHHELD
    return kinds


def is_withheld(change: TileChange) -> NDArray[np.bool_]:
    """(N,) which changed voxels are new or modified without a Gaussian: flagged, and not asked for."""
    flagged = np.isin(change.change_class, (ChangeClass.NEW, ChangeClass.MODIFIED))
    return np.asarray(flagged & ~change.changed.exists)


def _speaks_of_changed(change: TileChange) -> NDArray[np.bool_]:
    """Changed entries that are a statement: not unmeasured, and no Gaussian from too few sub-cells."""
    weak = change.changed.exists & (change.changed.cells < N_MIN_CELLS)
    return np.asarray(~weak & (change.change_class != ChangeClass.UNMEASURED))


def find(ids: NDArray[np.int32], wanted: NDArray[np.int32]) -> NDArray[np.int64]:
    """Index of each wanted id in the sorted `ids`, -1 where it is missing."""
    if len(ids) == 0:
        return np.full(len(wanted), -1, np.int64)
    at = np.minimum(np.searchsorted(ids, wanted), len(ids) - 1)
    return np.where(ids[at] == wanted, at, -1)
