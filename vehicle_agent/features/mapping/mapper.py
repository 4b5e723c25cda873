"""A vehicle that maps features without a LiDAR map: by motion, a low-cost GNSS, a detector, and the lanes of the map.

The route of NFL, section 3: gather while driving; when the vehicle has stopped, one graph of the whole stretch gives
the features and how certain they are; they are uploaded, and gathering begins anew.
"""

import logging
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Final

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import DriveHeader, DriveItem, MotionSample, ReferencePose
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.schemas.errors import SchemaError
from gnd.vehicle_agent.config import AgentConfig
from gnd.vehicle_agent.errors import NewLayerError
from gnd.vehicle_agent.features.download import FeatureDownloader
from gnd.vehicle_agent.features.feature_report import FeatureReporter
from gnd.vehicle_agent.features.layer_parameters import LayerParameters
from gnd.vehicle_agent.features.mapping.feature_drive import FeatureDrive
from gnd.vehicle_agent.features.mapping.held_map import LANES, HeldMap
from gnd.vehicle_agent.features.mapping.mapped import changes_of
from gnd.vehicle_agent.features.mapping.new_layer import map_new_layer
from gnd.vehicle_agent.link import Link, open_link
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.report import Identity
from gnd.vehicle_agent.result import write_json
from gnd.vehicle_agent.scans import Guard
from gnd.vehicle_agent.sources.recording import first_fix, paced
from gnd.vehicle_agent.surroundings import tiles_along

AHEAD_M: Final = 300.0
BESIDE_M: Final = 100.0
STEP_M: Final = 100.0
STILL_MPS: Final = 0.1
STILL_S: Final = 3.0
LEAST_WAY_M: Final = 200.0
"""A stop after less way than this does not end a stretch: queues of cars stop often."""

_log = logging.getLogger(__name__)


def run_mapper(config: AgentConfig, stop: threading.Event) -> dict[str, Any]:
    """Drive one recording to its end, map the features of its layers, upload them, wait for the acknowledgements.

    Returns:
        The content of `work_dir/result.json`.

    Raises:
        GndError: the recording, a file or the bus cannot be used; the message says which and what to do.
    """
    with open_mapper(config, stop) as mapper:
        for item in mapper.drive():
            mapper.download()  # position -> feature tiles and lanes around and ahead
            mapper.gather(item)  # motion, fixes, looks
            if mapper.has_stopped():
                mapper.map()  # graph of the stretch -> features and covariances -> outbox
        mapper.map()
        mapper.upload()  # outbox -> acknowledged
        result = mapper.result()
    result["traffic"] = mapper.link.traffic()  # the link is closed: nothing comes after it
    write_json(config.work_dir / "result.json", result)
    return result


