"""From evidence to the outbox: tiles that the vehicle has left are decided, and reported soon where they have changed.

A report costs some 160 B beside its content. So a tile in which much has changed waits a moment for those that are
left with it, scattered voxels for others, and unchanged ground for the end of the district, or for long.
"""

import logging
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Set
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.codec import REPORT, snap
from gnd.gnd_map.day import day_of
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.changes import ChangeReport, TileChange
from gnd.schemas.course import Course
from gnd.schemas.keys import change_key
from gnd.schemas.report_id import deterministic_report_id
from gnd.vehicle_agent.config import ReportParameters
from gnd.vehicle_agent.detect.classify import Classification, classify, tile_change
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.detect.doubts import (
    LEAST_WITHHELD,
    TileAccount,
    TileDoubts,
    beyond_map,
    changed_share_of,
    doubt_of,
    withheld_change,
)
from gnd.vehicle_agent.detect.shift import Shift, costs_at
from gnd.vehicle_agent.detect.tile_shift import pose_error_of_tile
from gnd.vehicle_agent.detect.trial import POINTS_OF_POOR_SCAN, Trial, some_of
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty
from gnd.vehicle_agent.localise.estimates import PoseEstimate
from gnd.vehicle_agent.localise.level import looked_at, spreads
from gnd.vehicle_agent.localise.match_map import MatchMapCache
from gnd.vehicle_agent.localise.parameters import RegistrationParameters
from gnd.vehicle_agent.report.packing import AT_ONCE_BYTES, is_measured, pack
from gnd.vehicle_agent.report.sink import ReportSink
from gnd.vehicle_agent.segment.segmenter import SegmentedScan
from gnd.vehicle_agent.surroundings import left_behind
from gnd.vehicle_agent.tracks import Tracks
from gnd.vehicle_agent.waiting import Patient, ScanRoom

VOXELS_AT_ONCE = 2500  # tiles are decided with one scan until they have so many voxels: in town one or two
STEP_M = 2.0  # tiles left behind are looked for after this much way
_LEAVE_M: Final = 4.0
"""A tile this much farther away than detection reaches gets no more evidence: its classes are decided. It holds how far
the LiDAR stands from the vehicle's origin, and what the vehicle drives during a scan."""
SOON_VOXELS: Final = 48
"""Where so many voxels of one tile have changed, a report is due at once. On ground that has not changed, detection
errs in up to some 30."""
_HOUR_NS: Final = 3_600_000_000_000
_COURSE_STEP_RAD: Final = 2e-3
_DECIDE_MS: Final = 25.0
_REPORT_MS: Final = 9.0
"""To decide the tiles that are decided at once, and to report a district."""
_SOON_S: Final = 0.3
"""Such a report waits this long for tiles that are left together with the first ..."""
APART_S: Final = 3.0
"""... and follows the one before no faster than this."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Identity:
    """Who made a report: the same in every report of a drive."""

    vehicle: str
    drive_id: str
    sensor_model: str
    layer: str
    software: str = field(default_factory=lambda: f"gnd-fleet {version('gnd-fleet').partition('+')[0]}")
    """Without the commit between releases: it would cost ten bytes a report."""
    is_private: bool = False
    """The begin of the trip is told to the hour before."""

    def begun_ns(self, t_ns: int) -> int:
        """The begin of the trip (ns) as it is told, in report ids and as the time of the first scan."""
        return t_ns - t_ns % _HOUR_NS if self.is_private else t_ns

    def course_as_told(self, course: Course | None) -> Course | None:
        """The course in the vehicle's own frame; its last digits would tell one vehicle from all others."""
        if course is None or not self.is_private:
            return course
        steps = round(course.turn_rad / _COURSE_STEP_RAD)
        return Course.of(steps * _COURSE_STEP_RAD, max(course.sigma_rad, _COURSE_STEP_RAD))


@dataclass(slots=True)
class _Stretch:
    """The scans that the pending changes of all districts rest on."""

    first_ns: int
    last_ns: int


