"""The parts of one running vehicle, put together; each method is one step of the route in `agent.py`."""

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.course import Course
from gnd.schemas.doubt import tiles_by_reason
from gnd.schemas.drive import Detections, DriveHeader, DriveItem, GnssFix, MotionSample, ReferencePose, Scan
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.schemas.errors import SchemaError
from gnd.schemas.sweep_distortion import distortion_of
from gnd.schemas.traffic import TrafficLine, TrafficSample
from gnd.vehicle_agent.config import AgentConfig
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.errors import VehicleError
from gnd.vehicle_agent.link import Link, open_link
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.calibration import MotionCalibration
from gnd.vehicle_agent.localise.estimates import RefinedScan
from gnd.vehicle_agent.localise.localiser import Localiser
from gnd.vehicle_agent.localise.remount import header_sigma
from gnd.vehicle_agent.memory import MemoryMeter
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.report import Identity, Reporter
from gnd.vehicle_agent.result import Evaluation, HealthTimeline
from gnd.vehicle_agent.scans import Guard
from gnd.vehicle_agent.segment.segmenter import MotionSegmenter, SegmentedScan
from gnd.vehicle_agent.surroundings import Surroundings
from gnd.vehicle_agent.telemetry import Telemetry
from gnd.vehicle_agent.updates import Updates
from gnd.vehicle_agent.way import WAY_FILE, Way
from gnd.vehicle_agent.world_clock import in_common_time

if TYPE_CHECKING:
    from gnd.vehicle_agent.features.feature_work import FeatureWork

COUNTS = (
    "scans_used", "scans_uncertain", "scans_disagreeing", "scans_shifted", "scans_taken_back", "points",
    "moving_points", "rays", "changed_voxels", "tiles_doubtful", "tiles_held_back", "changes_held_back",
    "voxels_beyond_map",
)  # fmt: skip
"""What the reporter counts, as `result.json` names it."""

KNOWN_COURSE_RAD = 2e-3
_log = logging.getLogger(__name__)