@dataclass(slots=True)
class Mapper:
    """What one drive needs; made by `open_mapper`."""

    config: AgentConfig
    header: DriveHeader
    items: Iterator[DriveItem]
    stop: threading.Event
    link: Link
    frame: LocalFrame
    place: Place
    downloader: FeatureDownloader
    reporters: dict[str, FeatureReporter]
    held: HeldMap
    counts: Counter[str] = field(default_factory=Counter)
    guard: Guard = field(default_factory=Guard)
    gathered: list[DriveItem] = field(default_factory=list)
    since_m: float = 0.0
    still_since_ns: int | None = None
    _asked_at_m: float | None = None

    def drive(self) -> Iterator[DriveItem]:
        """The recording in time order, at the pace asked for, without its reference; a damaged one ends early."""
        try:
            for item in paced(self.items, self.config.pace, self.stop):
                if self.stop.is_set():
                    return
                if self.guard.admits(item) and not isinstance(item, ReferencePose):
                    yield item
        except SchemaError as damage:
            _log.error("%s: the drive ends at %d ns: %s", self.config.vehicle, self.place.t_ns, damage)
            self.counts["damaged"] += 1

    def download(self) -> None:
        """Ask for the tiles around and ahead now and then, and keep what comes: the graph needs all of the stretch."""
        if self._asked_at_m is None or self.place.odometer_m - self._asked_at_m >= STEP_M:
            self._asked_at_m = self.place.odometer_m
            tiles = tiles_along(self.frame, self.place.ahead_map_m(AHEAD_M), BESIDE_M)
            self.downloader.follow(tiles)
            if self.config.waits_for_tiles:
                self.downloader.wait_for(tiles, self.config.download.wait_s, self.stop)
        for layer, changed in self.downloader.step().items():
            for tile_id in sorted(changed):
                self.held.put(layer, tile_id, self.downloader.tile(layer, tile_id))

    def gather(self, item: DriveItem) -> None:
        """Keep a measurement, and the books on place and way."""
        self.gathered.append(item)
        self.place.take(item, None)
        self.link.ledger.set_position(self.place.odometer_m, item.t_ns)
        if isinstance(item, MotionSample):
            moves = abs(item.speed_mps) > STILL_MPS
            self.still_since_ns = None if moves else (self.still_since_ns or item.t_ns)

    def has_stopped(self) -> bool:
        """Whether the vehicle has stood for some seconds after a stretch of way."""
        stood = self.still_since_ns is not None and self.place.t_ns - self.still_since_ns >= STILL_S * 1e9
        return stood and self.place.odometer_m - self.since_m >= LEAST_WAY_M

    def map(self) -> None:
        """Map every layer over the stretch gathered, and report; a stretch that cannot be placed is left out."""
        items, self.gathered = self.gathered, []
        self.since_m = self.place.odometer_m
        for layer in self.config.features.layers:
            try:
                self._map(layer, items)
            except NewLayerError as error:
                self.counts["stretches_refused"] += 1
                _log.warning("%s: no map of layer %s: %s", self.config.vehicle, layer.name, error)

    def _map(self, layer: LayerParameters, items: list[DriveItem]) -> None:
        drive = FeatureDrive.of_items(items, self.frame, layer.name)
        if not drive.looks:
            return
        known = self.held.known(layer.name, layer.kinds)
        found = map_new_layer(drive, lanes=self.held.lanes(), known=known, trust_known=False)
        if found.strains:
            self.counts["stretches_contradicting"] += 1
            raise NewLayerError("the graph contradicts itself: " + "; ".join(map(str, found.strains)))
        self.counts["stretches"] += 1
        reporter = self.reporters[layer.name]
        for change in changes_of(found, drive, self.held, layer, self.config.features.coverage, self.place.height_m):
            reporter.add(change, drive.looks[0].t_ns, self.place.odometer_m)
        reporter.report_all(drive.looks[-1].t_ns)

    def upload(self) -> None:
        """Wait until the cloud has all that it wants of the reports, for a bounded time."""
        if not self.link.sender.drain(self.config.report.drain_s, self.stop):
            _log.warning("%s: %d reports are not released", self.config.vehicle, self.link.outbox.counts().open)

    def result(self) -> dict[str, Any]:
        """What the drive came to, as plain values."""
        reports = self.link.outbox.counts()
        return {
            "vehicle": self.config.vehicle,
            "drive_id": self.header.drive_id,
            "finished": not self.stop.is_set() and not self.counts["damaged"],
            "distance_km": round(self.place.odometer_m / 1000, 5),
            "stretches": self.counts["stretches"],
            "stretches_refused": self.counts["stretches_refused"],
            "stretches_contradicting": self.counts["stretches_contradicting"],
            "layers": {name: dict(reporter.counts) for name, reporter in self.reporters.items()},
            "tiles": dict(self.downloader.counts),
            "reports_sent": reports.total,
            "reports_acknowledged": reports.acknowledged,
            "reports_quarantined": reports.quarantined,
            "reports_pending": reports.pending,
            "quarantined": dict(self.link.outbox.refused()),
            "last_error": self.link.sender.last_error or self.guard.last_problem,
        }


@contextmanager
def open_mapper(config: AgentConfig, stop: threading.Event) -> Iterator[Mapper]:
    """Read the recording's head, join the bus and put the parts together; closes all in reverse order.

    Raises:
        DriveError: the recording cannot be read.
        VehicleError: it has no GNSS fix to start from, or a file cannot be opened.
    """
    names = [layer.name for layer in config.features.layers]
    header, (fix, items) = read_header(config.drive), first_fix(read_drive(config.drive), config.drive)
    frame = LocalFrame.of_tile(TileId.from_geodetic(fix.lat_rad, fix.lon_rad))
    who = Identity(config.vehicle, header.drive_id, header.sensor_model, config.layer)
    with open_link(config) as link:
        asked = tuple(dict.fromkeys((*names, LANES)))
        downloader = FeatureDownloader(link.bus, config.work_dir / "features.sqlite", asked, config.download)
        reporters = {
            name: FeatureReporter(link.outbox, replace(who, layer=name), fix.t_ns, config.report.unchanged_m)
            for name in names
        }
        try:
            yield Mapper(
                config, header, items, stop, link, frame, Place(frame, fix), downloader, reporters, HeldMap(frame)
            )
        finally:
            link.bus.close()  # ends the questions under way
            downloader.close()