@dataclass(slots=True)
class _PendingTiles:
    """Statements about tiles of one district that wait to be reported together.

    Attributes:
        since_m: odometer at the first of them ...
        since_ns: ... and time of the scan.
        changed_m, changed_ns: the same of the first that names a change; None: none does.
    """

    since_m: float
    since_ns: int
    changed_m: float | None = None
    changed_ns: int | None = None
    changes: dict[TileId, TileChange] = field(default_factory=dict)
    bases: dict[TileId, Tile] = field(default_factory=dict)

    def add(self, change: TileChange, base: Tile, odometer_m: float, t_ns: int) -> None:
        """Take a statement about a tile that there is none about yet."""
        self.changes[change.tile], self.bases[change.tile] = change, base
        if len(change.changed) and self.changed_ns is None:
            self.changed_m, self.changed_ns = odometer_m, t_ns

    def is_due(self, odometer_m: float, t_ns: int, reported_ns: int | None, most: ReportParameters) -> bool:
        """Whether it has waited long enough: for the next tiles, for more voxels, or for the district's end.

        Args:
            odometer_m: way so far.
            t_ns: time of the scan.
            reported_ns: when changes were reported last; None: never.
            most: how long is enough.
        """
        if odometer_m - self.since_m > most.unchanged_m or t_ns - self.since_ns > most.unchanged_s * 1e9:
            return True
        if self.changed_m is None or self.changed_ns is None:
            return False
        if odometer_m - self.changed_m > most.longest_m or t_ns - self.changed_ns > most.longest_s * 1e9:
            return True
        apart = reported_ns is None or t_ns - reported_ns > APART_S * 1e9
        many = max(len(change.changed) for change in self.changes.values()) >= SOON_VOXELS
        return many and apart and t_ns - self.changed_ns > _SOON_S * 1e9


@dataclass(slots=True)
class LargestShift:
    """The largest pose error that was found."""

    shift_m: float = 0.0
    turn_deg: float = 0.0

    def see(self, shift: Shift) -> None:
        """Take a pose error."""
        self.shift_m = max(self.shift_m, float(np.linalg.norm(shift.shift_m)))
        self.turn_deg = max(self.turn_deg, float(np.degrees(np.linalg.norm(shift.turn_rad))))


