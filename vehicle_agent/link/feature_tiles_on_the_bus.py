"""What the map says of the feature layers around an agent, asked for over the bus."""

import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from gnd.gnd_map.features import FeatureTile
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.config import AgentConfig
from gnd.vehicle_agent.features.layer_parameters import LANES
from gnd.vehicle_agent.link.feature_download import FeatureDownloader
from gnd.vehicle_agent.link.link import Link
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.surroundings import tiles_along

AHEAD_M: Final = 250.0
"""Feature tiles weigh little and are mostly empty: they are asked for far ahead, so that few questions are needed."""
BESIDE_M: Final = 100.0
STEP_M: Final = 100.0


class FeatureTilesAhead:
    """Which feature tiles a vehicle needs, told anew after some way, and when its heading becomes known."""

    def __init__(self) -> None:
        self._asked_at_m: float | None = None
        self._had_heading = False

    def of(self, place: Place) -> tuple[TileId, ...]:
        """The tiles around and ahead; empty where the last ones still do."""
        knows_heading = place.course.heading_rad is not None
        moved_m = None if self._asked_at_m is None else place.odometer_m - self._asked_at_m
        if moved_m is not None and moved_m < STEP_M and knows_heading <= self._had_heading:
            return ()
        self._asked_at_m, self._had_heading = place.odometer_m, knows_heading
        return tiles_along(place.frame, place.ahead_map_m(AHEAD_M), BESIDE_M)


class FeatureTilesOnTheBus:
    """Downloads the tiles of feature layers along one drive; the agent's main thread owns it."""

    def __init__(self, downloader: FeatureDownloader, config: AgentConfig, stop: threading.Event) -> None:
        self._downloader, self._config, self._stop = downloader, config, stop
        self._ahead = FeatureTilesAhead()
        self._given_up: set[TileId] = set()

    @property
    def counts(self) -> Counter[str]:
        """What came of the questions."""
        return self._downloader.counts

    def follow(self, place: Place) -> Iterator[tuple[str, FeatureTile]]:
        """Ask for the tiles around and ahead now and then; gives those of which a new version has come."""
        if wanted := self._ahead.of(place):
            self._ask(wanted)
        for layer, tiles in self._downloader.step().items():
            for tile_id in sorted(tiles):
                tile = self._downloader.tile(layer, tile_id)
                if tile is not None:
                    yield layer, tile

    def _ask(self, tiles: tuple[TileId, ...]) -> None:
        self._downloader.follow(tiles)
        if self._config.waits_for_tiles:
            wait_s = self._config.download.wait_s
            missing = self._downloader.wait_for(set(tiles) - self._given_up, wait_s, self._stop)
            self._given_up.update(*missing.values())


@contextmanager
def open_feature_tiles(config: AgentConfig, link: Link, stop: threading.Event) -> Iterator[FeatureTilesOnTheBus | None]:
    """The tiles of the configured feature layers, over an open link, and lanes where a graph is tied to them; None
    where there are none.

    Raises:
        CacheError: the cache cannot be opened.
    """
    names = [layer.name for layer in config.features.layers]
    if not names:
        yield None
        return
    if config.localise_by == "graph":
        names = list(dict.fromkeys((*names, LANES)))
    path = config.work_dir / "features.sqlite"
    downloader = FeatureDownloader(link.bus, path, names, config.download, link.archive)
    try:
        yield FeatureTilesOnTheBus(downloader, config, stop)
    finally:
        link.bus.close()  # ends the questions under way
        downloader.close()