@dataclass(slots=True)
class Vehicle:
    """Everything that one drive needs; made by `open_vehicle`, owned by the agent's main thread."""

    config: AgentConfig
    header: DriveHeader
    stop: threading.Event
    link: Link
    surroundings: Surroundings
    updates: Updates[Tile]
    localiser: Localiser
    segmenter: MotionSegmenter
    reporter: Reporter
    place: Place
    evaluation: Evaluation
    way: Way
    features: "FeatureWork | None"
    guard: Guard = field(default_factory=Guard)
    timeline: HealthTimeline = field(default_factory=HealthTimeline)
    started_s: float = field(default_factory=time.monotonic)
    memory: MemoryMeter = field(default_factory=MemoryMeter)
    scans: int = 0
    damage: SchemaError | None = None

    def drive(self) -> Iterator[DriveItem]:
        """The recording in time order, at its pace and in the common time, without what cannot be used, until its end
        or `stop`.

        A recording that turns out to be damaged on the way ends there: what was seen until then is still reported, and
        `damage` says why.
        """
        items = paced(read_drive(self.config.drive), self.config.pace, self.stop)
        items = in_common_time(items, self.config.departure, self.stop)
        try:
            for item in self.guard.usable(items):
                if self.stop.is_set():
                    return
                if isinstance(item, ReferencePose):
                    self.evaluation.take_reference(item)  # for the account of errors only
                    continue
                yield item
                self._note(item)
        except SchemaError as damage:
            self.damage = damage
            _log.error("%s: the drive ends at %d ns: %s", self.config.vehicle, self.place.t_ns, damage)

    def _note(self, item: DriveItem) -> None:
        """Keep the books on place, health and way after an item was worked on."""
        self.place.take(item, self.localiser.online)
        self.way.note(self.place)
        if self.timeline.note(item.t_ns, self.place.health):
            self.reporter.take_back(item.t_ns)  # since when it was wrong is not known
            if self.features is not None:
                self.features.take_back()
        self.link.ledger.set_position(self.place.odometer_m, item.t_ns)

    def download(self) -> None:
        """Apply what others changed, and hold the tiles around and ahead."""
        self.updates.apply()
        self.updates.follow(self.surroundings.look_ahead(self.place))  # before asking: nothing is missed in between
        self.surroundings.follow(self.place, self.stop, wait=self.config.waits_for_tiles)
        if self.features is not None:
            self.features.download(self.place, self.stop)

    def look(self, item: DriveItem) -> None:
        """Keep what a detector found until the pose from which it looked is final."""
        if self.features is not None and isinstance(item, Detections):
            self.features.wait(item)

    def localise(self, item: DriveItem) -> Iterator[RefinedScan]:
        """Feed the localiser; gives the scans whose poses have become final, to be used up before the next item."""
        if isinstance(item, MotionSample):
            self.localiser.push_motion(item)
        elif isinstance(item, GnssFix):
            self.localiser.push_gnss(item)
        elif isinstance(item, Scan):
            self.scans += 1
            self.memory.count_scan()
            return self.localiser.take_scan(item)
        return iter(())

    def segment(self, scan: RefinedScan) -> list[SegmentedScan]:
        """Compare the scan with those before and after it; gives the scans whose movers are known now."""
        return self.segmenter.push(scan)

    def segment_the_rest(self) -> Iterator[SegmentedScan]:
        """The scans that wait in the lags of localisation and segmentation: the drive has ended."""
        for refined in self.localiser.flush():
            yield from self.segmenter.push(refined)
        yield from self.segmenter.flush()

    def detect(self, segmented: SegmentedScan) -> None:
        """Count the rays of a scan whose pose is final and whose movers are known."""
        self.evaluation.estimates.append(segmented.scan.estimate)
        self.reporter.add_scan(segmented)

    def report(self, segmented: SegmentedScan) -> None:
        """Decide the tiles that this scan's pose has left behind; a district left behind goes to the outbox."""
        self.reporter.leave_behind(segmented.scan.estimate, self.place.odometer_m)

    def judge(self, segmented: SegmentedScan) -> None:
        """Judge the features in view of a scan whose pose is final; a district left behind goes to the outbox."""
        if self.features is not None:
            self.features.doubt(self.reporter.take_shifted())
            self.features.take(segmented, self.place.odometer_m)

    def report_the_rest(self) -> None:
        """Decide and report everything: the drive has ended."""
        self.reporter.report_all(self.place.odometer_m)
        if self.features is not None:
            self.features.finish()

    def upload(self) -> None:
        """Wait until the cloud has all that it wants of the reports, for a bounded time."""
        if not self.link.sender.drain(self.config.report.drain_s, self.stop):
            _log.warning("%s: %d reports are not released", self.config.vehicle, self.link.outbox.counts().open)

    def sample(self) -> TrafficSample:
        """The ledger's totals, position and health, for the bus."""
        lat, lon = self.place.geodetic
        wire = self.link.bus.wire()
        lines = (TrafficLine(x.kind, x.direction, x.messages, x.app_bytes) for x in self.link.ledger.totals())
        return TrafficSample(
            vehicle=self.config.vehicle,
            t_ns=self.place.t_ns,
            odometer_m=self.place.odometer_m,
            lines=tuple(lines),
            wire_up_bytes=wire.up,
            wire_down_bytes=wire.down,
            lat_rad=lat,
            lon_rad=lon,
            health=self.place.health,
            tiles=self.link.fetcher.counts["blob"],
            reports=self.link.outbox.counts().acknowledged,
            scans_taken_back=self.reporter.counts["scans_shifted"] + self.reporter.counts["scans_taken_back"],
            tiles_held_back=self.reporter.counts["tiles_held_back"],
            tiles_doubtful=self.reporter.counts["tiles_doubtful"],
            doubts=tiles_by_reason(self.reporter.doubts),
        )

    def result(self) -> dict[str, Any]:
        """What the drive came to, as plain values."""
        return {
            "vehicle": self.config.vehicle,
            "drive_id": self.header.drive_id,
            "sensor_model": self.header.sensor_model,
            "finished": not self.stop.is_set() and self.damage is None,
            "wall_s": round(time.monotonic() - self.started_s, 3),
            "distance_km": round(self.place.odometer_m / 1000, 5),
            **self._scan_counts(),
            **self._link_counts(),
            "features": self.features.account() if self.features is not None else {},
            "health": self.timeline.as_json(),
            "localisation": self.evaluation.errors(),
            "nis": self.localiser.innovations.mean,
            "points_travelling_along": self.localiser.points_travelling_along,
            "calibration": self.localiser.calibration.as_json(),
            "memory_mb": self.memory.read(),
        }

    def _scan_counts(self) -> dict[str, Any]:
        counts = self.reporter.counts
        return {
            "scans": self.scans,
            "scans_bad": dict(self.guard.bad),
            "scans_dropped": self.localiser.dropped_scans,
            "scans_refined": len(self.evaluation.estimates),
            **{name: counts[name] for name in COUNTS},
            "classes": dict(self.reporter.classes),
            "doubts": self.reporter.account(),
        }

    def _link_counts(self) -> dict[str, Any]:
        reports, fetched = self.link.outbox.counts(), self.link.fetcher.counts
        return {
            "tiles_downloaded": fetched["blob"],
            "tiles": dict(fetched),
            "updates_received": self.updates.counts["received"],
            "updates": dict(self.updates.counts),
            "reports_sent": reports.total,
            "reports_acknowledged": reports.acknowledged,
            "reports_quarantined": reports.quarantined,
            "reports_pending": reports.pending,
            "report_messages": dict(self.link.sender.counts),
            "quarantined": dict(self.link.outbox.refused()),
            "last_error": self.link.sender.last_error or self.link.fetcher.last_error or self.guard.last_problem,
        }


