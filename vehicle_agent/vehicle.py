"""The parts of one running vehicle, put together and taken apart in order."""

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

from fleet_bus.bus import Bus, open_bus
from fleet_bus.config import BusConfig
from fleet_bus.ledger import Ledger
from gnd_map.geodesy import LocalFrame
from gnd_map.grid import GridFrame
from gnd_map.tile_id import TileId
from schemas.drive import DriveHeader, DriveItem, GnssFix, MotionSample, ReferencePose, Scan
from schemas.drive_mcap import read_drive, read_header
from schemas.keys import alive_key
from schemas.traffic import TrafficLine, TrafficSample
from vehicle_agent.cache import TileCache
from vehicle_agent.config import AgentConfig
from vehicle_agent.detect.detector import ChangeDetector
from vehicle_agent.download import TileFetcher
from vehicle_agent.errors import VehicleError
from vehicle_agent.local_map import LocalMap
from vehicle_agent.localise.estimates import RefinedScan
from vehicle_agent.localise.localiser import Localiser
from vehicle_agent.outbox import Outbox
from vehicle_agent.place import Place
from vehicle_agent.report import Identity, Reporter
from vehicle_agent.result import Evaluation, HealthTimeline, memory_mb
from vehicle_agent.scans import Guard
from vehicle_agent.sending import SenderThread
from vehicle_agent.surroundings import Surroundings
from vehicle_agent.telemetry import Telemetry
from vehicle_agent.updates import Updates

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class Vehicle:
    """Everything that one drive needs; made by `open_vehicle`. The main thread owns it all but the three threads."""

    config: AgentConfig
    header: DriveHeader
    stop: threading.Event
    bus: Bus
    ledger: Ledger
    cache: TileCache
    outbox: Outbox
    fetcher: TileFetcher
    updates: Updates
    sender: SenderThread
    surroundings: Surroundings
    localiser: Localiser
    reporter: Reporter
    place: Place
    guard: Guard
    evaluation: Evaluation
    timeline: HealthTimeline
    started_s: float
    scans: int = 0

    def drive(self) -> Iterator[DriveItem]:
        """The recording in time order, at the pace asked for, without what cannot be used, until the end or `stop`."""
        for item in self.guard.usable(paced(read_drive(self.config.drive), self.config.pace, self.stop)):
            if self.stop.is_set():
                return
            if isinstance(item, ReferencePose):
                self.evaluation.take_reference(item)  # for the account of errors only
                continue
            yield item
            self.place.take(item, self.localiser.online)
            self.timeline.note(item.t_ns, self.place.health)
            self.ledger.set_position(self.place.odometer_m, item.t_ns)

    def download(self) -> None:
        """Apply what others changed, and hold the tiles around and ahead."""
        self.updates.apply()
        self.surroundings.follow(self.place, self.stop, wait=self.config.waits_for_tiles)
        self.updates.follow(self.surroundings.wanted)

    def localise(self, item: DriveItem) -> list[RefinedScan]:
        """Feed the localiser; the scans whose poses have become final."""
        if isinstance(item, MotionSample):
            self.localiser.push_motion(item)
        elif isinstance(item, GnssFix):
            self.localiser.push_gnss(item)
        elif isinstance(item, Scan):
            self.scans += 1
            return self.localiser.push_scan(item)
        return []

    def detect(self, scan: RefinedScan) -> None:
        """Count the rays of a scan whose pose is final."""
        self.evaluation.estimates.append(scan.estimate)
        self.reporter.add_scan(scan)

    def report(self, scan: RefinedScan) -> None:
        """Decide the tiles that this scan's pose has left behind; a district left behind goes to the outbox."""
        self.reporter.leave_behind(scan.estimate, self.place.odometer_m)

    def report_the_rest(self) -> None:
        """Decide and report everything: the drive has ended."""
        self.reporter.report_all(self.place.odometer_m)

    def upload(self) -> None:
        """Wait until the outbox is empty, for a bounded time."""
        if not self.sender.drain(self.config.report.drain_s, self.stop):
            _log.warning("%s: %d reports are not acknowledged", self.config.vehicle, self.outbox.counts().pending)

    def sample(self) -> TrafficSample:
        """The ledger's totals, position and health, for the bus."""
        lat, lon = self.place.geodetic
        wire = self.bus.wire()
        return TrafficSample(
            vehicle=self.config.vehicle,
            t_ns=self.place.t_ns,
            odometer_m=self.place.odometer_m,
            lines=tuple(TrafficLine(x.kind, x.direction, x.messages, x.app_bytes) for x in self.ledger.totals()),
            wire_up_bytes=wire.up,
            wire_down_bytes=wire.down,
            lat_rad=lat,
            lon_rad=lon,
            health=self.place.health,
            tiles=self.fetcher.counts["blob"],
            reports=self.outbox.counts().acknowledged,
        )

    def result(self) -> dict[str, Any]:
        """What the drive came to, as plain values."""
        counts, reporter, wire = self.outbox.counts(), self.reporter, self.bus.wire()
        return {
            "vehicle": self.config.vehicle,
            "drive_id": self.header.drive_id,
            "sensor_model": self.header.sensor_model,
            "finished": not self.stop.is_set(),
            "wall_s": round(time.monotonic() - self.started_s, 3),
            "distance_km": round(self.place.odometer_m / 1000, 5),
            "scans": self.scans,
            "scans_bad": dict(self.guard.bad),
            "scans_dropped": self.localiser.dropped_scans,
            "scans_refined": len(self.evaluation.estimates),
            **{name: reporter.counts[name] for name in ("scans_used", "scans_uncertain", "rays", "changed_voxels")},
            "classes": dict(reporter.classes),
            "tiles_downloaded": self.fetcher.counts["blob"],
            "tiles": dict(self.fetcher.counts),
            "updates_received": self.updates.counts["received"],
            "updates": dict(self.updates.counts),
            "reports_sent": counts.total,
            "reports_acknowledged": counts.acknowledged,
            "reports_quarantined": counts.quarantined,
            "reports_pending": counts.pending,
            "quarantined": dict(self.outbox.refused()),
            "last_error": self.sender.last_error or self.fetcher.last_error or self.guard.last_problem,
            "traffic": {
                "up_bytes": self.ledger.total_bytes("up"),
                "down_bytes": self.ledger.total_bytes("down"),
                "up_wire_bytes": wire.up,
                "down_wire_bytes": wire.down,
            },
            "health": self.timeline.as_json(),
            "localisation": self.evaluation.errors(),
            "memory_mb": memory_mb(),
        }


