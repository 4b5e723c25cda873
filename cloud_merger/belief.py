"""Which reports of a tile take part in its merge: not those whose changes are an error of their poses.

What a second vehicle claims alike is none of the poses: then a facade has moved, and both are believed. Two passes of
one vehicle share its mount, so they do not count as two here, however far apart. Nor do two vehicles whose reports are
shifted again and again: they share their software, or the map is off all over, which no vote about voxels mends.
"""

from collections import OrderedDict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.cloud_merger.shift import SHIFT_LEAST_GAUSSIANS, CommonShift, shift_of
from gnd.cloud_merger.statements import Report, is_withheld
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.similarity import similarity
from gnd.schemas.changes import TileChange
from gnd.schemas.doubt import DoubtReason
from gnd.tile_store.values import CourseSaid, ShiftTest, Unconfirmed, WaitingReason

ALIKE: Final = 0.5  # similarity of two claims
AGREE_VOXELS: Final = 12
AGREE_SHARE: Final = 0.6
REMEMBERED: Final = 4096


@dataclass(frozen=True, slots=True)
class Believed:
    """The reports of a tile, sorted out.

    Attributes:
        reports: those that take part in the merge.
        set_aside: what the others claim, by vehicle.
        tests: what the shift test says of each report that it could be made on, sorted by report id.
    """

    reports: tuple[Report, ...]
    set_aside: tuple[Unconfirmed, ...]
    tests: tuple[ShiftTest, ...]

    def without(self, vehicles: frozenset[str]) -> "Believed":
        """The same, with all reports of these vehicles set aside."""
        out = [one for one in self.reports if one.vehicle in vehicles]
        return Believed(
            tuple(one for one in self.reports if one.vehicle not in vehicles),
            (*self.set_aside, *_claims(out, "quarantined")),
            self.tests,
        )


class ShiftTests:
    """Shift tests of reports against the versions that they were compared with; remembered, each is made once."""

    def __init__(self) -> None:
        self._held: OrderedDict[tuple[str, int], CommonShift] = OrderedDict()

    def of(self, report: Report, bases: Mapping[bytes, Gaussians]) -> CommonShift:
        """The test of one report; one whose base is not known, or that had none, cannot be tested."""
        base = bases.get(report.change.base_sha)
        if base is None:
            return CommonShift(False, 0)
        key = (report.report_id, report.change.tile.morton)
        if key not in self._held:
            self._held[key] = shift_of(report.change, base)
            if len(self._held) > REMEMBERED:
                self._held.popitem(last=False)
        return self._held[key]


def believed(
    reports: Iterable[Report],
    shifts: Mapping[str, CommonShift],
    named: frozenset[str] = frozenset(),
) -> Believed:
    """Sort out the reports of a tile.

    Args:
        reports: in any order.
        shifts: of each by its id.
        named: vehicles whose reports are shifted again and again.

    An account takes no notice of `named`: a report counts as explained there unless one that is not explained itself
    claims the same. So who is named depends on the reports alone.
    """
    ordered = sorted(reports, key=lambda one: one.report_id)
    doubted = {one.report_id for one in ordered if shifts[one.report_id].is_explained or _doubts_by_shift(one)}
    sure = [one for one in ordered if one.report_id not in doubted]
    unnamed = [one for one in ordered if one.vehicle not in named]
    cleared = {one.report_id for one in ordered if one.report_id in doubted and _is_shared(one, sure)}
    alike = cleared | {one.report_id for one in unnamed if one.report_id in doubted and _is_shared(one, unnamed)}
    out = [one for one in ordered if one.report_id in doubted - alike]
    tested = (one for one in ordered if _can_tell(one, shifts))
    return Believed(
        reports=tuple(one for one in ordered if one.report_id not in doubted - alike),
        set_aside=_claims(out),
        tests=tuple(_test_of(one, shifts[one.report_id], one.report_id in doubted - cleared) for one in tested),
    )


def courses_of(reports: Iterable[Report]) -> tuple[CourseSaid, ...]:
    """What the reports say of their vehicles' courses."""
    return tuple(
        CourseSaid(one.report_id, one.vehicle, one.last_ns, one.course.turn_rad, one.course.sigma_rad)
        for one in reports
        if one.course is not None
    )


def _doubts_by_shift(report: Report) -> bool:
    doubt = report.change.doubt
    return doubt is not None and bool(doubt.reasons & DoubtReason.EXPLAINED_BY_SHIFT)


def _can_tell(report: Report, shifts: Mapping[str, CommonShift]) -> bool:
    return shifts[report.report_id].gaussians >= SHIFT_LEAST_GAUSSIANS or _doubts_by_shift(report)


def _is_shared(report: Report, reports: Iterable[Report]) -> bool:
    """Whether another vehicle claims the same."""
    return any(_agree(report.change, one.change) for one in reports if one.vehicle != report.vehicle)


def _agree(a: TileChange, b: TileChange) -> bool:
    """Whether two reports make enough claims about the same voxels, and most of them alike."""
    common = np.intersect1d(_claimed(a), _claimed(b))
    if len(common) < AGREE_VOXELS:
        return False
    one, other = a.changed.select(common), b.changed.select(common)
    alike = similarity(one.exists, one.mean_m, one.cov_m2, other.exists, other.mean_m, other.cov_m2)
    return bool((alike >= ALIKE).mean() >= AGREE_SHARE)


def _claimed(change: TileChange) -> NDArray[np.int32]:
    """The voxels of which a report says what is there now: not those whose Gaussian was not asked for."""
    return change.changed.voxel_id[~is_withheld(change)]


def _claims(reports: Iterable[Report], reason: WaitingReason = "shift") -> tuple[Unconfirmed, ...]:
    """What the reports claim in vain, by vehicle."""
    found: dict[str, list[Report]] = {}
    for report in reports:
        found.setdefault(report.vehicle, []).append(report)
    return tuple(_claim(vehicle, own, reason) for vehicle, own in sorted(found.items()))


def _claim(vehicle: str, own: list[Report], reason: WaitingReason) -> Unconfirmed:
    claimed = np.unique(np.concatenate([one.change.changed.voxel_id for one in own]))
    withheld = max(0 if one.change.doubt is None else one.change.doubt.withheld for one in own)
    voxels = max(len(claimed), withheld, 1)
    seen = len(np.unique(np.concatenate([one.change.observed for one in own])))
    return Unconfirmed(vehicle, tuple(one.report_id for one in own), voxels, max(seen, voxels), reason)


def _test_of(report: Report, shift: CommonShift, is_explained: bool) -> ShiftTest:
    """The test's line in the account of its vehicle; along the vehicle's axes where the vehicle has told it so."""
    doubt = report.change.doubt
    if doubt is None or not _doubts_by_shift(report):
        return ShiftTest(report.report_id, report.vehicle, report.last_ns, is_explained, shift.length_m, shift.turn_rad)
    forward_m, left_m, _ = doubt.shift_m
    length_m = float(np.hypot(forward_m, left_m))
    return ShiftTest(
        report.report_id, report.vehicle, report.last_ns, is_explained, length_m, doubt.turn_rad, forward_m, left_m
    )
