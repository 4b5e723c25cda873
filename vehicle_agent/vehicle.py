"""The agent's side of a drive: a pipeline fed from a recording, between the bus and the files of the vehicle."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

from gnd.schemas.doubt import tiles_by_reason
from gnd.schemas.drive import DriveHeader, DriveItem, GnssFix, ReferencePose, Scan
from gnd.schemas.errors import SchemaError
from gnd.schemas.health import HealthReport
from gnd.schemas.traffic import NO_POSITION, TrafficLine, TrafficSample
from gnd.vehicle_agent.config import AgentConfig
from gnd.vehicle_agent.link.feature_tiles_on_the_bus import FeatureTilesOnTheBus, open_feature_tiles
from gnd.vehicle_agent.link.link import Link, open_link
from gnd.vehicle_agent.link.outbox import Outbox
from gnd.vehicle_agent.link.telemetry import Telemetry
from gnd.vehicle_agent.link.tiles_on_the_bus import TilesOnTheBus
from gnd.vehicle_agent.link.trial_telemetry import TrialTelemetry
from gnd.vehicle_agent.local_map import LocalMap, Touched
from gnd.vehicle_agent.localise.estimates import RefinedScan
from gnd.vehicle_agent.memory import MemoryMeter
from gnd.vehicle_agent.pipeline import Output, Parts, Pipeline, VehiclePipeline
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.private_places import Circles, PrivatePlaces
from gnd.vehicle_agent.report.reporter import Identity
from gnd.vehicle_agent.result import PoseEvaluation
from gnd.vehicle_agent.sources.live import LiveError
from gnd.vehicle_agent.sources.opening import DriveSource, open_source
from gnd.vehicle_agent.way import WAY_FILE, Way

_log = logging.getLogger(__name__)


def _shown_to_nobody(_output: Output, _place: Place) -> None:
    pass


@dataclass(slots=True)
class OnTheBus:
    """What an open link brings a vehicle."""

    config: AgentConfig
    link: Link
    features: FeatureTilesOnTheBus | None
    stop: threading.Event
    updates: Counter[str] = field(default_factory=Counter)
    """Update notices of the voxel map, by what became of them."""
    trials: TrialTelemetry | None = None
    """What is told of tiles on trial; None: a vehicle that does not match scans with the voxel map."""
    places: PrivatePlaces | None = None
    """Where the vehicle says nothing; None: it has no private places."""

    def tiles(self, local_map: LocalMap, touched: Touched) -> TilesOnTheBus:
        """Make what fills a local map."""
        tiles = TilesOnTheBus(self.link, local_map, touched, self.config, self.stop)
        self.updates = tiles.updates.counts
        registration = self.config.localise.registration
        self.trials = TrialTelemetry(local_map, self.link.fetcher.watched, self.config.layer, registration)
        return tiles

    def see(self, scan: RefinedScan) -> None:
        """Take a scan whose pose has become final."""
        if self.trials is not None:
            self.trials.see(scan)

    def health_reports(self, *, all_of_it: bool = False) -> list[HealthReport]:
        """What there is to tell of tiles on trial."""
        told = [] if self.trials is None else self.trials.due(all_of_it=all_of_it)
        return told if self.places is None else self.places.say(told)


@dataclass(slots=True)
class AgentVehicle:
    """Everything that one drive needs; made by `open_vehicle`, owned by the agent's main thread."""

    config: AgentConfig
    source: DriveSource
    stop: threading.Event
    link: Link
    pipeline: VehiclePipeline
    evaluation: PoseEvaluation
    way: Way
    bus: OnTheBus
    started_s: float = field(default_factory=time.monotonic)
    memory: MemoryMeter = field(default_factory=MemoryMeter)
    damage: SchemaError | LiveError | None = None
    show: Callable[[Output, Place], None] = _shown_to_nobody

    def drive(self) -> Iterator[DriveItem]:
        """Measurements in time order, until the end of the recording or `stop`.

        A recording that turns out to be damaged on the way ends there, and so does a live drive whose time goes back:
        what was seen until then is still reported, and `damage` says why.
        """
        try:
            for item in self.source.items:
                if self.stop.is_set():
                    return
                if isinstance(item, ReferencePose):
                    self.evaluation.take_reference(item)  # for the account of errors only
                else:
                    yield item
        except (SchemaError, LiveError) as damage:
            self.damage = damage
            _log.error("%s: the drive ends at %d ns: %s", self.config.vehicle, self.pipeline.place.t_ns, damage)

    def push(self, item: DriveItem) -> None:
        """Feed the pipeline, and keep the books on poses, way and memory."""
        if isinstance(item, Scan):
            self.memory.count_scan()
        output = self.pipeline.push(item)
        self.evaluation.estimates += output.poses
        if isinstance(item, Scan) and self.bus.trials is not None:
            self.bus.trials.note(self.pipeline.place)
        self.show(output, self.pipeline.place)
        self.way.note(self.pipeline.place)
        if self.bus.places is not None:
            self.bus.places.move(self.pipeline.place)
        self.link.ledger.set_position(self.pipeline.place.odometer_m, item.t_ns)

    def finish(self) -> None:
        """The drive has ended: what waits is judged, decided and reported."""
        if self.bus.places is not None:
            self.bus.places.end()
        output = self.pipeline.finish()
        self.evaluation.estimates += output.poses
        self.show(output, self.pipeline.place)

    def upload(self) -> None:
        """Wait until the cloud has all that it wants of the reports, for a bounded time.

        A live drive is ended by `stop`, so it is waited for all the same.
        """
        stop = threading.Event() if self.config.live.source else self.stop
        if not self.link.sender.drain(self.config.report.drain_s, stop):
            _log.warning("%s: %d reports are not released", self.config.vehicle, self.link.outbox.counts().open)

    def sample(self) -> TrafficSample:
        """The ledger's totals, position and health, for the bus."""
        place, held_back = self.pipeline.place, self.pipeline.held_back
        lat, lon = place.geodetic if self.bus.places is None else NO_POSITION
        wire = self.link.bus.wire()
        lines = (TrafficLine(x.kind, x.direction, x.messages, x.app_bytes) for x in self.link.ledger.totals())
        return TrafficSample(
            vehicle=self.config.vehicle,
            t_ns=place.t_ns,
            odometer_m=place.odometer_m,
            lines=tuple(lines),
            wire_up_bytes=wire.up,
            wire_down_bytes=wire.down,
            lat_rad=lat,
            lon_rad=lon,
            health=place.health,
            tiles=self.link.fetcher.counts["blob"],
            reports=self.link.outbox.counts().acknowledged,
            scans_taken_back=held_back.scans,
            tiles_held_back=held_back.tiles,
            tiles_doubtful=held_back.doubtful,
            doubts=tiles_by_reason(held_back.reasons),
            map_stale_h=0 if self.link.map_age is None else self.link.map_age.stale_h,
        )

    def result(self) -> dict[str, Any]:
        """The results of the drive, as plain values."""
        return {
            "vehicle": self.config.vehicle,
            "drive_id": self.source.header.drive_id,
            "sensor_model": self.source.header.sensor_model,
            "finished": self.damage is None and (bool(self.config.live.source) or not self.stop.is_set()),
            "wall_s": round(time.monotonic() - self.started_s, 3),
            "distance_km": round(self.pipeline.place.odometer_m / 1000, 5),
            "scans_refined": len(self.evaluation.estimates),
            "scans_bad": dict(self.pipeline.guard.bad),
            **self.pipeline.account(),
            **self._link_counts(),
            "live": self.source.account(),
            "localisation": self.evaluation.errors(),
            "memory_mb": self.memory.read(),
            "private": {} if self.bus.places is None else dict(self.bus.places.counts),
        }

    def _link_counts(self) -> dict[str, Any]:
        reports, fetched, updates = self.link.outbox.counts(), self.link.fetcher.counts, self.bus.updates
        check = self.link.fetcher.check
        return {
            "tiles_downloaded": fetched["blob"],
            "tiles": dict(fetched),
            "map_stale_h": 0 if self.link.map_age is None else self.link.map_age.stale_h,
            "versions_checked": {} if check is None else dict(check.counts),
            "feature_tiles": {} if self.bus.features is None else dict(self.bus.features.counts),
            "updates_received": updates["received"],
            "updates": dict(updates),
            "reports_sent": reports.total,
            "reports_acknowledged": reports.acknowledged,
            "reports_quarantined": reports.quarantined,
            "reports_pending": reports.pending,
            "report_messages": dict(self.link.sender.counts),
            "quarantined": dict(self.link.outbox.refused()),
            "last_error": self.link.sender.last_error
            or self.link.fetcher.last_error
            or self.pipeline.guard.last_problem,
        }


