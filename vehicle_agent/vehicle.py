"""The agent's side of a drive: a pipeline fed from a recording, between the bus and the files of the vehicle."""

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from gnd.schemas.doubt import tiles_by_reason
from gnd.schemas.drive import DriveHeader, DriveItem, ReferencePose, Scan
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.schemas.errors import SchemaError
from gnd.schemas.traffic import TrafficLine, TrafficSample
from gnd.vehicle_agent.config import AgentConfig
from gnd.vehicle_agent.features.tiles_on_the_bus import FeatureTilesOnTheBus, open_feature_tiles
from gnd.vehicle_agent.link import Link, open_link
from gnd.vehicle_agent.memory import MemoryMeter
from gnd.vehicle_agent.pipeline import Pipeline
from gnd.vehicle_agent.report import Identity
from gnd.vehicle_agent.result import Evaluation
from gnd.vehicle_agent.sources.recording import first_fix, paced
from gnd.vehicle_agent.sources.world_clock import in_common_time
from gnd.vehicle_agent.telemetry import Telemetry
from gnd.vehicle_agent.tiles_on_the_bus import TilesOnTheBus
from gnd.vehicle_agent.way import WAY_FILE, Way

COUNTS = (
    "scans_used", "scans_uncertain", "scans_disagreeing", "scans_shifted", "scans_taken_back", "points",
    "moving_points", "rays", "changed_voxels", "tiles_doubtful", "tiles_held_back", "changes_held_back",
    "voxels_beyond_map",
)  # fmt: skip
"""What the reporter counts, as `result.json` names it."""

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class Vehicle:
    """Everything that one drive needs; made by `open_vehicle`, owned by the agent's main thread."""

    config: AgentConfig
    header: DriveHeader
    items: Iterator[DriveItem]
    stop: threading.Event
    link: Link
    pipeline: Pipeline[TilesOnTheBus]
    evaluation: Evaluation
    way: Way
    features: FeatureTilesOnTheBus | None
    started_s: float = field(default_factory=time.monotonic)
    memory: MemoryMeter = field(default_factory=MemoryMeter)
    damage: SchemaError | None = None

    def drive(self) -> Iterator[DriveItem]:
        """The recording in time order, at its pace and in the common time, until its end or `stop`.

        A recording that turns out to be damaged on the way ends there: what was seen until then is still reported, and
        `damage` says why.
        """
        items = in_common_time(paced(self.items, self.config.pace, self.stop), self.config.departure, self.stop)
        try:
            for item in items:
                if self.stop.is_set():
                    return
                if isinstance(item, ReferencePose):
                    self.evaluation.take_reference(item)  # for the account of errors only
                else:
                    yield item
        except SchemaError as damage:
            self.damage = damage
            _log.error("%s: the drive ends at %d ns: %s", self.config.vehicle, self.pipeline.place.t_ns, damage)

    def push(self, item: DriveItem) -> None:
        """Feed the pipeline, and keep the books on poses, way and memory."""
        if isinstance(item, Scan):
            self.memory.count_scan()
        self.evaluation.estimates += self.pipeline.push(item).poses
        self.way.note(self.pipeline.place)
        self.link.ledger.set_position(self.pipeline.place.odometer_m, item.t_ns)

    def finish(self) -> None:
        """The drive has ended: what waits is judged, decided and reported."""
        self.evaluation.estimates += self.pipeline.finish().poses

    def upload(self) -> None:
        """Wait until the cloud has all that it wants of the reports, for a bounded time."""
        if not self.link.sender.drain(self.config.report.drain_s, self.stop):
            _log.warning("%s: %d reports are not released", self.config.vehicle, self.link.outbox.counts().open)

    def sample(self) -> TrafficSample:
        """The ledger's totals, position and health, for the bus."""
        place, reporter = self.pipeline.place, self.pipeline.reporter
        lat, lon = place.geodetic
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
            scans_taken_back=reporter.counts["scans_shifted"] + reporter.counts["scans_taken_back"],
            tiles_held_back=reporter.counts["tiles_held_back"],
            tiles_doubtful=reporter.counts["tiles_doubtful"],
            doubts=tiles_by_reason(reporter.doubts),
        )

    def result(self) -> dict[str, Any]:
        """What the drive came to, as plain values."""
        return {
            "vehicle": self.config.vehicle,
            "drive_id": self.header.drive_id,
            "sensor_model": self.header.sensor_model,
            "finished": not self.stop.is_set() and self.damage is None,
            "wall_s": round(time.monotonic() - self.started_s, 3),
            "distance_km": round(self.pipeline.place.odometer_m / 1000, 5),
            **self._scan_counts(),
            **self._link_counts(),
            "features": self._feature_counts(),
            "health": self.pipeline.timeline.as_json(),
            "localisation": self.evaluation.errors(),
            "nis": self.pipeline.localiser.innovations.mean,
            "points_travelling_along": self.pipeline.localiser.points_travelling_along,
            "calibration": self.pipeline.localiser.calibration.as_json(),
            "memory_mb": self.memory.read(),
        }

    def _scan_counts(self) -> dict[str, Any]:
        reporter = self.pipeline.reporter
        return {
            "scans": self.pipeline.scans,
            "scans_bad": dict(self.pipeline.guard.bad),
            "scans_dropped": self.pipeline.localiser.dropped_scans,
            "scans_refined": len(self.evaluation.estimates),
            **{name: reporter.counts[name] for name in COUNTS},
            "classes": dict(reporter.classes),
            "doubts": reporter.account(),
        }

    def _feature_counts(self) -> dict[str, Any]:
        layers = self.pipeline.layers
        if layers is None or self.features is None:
            return {}
        return {"layers": layers.account(), "looks": dict(layers.counts), "tiles": dict(self.features.counts)}

    def _link_counts(self) -> dict[str, Any]:
        updates, reports, fetched = (
            self.pipeline.tiles.updates.counts,
            self.link.outbox.counts(),
            self.link.fetcher.counts,
        )
        return {
            "tiles_downloaded": fetched["blob"],
            "tiles": dict(fetched),
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
def open_vehicle(config: AgentConfig, stop: threading.Event) -> Iterator[Vehicle]:
    """Read the recording's head, join the bus and put the parts together; closes all in reverse order.

    Raises:
        DriveError: the recording cannot be read.
        VehicleError: it has no GNSS fix to start from, or cache or outbox cannot be opened.
    """
    header, (fix, items) = read_header(config.drive), first_fix(read_drive(config.drive), config.drive)
    with open_link(config) as link, open_feature_tiles(config, link, stop) as features:
        pipeline = Pipeline(
            header,
            fix,
            lambda local_map, touched: TilesOnTheBus(link, local_map, touched, config, stop),
            config.pipeline,
            identity=Identity(config.vehicle, header.drive_id, header.sensor_model, config.layer),
            outbox=link.outbox,
            feature_tiles=features,
        )
        evaluation = Evaluation.between(pipeline.place.frame, header.anchor)
        with Way(config.work_dir / WAY_FILE, pipeline.local_map) as way:
            vehicle = Vehicle(config, header, items, stop, link, pipeline, evaluation, way, features)
            telemetry = Telemetry(link.bus, config.vehicle, vehicle.sample)
            try:
                yield vehicle
            finally:
                telemetry.close()