@contextmanager
def open_vehicle(config: AgentConfig, stop: threading.Event) -> Iterator[Vehicle]:
    """Open files, bus and threads of one agent; closes them in reverse order.

    Raises:
        DriveError: the recording cannot be read.
        VehicleError: it has no GNSS fix to start from, or cache or outbox cannot be opened.
        NoRouter: nothing answers at `config.connect`.
    """
    header, fix = read_header(config.drive), first_fix(config)
    frame = LocalFrame.of_tile(TileId.from_geodetic(fix.lat_rad, fix.lon_rad))
    local_map = LocalMap(GridFrame.around(frame, [TileId.from_geodetic(fix.lat_rad, fix.lon_rad)]))
    detector = ChangeDetector(local_map, config.detect)
    ledger = Ledger(config.vehicle, config.ledger_path)
    identity = Identity(config.vehicle, header.drive_id, header.sensor_model, config.layer)
    with ExitStack() as stack:
        outbox = _closing(stack, Outbox(config.work_dir / "outbox.sqlite"))
        cache = _closing(stack, TileCache(config.work_dir / "cache.sqlite", config.layer))
        bus_config = BusConfig(connect=config.connect, link=config.link)
        bus = stack.enter_context(open_bus(bus_config, ledger, config.vehicle))
        bus.declare_alive(alive_key("agent", config.vehicle))
        fetcher = TileFetcher(bus, cache, config.download)
        surroundings = Surroundings(local_map, fetcher, detector, cache, config.download)
        sender = SenderThread(bus, outbox)
        vehicle = Vehicle(
            config=config,
            header=header,
            stop=stop,
            bus=bus,
            ledger=ledger,
            cache=cache,
            outbox=outbox,
            fetcher=fetcher,
            updates=Updates(bus, cache, fetcher, surroundings.replace),
            sender=sender,
            surroundings=surroundings,
            localiser=Localiser(local_map, header.T_vehicle_lidar, config.localise),
            reporter=Reporter(detector, outbox, identity, fix.t_ns, config.report),
            place=Place(frame, fix),
            guard=Guard(),
            evaluation=Evaluation.between(frame, header.anchor),
            timeline=HealthTimeline(),
            started_s=time.monotonic(),
        )
        telemetry = Telemetry(bus, config.vehicle, vehicle.sample)
        try:
            yield vehicle
            telemetry.close()
        finally:
            bus.close()  # ends every request under way, so that the threads can end
            telemetry.close()
            sender.close()
            fetcher.close()


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


def _closing(stack: ExitStack, part: Any) -> Any:
    stack.callback(part.close)
    return part