@contextmanager
def open_vehicle(config: AgentConfig, stop: threading.Event) -> Iterator[AgentVehicle]:
    """Open the recording or the sensors, join the bus and put the parts together; closes all in reverse order.

    Raises:
        DriveError: the recording cannot be read.
        VehicleError: there is no position to start from, or cache or outbox cannot be opened.
    """
    with (
        open_source(config, stop) as source,
        open_link(config) as link,
        open_feature_tiles(config, link, stop) as feature_tiles,
    ):
        bus = OnTheBus(config, link, feature_tiles, stop, places=_private_places(config, source.fix, link.outbox))
        pipeline = _pipeline(source.header, source.fix, bus)
        evaluation = PoseEvaluation.between(pipeline.place.frame, source.header.anchor)
        with Way(config.work_dir / WAY_FILE, pipeline.tile) as way:
            vehicle = AgentVehicle(config, source, stop, link, pipeline, evaluation, way, bus)
            if source.ros2 is not None:
                from gnd.vehicle_agent.link.ros2_output import Ros2Output

                vehicle.show = Ros2Output(source.ros2.node, pipeline).take
            telemetry = Telemetry(link.bus, config.vehicle, vehicle.sample, bus.health_reports)
            try:
                yield vehicle
            finally:
                telemetry.close()


def _private_places(config: AgentConfig, fix: GnssFix, outbox: Outbox) -> PrivatePlaces | None:
    """What stands between the reports and the outbox where a vehicle has private places."""
    if not config.report.private_m:
        return None
    return PrivatePlaces(Circles(config.private_file, config.report.private_m), config.report.hold_m, fix, outbox)


def _pipeline(header: DriveHeader, fix: GnssFix, bus: OnTheBus) -> VehiclePipeline:
    """What the configured kind of vehicle is fed to; one without LiDAR does not load the parts of one with it."""
    config, link, features = bus.config, bus.link, bus.features
    private, outbox = bus.places is not None, bus.places or link.outbox
    identity = Identity(config.vehicle, header.drive_id, header.sensor_model, config.layer, is_private=private)
    if config.localise_by == "slamcu":
        from gnd.vehicle_agent.features.slamcu.camera_pipeline import CameraPipeline

        signs = replace(identity, layer=config.features.layers[0].name)
        return CameraPipeline(fix, config.pipeline, signs, outbox, features)
    if config.localise_by == "graph":
        from gnd.vehicle_agent.features.mapping.graph_pipeline import GraphPipeline

        return GraphPipeline(fix, config.pipeline, identity, outbox, features)
    return Pipeline(
        header,
        fix,
        bus.tiles,
        config.pipeline,
        identity=identity,
        outbox=outbox,
        feature_tiles=features,
        parts=Parts(placed=(bus.see,)),
    )
