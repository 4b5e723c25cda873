"""From evidence to the outbox: tiles that the vehicle has left are decided, districts that it has left are reported."""

import logging
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from importlib.metadata import version

import numpy as np

from gnd_map.arrays import F64
from gnd_map.classes import ChangeClass
from gnd_map.codec import REPORT, snap
from gnd_map.errors import GndError
from gnd_map.tile import Tile
from gnd_map.tile_id import District, TileId
from schemas.changes import ChangeReport, TileChange
from schemas.keys import change_key
from schemas.report_id import deterministic_report_id
from vehicle_agent.config import ReportParameters
from vehicle_agent.detect.classify import Classification, classify, tile_change
from vehicle_agent.detect.detector import ChangeDetector
from vehicle_agent.detect.uncertainty import PoseUncertainty
from vehicle_agent.localise.estimates import PoseEstimate
from vehicle_agent.outbox import Outbox
from vehicle_agent.packing import is_measured, pack
from vehicle_agent.segment.segmenter import SegmentedScan
from vehicle_agent.surroundings import left_behind
from vehicle_agent.tracks import Tracks

STEP_M = 3.0  # tiles left behind are looked for after this much way

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Identity:
    """What every report of a drive says about who made it."""

    vehicle: str
    drive_id: str
    sensor_model: str
    layer: str
    software: str = field(default_factory=lambda: f"gnd-fleet {version('gnd-fleet')}")


@dataclass(slots=True)
class _Stretch:
    """The scans that the pending changes of all districts rest on."""

    first_ns: int
    last_ns: int


@dataclass(slots=True)
class _Pending:
    """Changes of one district that wait for its other tiles."""

    since_m: float
    changes: dict[TileId, TileChange] = field(default_factory=dict)
    bases: dict[TileId, Tile] = field(default_factory=dict)


