"""The feature layers' part of an agent: download what the map says, judge it along the drive, report."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Final

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import Detections
from gnd.vehicle_agent.config import AgentConfig
from gnd.vehicle_agent.features.download import FeatureDownloader
from gnd.vehicle_agent.features.feature_report import FeatureReporter
from gnd.vehicle_agent.features.layers import FeatureLayers
from gnd.vehicle_agent.link import Link
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.report import Identity
from gnd.vehicle_agent.segment.segmenter import SegmentedScan
from gnd.vehicle_agent.surroundings import tiles_along

AHEAD_M: Final = 250.0
"""Feature tiles weigh little and are mostly empty: they are asked for far ahead, so that few questions are needed."""
BESIDE_M: Final = 100.0
STEP_M: Final = 100.0


@dataclass(slots=True)
class FeatureWork:
    """Downloads and judges the feature layers of one drive; the agent's main thread owns it."""

    config: AgentConfig
    frame: LocalFrame
    downloader: FeatureDownloader
    layers: FeatureLayers
    _asked_at_m: float | None = None
    _had_heading: bool = False
    _given_up: set[TileId] = field(default_factory=set)

    def download(self, place: Place, stop: threading.Event) -> None:
        """Ask for the tiles around and ahead now and then, and compare with what has come."""
        knows_heading = place.course.heading_rad is not None
        moved_m = None if self._asked_at_m is None else place.odometer_m - self._asked_at_m
        if moved_m is None or moved_m >= STEP_M or knows_heading > self._had_heading:
            self._asked_at_m, self._had_heading = place.odometer_m, knows_heading
            self._ask(tiles_along(self.frame, place.ahead_map_m(AHEAD_M), BESIDE_M), stop)
        for layer, tiles in self.downloader.step().items():
            for tile_id in sorted(tiles):
                tile = self.downloader.tile(layer, tile_id)
                if tile is not None:
                    self.layers.hold(layer, tile)

    def _ask(self, tiles: tuple[TileId, ...], stop: threading.Event) -> None:
        self.downloader.follow(tiles)
        if self.config.waits_for_tiles:
            missing = self.downloader.wait_for(set(tiles) - self._given_up, self.config.download.wait_s, stop)
            self._given_up.update(*missing.values())

    def wait(self, look: Detections) -> None:
        """A look of the camera waits for the poses about it."""
        self.layers.wait(look)

    def take(self, segmented: SegmentedScan, odometer_m: float) -> None:
        """A scan whose pose is final."""
        self.layers.take(segmented, odometer_m)

    def take_back(self) -> None:
        """The pose was wrong, and it is not known since when."""
        self.layers.take_back()

    def doubt(self, scans: int) -> None:
        """So many of the last scans did not stand the shift test."""
        self.layers.doubt(scans)

    def finish(self) -> None:
        """The drive has ended: report everything."""
        self.layers.finish()

    def account(self) -> dict[str, Any]:
        """What was downloaded, judged and reported."""
        return {
            "layers": self.layers.account(),
            "looks": dict(self.layers.counts),
            "tiles": dict(self.downloader.counts),
        }


@contextmanager
def open_features(
    config: AgentConfig, link: Link, frame: LocalFrame, identity: Identity, start_ns: int
) -> Iterator[FeatureWork]:
    """The feature layers' part of an agent whose link is open.

    Args:
        config: which layers.
        link: of the vehicle.
        frame: the map frame.
        identity: who reports; the layer is put in here.
        start_ns: of the drive, UTC.

    Raises:
        CacheError: the cache cannot be opened.
    """
    names = [layer.name for layer in config.features.layers]
    reporters = [
        FeatureReporter(link.outbox, replace(identity, layer=name), start_ns, config.report.unchanged_m)
        for name in names
    ]
    downloader = FeatureDownloader(link.bus, config.work_dir / "features.sqlite", names, config.download)
    layers = FeatureLayers(config.features, config.report, frame, reporters)
    try:
        yield FeatureWork(config, frame, downloader, layers)
    finally:
        link.bus.close()  # ends the questions under way
        downloader.close()