@contextmanager
def open_vehicle(config: AgentConfig, stop: threading.Event) -> Iterator[Vehicle]:
    """Read the recording's head, join the bus and put the parts together; closes all in reverse order.

    Raises:
        DriveError: the recording cannot be read.
        VehicleError: it has no GNSS fix to start from, or cache or outbox cannot be opened.
    """
    header, fix = read_header(config.drive), first_fix(config)
    # The map frame is the frame of the tile in which the vehicle starts.
    frame = LocalFrame.of_tile(TileId.from_geodetic(fix.lat_rad, fix.lon_rad))
    who = Identity(config.vehicle, header.drive_id, header.sensor_model, config.layer)
    local_map = LocalMap(GridFrame.around(frame, [TileId.from_geodetic(fix.lat_rad, fix.lon_rad)]))
    with (
        open_link(config) as link,
        _features(config, link, frame, who, fix.t_ns) as features,
        Way(config.work_dir / WAY_FILE, local_map) as way,
    ):
        vehicle = _assemble(config, header, fix, (frame, who), link, stop, features, local_map, way)
        telemetry = Telemetry(link.bus, config.vehicle, vehicle.sample)
        try:
            yield vehicle
        finally:
            telemetry.close()


def _features(
    config: AgentConfig, link: Link, frame: LocalFrame, who: Identity, start_ns: int
) -> AbstractContextManager["FeatureWork | None"]:
    """The part for feature layers; a vehicle that knows voxels only does not even load it."""
    if not config.features.layers:
        return nullcontext(None)
    from gnd.vehicle_agent.features.feature_work import open_features

    return open_features(config, link, frame, who, start_ns)


def _assemble(
    config: AgentConfig,
    header: DriveHeader,
    fix: GnssFix,
    where_and_who: tuple[LocalFrame, Identity],
    link: Link,
    stop: threading.Event,
    features: "FeatureWork | None",
    local_map: LocalMap,
    way: Way,
) -> Vehicle:
    frame, identity = where_and_who
    detector = ChangeDetector(local_map, config.detect)
    surroundings = Surroundings(local_map, link.fetcher, detector, config.download)
    localiser = Localiser(
        local_map, header.T_vehicle_lidar, config.localise, distortion_of(header), header_sigma(header)
    )
    return Vehicle(
        config=config,
        header=header,
        stop=stop,
        link=link,
        surroundings=surroundings,
        updates=Updates(link.bus, link.cache, link.fetcher, surroundings.replace),
        localiser=localiser,
        segmenter=MotionSegmenter(config.segment),
        reporter=Reporter(
            detector, link.outbox, identity, fix.t_ns, config.report, lambda: known_course(localiser.calibration)
        ),
        place=Place(frame, fix),
        evaluation=Evaluation.between(frame, header.anchor),
        way=way,
        features=features,
    )


def known_course(known: MotionCalibration) -> Course | None:
    """The course as a report tells it; None while it is not known well."""
    return Course.of(known.course_rad, known.course_sigma_rad) if known.course_sigma_rad < KNOWN_COURSE_RAD else None


def first_fix(config: AgentConfig) -> GnssFix:
    """The first position of the drive: the map frame is laid there.

    Raises:
        VehicleError: there is none.
    """
    for item in read_drive(config.drive):
        if isinstance(item, GnssFix):
            return item
    raise VehicleError(f"{config.drive} has no GNSS fix: the agent would not know which tiles to ask for")


def paced(items: Iterator[DriveItem], pace: float, stop: threading.Event) -> Iterator[DriveItem]:
    """Hold items back until their time has come, at `pace` times real time; 0 holds nothing back."""
    start_s, first_ns = time.monotonic(), None
    for item in items:
        first_ns = item.t_ns if first_ns is None else first_ns
        if pace > 0:
            due_s = start_s + (item.t_ns - first_ns) * 1e-9 / pace
            stop.wait(max(0.0, due_s - time.monotonic()))
        yield item