class Reporter:
    """Feeds refined scans to the detector, decides the tiles left behind and puts a report a district into the outbox.

    Report ids are made of vehicle, drive, district and the report's number in it, so a restarted agent, which drives
    its recording again, makes the same ids. New Gaussians are moved onto the lattice that they travel on, so that the
    short form of a report and the whole one say the same, to the bit.
    """

    def __init__(
        self, detector: ChangeDetector, outbox: Outbox, identity: Identity, start_ns: int, parameters: ReportParameters
    ) -> None:
        self.classes: Counter[str] = Counter()
        self.counts: Counter[str] = Counter()
        self._detector, self._outbox, self._who = detector, outbox, identity
        self._start_ns, self._parameters = start_ns, parameters
        self._pending: dict[District, _Pending] = {}
        self._numbers: Counter[District] = Counter()
        self._stretch: _Stretch | None = None
        self._looked_at: F64 | None = None
        self._tracks = Tracks(detector.local_map.grid_frame.frame)

    def add_scan(self, segmented: SegmentedScan) -> None:
        """Count the scan's rays, if its pose is good enough to speak about the world."""
        scan, estimate = segmented.scan, segmented.scan.estimate
        pose, most = PoseUncertainty.of(estimate), self._parameters
        if estimate.health != "good" or pose.sigma_m > most.max_sigma_m or pose.sigma_rad > most.max_sigma_rad:
            self.counts["scans_uncertain"] += 1
            return
        self.counts["scans_used"] += 1
        self.counts["points"] += len(segmented.moving)
        self.counts["moving_points"] += int(segmented.moving.sum())
        self.counts["rays"] += self._detector.add_scan(scan.points_map_m, scan.origins_map_m, segmented.moving, pose)
        self._lengthen(scan.t_ns)
        self._tracks.add_scan(scan)

    def leave_behind(self, estimate: PoseEstimate, odometer_m: float) -> None:
        """Decide the tiles that the refined pose has left, report the districts that have none left to decide."""
        frame, p_map = self._detector.local_map.grid_frame.frame, estimate.T_map_vehicle[:3, 3]
        if self._looked_at is not None and np.linalg.norm(p_map - self._looked_at) < STEP_M:
            return
        self._looked_at = p_map.copy()
        touched = self._detector.touched_tiles()
        self._tracks.touched(touched)
        left = left_behind(frame, touched, p_map, self._parameters.left_behind_m)
        self._decide(left, odometer_m)
        open_districts = {t.district for t in set(touched) - set(left)}
        for district, pending in list(self._pending.items()):
            overdue = odometer_m - pending.since_m > self._parameters.longest_m
            if overdue or district not in open_districts:
                self._report(district)

    def report_all(self, odometer_m: float) -> None:
        """The drive has ended: decide and report everything."""
        self._decide(self._detector.touched_tiles(), odometer_m)
        for district in list(self._pending):
            self._report(district)

    def _lengthen(self, t_ns: int) -> None:
        if self._stretch is None:
            self._stretch = _Stretch(t_ns, t_ns)
        self._stretch.last_ns = max(self._stretch.last_ns, t_ns)

    def _decide(self, tiles: Collection[TileId], odometer_m: float) -> None:
        if not tiles or self._stretch is None:
            return
        for tile_id, evidence in self._detector.finish(tiles).items():
            found = classify(evidence, self._detector.parameters)
            for name, n in zip(ChangeClass.__members__, np.bincount(found.change_class, minlength=6), strict=True):
                self.classes[name.lower()] += int(n)
            if not found.observed.any():
                continue
            change = self._said(found)
            pending = self._pending.setdefault(tile_id.district, _Pending(odometer_m))
            if tile_id in pending.changes:  # the vehicle came back: one statement a tile and report
                self._report(tile_id.district)
                pending = self._pending.setdefault(tile_id.district, _Pending(odometer_m))
            pending.changes[tile_id], pending.bases[tile_id] = change, evidence.base

    def _said(self, found: Classification) -> TileChange:
        """What the report says of a tile; a study may let it say something else."""
        return on_lattice(tile_change(found))

    def _report(self, district: District) -> None:
        pending, stretch = self._pending.pop(district), self._stretch
        if stretch is None or not pending.changes:
            return
        report = self._make(district, pending, stretch)
        self._numbers[district] += 1
        packed = self._packed(report, pending)
        needed = [pending.bases[c.tile] for c in report.tiles if c.base_sha and is_measured(c).any()] if packed else []
        if self._outbox.put(report.report_id, change_key(report.layer, district), report.encode(), packed, needed):
            self.counts["reports"] += 1
            self.counts["changed_voxels"] += sum(len(change.changed) for change in report.tiles)
        else:
            self.counts["reports_known"] += 1  # this agent was restarted: its first statement stands
        _log.info("report %s: %d tiles of district %s", report.report_id, len(report.tiles), district)

    def _packed(self, report: ChangeReport, pending: _Pending) -> bytes:
        """The report's first half in short; empty where it can only be sent whole."""
        try:
            track = self._tracks.take(report.district, pending.changes)
            if self._parameters.protocol == "full":
                return b""
            bases = {c.base_sha: pending.bases[c.tile].gaussians for c in report.tiles if c.base_sha}
            return pack(report, bases, track).encode()
        except GndError as error:
            self.counts["reports_not_packed"] += 1
            _log.warning("report %s can only be sent whole: %s", report.report_id, error)
            return b""

    def _make(self, district: District, pending: _Pending, stretch: _Stretch) -> ChangeReport:
        who, number = self._who, str(self._numbers[district])
        report_id = deterministic_report_id(
            self._start_ns // 1_000_000, who.vehicle, who.drive_id, who.layer, district.path, number
        )
        return ChangeReport(
            report_id=report_id,
            vehicle=who.vehicle,
            sensor_model=who.sensor_model,
            software=who.software,
            district=district,
            first_ns=stretch.first_ns,
            last_ns=stretch.last_ns,
            tiles=tuple(change for _, change in sorted(pending.changes.items())),
            layer=who.layer,
        )


def on_lattice(change: TileChange) -> TileChange:
    """The change with its new Gaussians on the lattice "report"."""
    return replace(change, changed=snap(change.changed, REPORT))