class Reporter:
    """Feeds refined scans to the detector, decides the tiles left behind and puts reports into the outbox.

    Scans are evidence only once their poses have stood the shift test (`trial`); a tile whose changes a shift explains
    is held back and reported as such, in a report of its own that is only sent whole.

    Report ids are made of vehicle, drive, district and the report's number in it, so a restarted agent, which drives
    its recording again, makes the same ids; where it would put other tiles together than in its first life, each is
    stated once all the same. New Gaussians are moved onto the lattice that they travel on, so that the
    short form of a report and the whole one are equal to the bit. `course` gives where the vehicle drives in its
    own frame, as far as it knows; `statement` makes the content of a tile, by default `statement_on_lattice`.
    """

    def __init__(
        self,
        detector: ChangeDetector,
        outbox: ReportSink,
        identity: Identity,
        start_ns: int,
        parameters: ReportParameters,
        course: Callable[[], Course | None] = lambda: None,
        statement: Callable[[Classification], TileChange] | None = None,
    ) -> None:
        self.classes: Counter[str] = Counter()
        self.counts: Counter[str] = Counter()
        self.doubts: Counter[str] = Counter()
        """Tiles by reason of doubt."""
        self.largest_shift = LargestShift()
        self._detector, self._outbox, self._who = detector, outbox, identity
        self._start_ns, self._parameters, self._course = start_ns, parameters, course
        self._statement = statement or statement_on_lattice
        self._pending: dict[District, _PendingTiles] = {}
        self._numbers: Counter[District] = Counter()
        self._has_ended = False
        self._stretch: _Stretch | None = None
        self._looked_at: F64 | None = None
        self._here_ns = start_ns  # time of the newest final pose
        self._reported_ns: int | None = None  # when changes were reported last
        self._open_districts: set[District] = set()
        self._stated_before: Counter[TileId] = Counter()  # in reports of an earlier life that have the same ids
        self._tracks = Tracks(detector.local_map.grid_frame.frame)
        self._match_map = MatchMapCache(detector.local_map, RegistrationParameters().noise_m)
        self._trial = Trial(self._match_map)
        self._left_behind_m = max(detector.parameters.range_max_m + _LEAVE_M, parameters.hold_m)
        self._doubts = TileDoubts(detector.local_map.grid_frame)
        self._T_map_vehicle: F64 | None = None  # of the newest scan that counted
        self._shifted = 0
        self._to_decide, self._to_report = Patient(), Patient()

    def add_scan(self, segmented: SegmentedScan) -> None:
        """Take a scan, and go on."""
        self.take(segmented)
        self.go_on()

    def take(self, segmented: SegmentedScan) -> None:
        """Take a scan: it waits for its test, if its pose is good enough for evidence."""
        estimate = segmented.scan.estimate
        pose, most = PoseUncertainty.of(estimate), self._parameters
        if estimate.health != "good" or pose.sigma_m > most.max_sigma_m or pose.sigma_rad > most.max_sigma_rad:
            self.counts["scans_uncertain"] += 1
            self._remember(segmented, "uncertain")
            return
        if estimate.disagrees:
            self.counts["scans_disagreeing"] += 1
            self._remember(segmented, "disagree")
        if not most.check_poses:
            self._count(segmented)
            return
        self._trial.take(segmented)

    def go_on(self, room: ScanRoom | None = None) -> None:
        """Test poses, and count the rays of scans that have stood the test, as far as there is room."""
        for one in self._trial.go_on(room):
            self._count(one)
        self._hear_trial()

    def take_back(self, until_ns: int) -> None:
        """The pose was wrong, and it is not known since when: scans up to this time that do not count yet never will.

        Poses are final some seconds after their scans, and the localiser itself drops what it still holds when it is
        lost; so this reaches back to before the moment at which the error was noticed.
        """
        self._trial.take_back(until_ns)
        self._hear_trial()

    def take_shifted(self) -> int:
        """How many scans have not stood the shift test since this was asked last."""
        shifted, self._shifted = self._shifted, 0
        return shifted

    def _remember(self, segmented: SegmentedScan, what: str) -> None:
        """Tiles seen by a scan whose pose is to be noted."""
        scan = segmented.scan
        if len(scan):
            ends_m, starts_m = scan.rays.restore()
            centre = starts_m[0]
            points = (ends_m - centre).astype(np.float32)
            self._doubts.poor(some_of(points, centre, POINTS_OF_POOR_SCAN), what)

    def _hear_trial(self) -> None:
        """Which tiles the tried segments saw, and how far their poses were off."""
        for tried in self._trial.take_tried():
            costs = None
            if tried.verdict == "shifted":
                self._shifted += tried.scans
                self.largest_shift.see(tried.shift)
                costs = costs_at(tried.points_map_m, np.eye(4), self._match_map.near(tried.T_map_vehicle[:3, 3]))
            self._doubts.tried(tried, costs)
        self.counts.update(self._trial.counts)
        self._trial.counts.clear()

    def _count(self, segmented: SegmentedScan) -> None:
        scan = segmented.scan
        pose = PoseUncertainty.of(scan.estimate)
        self.counts["scans_used"] += 1
        self.counts["points"] += len(segmented.moving)
        self.counts["moving_points"] += int(np.count_nonzero(segmented.moving))
        ends_m, starts_m = scan.rays.restore()
        along_vehicle = (looked_at(ends_m) - looked_at(starts_m)) @ scan.estimate.T_map_vehicle[:3, :3]
        self.counts["rays"] += self._detector.add_scan(
            ends_m, starts_m, segmented.moving, pose, sees_heights=spreads(along_vehicle)
        )
        self._T_map_vehicle = scan.estimate.T_map_vehicle
        self._lengthen(scan.t_ns)
        self._tracks.add_scan(scan.t_ns, ends_m, starts_m, scan.estimate.T_map_vehicle)

    def leave_behind(self, estimate: PoseEstimate, odometer_m: float, room: ScanRoom | None = None) -> None:
        """Decide the tiles that the refined pose has left, and report what has waited long enough; with one of the next
        scans, if there is no room now.
        """
        room, self._here_ns = room or ScanRoom(), estimate.t_ns
        self._decide_left(estimate, odometer_m, room)
        due = [
            district
            for district, pending in self._pending.items()
            if district not in self._open_districts
            or pending.is_due(odometer_m, estimate.t_ns, self._reported_ns, self._parameters)
        ]
        for district in due:
            if self._to_report.may(_REPORT_MS, room):
                self._report(district)

    def _decide_left(self, estimate: PoseEstimate, odometer_m: float, room: ScanRoom) -> None:
        waiting = self._trial.oldest  # what it saw is not counted yet: its tiles are not left
        frame = self._detector.local_map.grid_frame.frame
        p_map = (estimate if waiting is None else waiting).T_map_vehicle[:3, 3]
        if self._looked_at is not None and np.linalg.norm(p_map - self._looked_at) < STEP_M:
            return
        self._looked_at = p_map.copy()
        touched = self._detector.touched_tiles()
        self._tracks.touched(touched)
        open_tiles = set(touched) | set(self._doubts.tiles())
        left = left_behind(frame, open_tiles, p_map, self._left_behind_m)
        now = self._few_of(left) if left and self._to_decide.may(_DECIDE_MS, room) else ()
        if len(now) < len(left):
            self._looked_at = None  # the rest with the next scans
        self._decide(now, odometer_m)
        gone = left_behind(frame, self._doubts.all_tiles(), p_map, self._left_behind_m)
        self._doubts.forget(set(gone) - open_tiles)  # what is known of those that wait counts when they are decided
        self._open_districts = {t.district for t in open_tiles - set(now)}

    def _few_of(self, left: Collection[TileId]) -> tuple[TileId, ...]:
        """The first of the tiles that were left: one, or more of small ones; many at once would make a vehicle late."""
        ordered, voxels, n = sorted(left), 0, 0
        while n < len(ordered) and (n == 0 or voxels < VOXELS_AT_ONCE):
            tile = self._detector.local_map.tile(ordered[n])
            voxels += 0 if tile is None else len(tile.gaussians)
            n += 1
        return tuple(ordered[:n])

    def report_all(self, odometer_m: float) -> None:
        """The drive has ended: decide and report everything."""
        self._has_ended = True
        for one in self._trial.flush():
            self._count(one)
        self._hear_trial()
        self._decide({*self._detector.touched_tiles(), *self._doubts.tiles()}, odometer_m)
        for district in list(self._pending):
            self._report(district)

    def account(self) -> dict[str, Any]:
        """Tiles by reason of doubt, and the largest pose error that was found, for `result.json`."""
        worst = self.largest_shift
        return {
            "tiles": dict(self.doubts),
            "largest_shift_m": round(worst.shift_m, 4),
            "largest_turn_deg": round(worst.turn_deg, 4),
        }

    @property
    def _now_ns(self) -> int:
        """Time of the newest scan that counts."""
        return self._stretch.last_ns if self._stretch is not None else self._start_ns

    def _lengthen(self, t_ns: int) -> None:
        if self._stretch is None:
            self._stretch = _Stretch(t_ns, t_ns)
        self._stretch.last_ns = max(self._stretch.last_ns, t_ns)

    def _decide(self, tiles: Collection[TileId], odometer_m: float) -> None:
        if not tiles:
            return
        for tile_id, evidence in self._detector.finish(tiles).items():
            account = self._doubts.take(tile_id)
            found = self._without_pose_error(classify(evidence, self._detector.parameters), account)
            if len(account.withheld) >= LEAST_WITHHELD and (account.explained or not found.observed.any()):
                self._hold_back(found, account, odometer_m)
                continue
            for name, n in zip(ChangeClass.__members__, np.bincount(found.change_class, minlength=6), strict=True):
                self.classes[name.lower()] += int(n)
            self.counts["voxels_beyond_map"] += int(beyond_map(found).sum())
            if found.observed.any():
                doubt = doubt_of(found, account, day_of(self._now_ns))
                self._take(replace(self._statement(found), doubt=doubt), evidence.base, odometer_m)

    def _without_pose_error(self, found: Classification, account: TileAccount) -> Classification:
        """The classes without what a shift of the whole tile explains, although each stretch of the drive passed."""
        if not self._parameters.check_poses or self._T_map_vehicle is None:
            return found
        error = pose_error_of_tile(found, self._match_map, self._T_map_vehicle)
        if error is None:
            return found
        self.largest_shift.see(error.shift)
        account.shift, account.explained, account.pose = error.shift, error.most, found.evidence.pose
        if error.most:
            account.withheld |= set(found.evidence.voxel_id[found.changed].tolist())
            return found
        self.counts["changes_held_back"] += int(error.explained.sum())
        account.off = True
        abstains = np.where(error.explained, ChangeClass.UNMEASURED, found.change_class).astype(np.uint8)
        return Classification(found.evidence, abstains)

    def _hold_back(self, found: Classification, account: TileAccount, odometer_m: float) -> None:
        """Say of a tile only that a pose error explains it; where there is no map, nothing could be."""
        self.counts["tiles_held_back"] += 1
        self.counts["changes_held_back"] += len(account.withheld)
        base = found.evidence.base
        if base.version:
            self._take(withheld_change(base, account, changed_share_of(found)), base, odometer_m)

    def _take(self, change: TileChange, base: Tile, odometer_m: float) -> None:
        """Keep a statement until its district is reported."""
        if change.doubt is not None:
            self.counts["tiles_doubtful"] += 1
            self.doubts.update(change.doubt.words)
        district = change.tile.district
        if district in self._pending and change.tile in self._pending[district].changes:
            self._report(district)  # the vehicle came back: one statement a tile and report
        pending = self._pending.setdefault(district, _PendingTiles(odometer_m, self._here_ns))
        pending.add(change, base, odometer_m, self._here_ns)

    def _report(self, district: District) -> None:
        """One report of what is sent, and one of what is held back: the short form would call its voxels observed."""
        pending = self._pending.pop(district)
        if pending.changed_ns is not None:
            self._reported_ns = self._here_ns
        held_back = {t for t, change in pending.changes.items() if change.doubt is not None and change.doubt.withheld}
        for tiles in (pending.changes.keys() - held_back, held_back):
            self._put(district, tiles, pending, whole=tiles is held_back)

    def _put(self, district: District, tiles: Set[TileId], pending: _PendingTiles, *, whole: bool) -> None:
        """Report these of the pending tiles; those that an earlier life of this agent has stated stand as they are."""
        tiles = {tile for tile in tiles if not self._outbox.hides(tile)}
        while tiles := self._unstated(tiles):
            report = self._make(district, [pending.changes[t] for t in sorted(tiles)])
            self._numbers[district] += 1
            if self._put_report(report, pending.bases, whole=whole):
                self.counts["reports"] += 1
                self.counts["changed_voxels"] += sum(len(change.changed) for change in report.tiles)
                _log.info("report %s: %d tiles of district %s", report.report_id, len(report.tiles), district)
                return
            self.counts["reports_known"] += 1
            first = self._outbox.body_of(report.report_id)
            self._stated_before.update(tiles if first is None else (c.tile for c in ChangeReport.decode(first).tiles))

    def _unstated(self, tiles: Set[TileId]) -> Set[TileId]:
        """Those of `tiles` that no report of an earlier life has stated; each of its statements counts once."""
        stated = {tile for tile in tiles if self._stated_before[tile] > 0}
        self._stated_before.subtract(stated)
        return tiles - stated

    def _put_report(self, report: ChangeReport, bases: Mapping[TileId, Tile], *, whole: bool) -> bool:
        packed = b"" if whole else self._packed(report, bases)
        needed = [bases[c.tile] for c in report.tiles if c.base_sha and is_measured(c).any()] if packed else []
        return self._outbox.put(
            report.report_id, change_key(report.layer, report.district), report.encode(), packed, needed
        )

    def _packed(self, report: ChangeReport, bases: Mapping[TileId, Tile]) -> bytes:
        """The report's first half in short; empty where it can only be sent whole."""
        try:
            track = self._tracks.take(report.district, [change.tile for change in report.tiles])
            if self._parameters.protocol == "full":
                return b""
            of_sha = {c.base_sha: bases[c.tile].gaussians for c in report.tiles if c.base_sha}
            return pack(report, of_sha, track, AT_ONCE_BYTES, is_last=self._has_ended).encode()
        except GndError as error:
            self.counts["reports_not_packed"] += 1
            _log.warning("report %s can only be sent whole: %s", report.report_id, error)
            return b""

    def _make(self, district: District, changes: list[TileChange]) -> ChangeReport:
        stretch = self._stretch or _Stretch(self._start_ns, self._start_ns)
        who, number = self._who, str(self._numbers[district])
        begun_ms = who.begun_ns(self._start_ns) // 1_000_000
        report_id = deterministic_report_id(begun_ms, who.vehicle, who.drive_id, who.layer, district.path, number)
        return ChangeReport(
            report_id=report_id,
            vehicle=who.vehicle,
            sensor_model=who.sensor_model,
            software=who.software,
            district=district,
            first_ns=who.begun_ns(stretch.first_ns),
            last_ns=stretch.last_ns,
            tiles=tuple(changes),
            layer=who.layer,
            course=who.course_as_told(self._course()),
        )


def statement_on_lattice(found: Classification) -> TileChange:
    """The content of a report about a tile: its classes, and its new Gaussians on the lattice on which they travel."""
    return on_lattice(tile_change(found))


def on_lattice(change: TileChange) -> TileChange:
    """The change with its new Gaussians, and those that it is unsure of, on the lattice "report"."""
    return replace(change, changed=snap(change.changed, REPORT), unsure=snap(change.unsure, REPORT))
