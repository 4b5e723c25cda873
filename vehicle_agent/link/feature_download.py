"""Feature layers around the vehicle: downloaded once, kept by version on disk, kept current by update notices.

Each layer has its own cache, questions and subscriptions, all by the same machinery as the voxel map: what is held is
asked for by version and hash, a delta is used where it fits, a lost link costs nothing but time.
"""

import logging
import threading
import time
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Final, Self

from gnd.fleet_bus.bus import Bus
from gnd.gnd_map.features import FeatureTile, is_feature_layer
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.wire import LAYER_PATTERN
from gnd.tile_client.archive import Archive
from gnd.tile_client.exchange import Fetched
from gnd.vehicle_agent.config import DownloadParameters
from gnd.vehicle_agent.errors import AgentConfigError, CacheError
from gnd.vehicle_agent.link.cache import TileCache
from gnd.vehicle_agent.link.download import TileFetcher
from gnd.vehicle_agent.link.updates import Updates

MOST_IN_FLIGHT: Final = 2
"""Questions of a layer at a time: its tiles are small, a district's are one question."""

_log = logging.getLogger(__name__)


@dataclass(slots=True)
class _Layer:
    """One layer's cache and threads, and what is held of it; the caller's thread owns `held`."""

    cache: TileCache[FeatureTile]
    fetcher: TileFetcher[FeatureTile]
    updates: Updates[FeatureTile]
    wanted: frozenset[TileId] = frozenset()
    held: dict[TileId, FeatureTile | None] = field(default_factory=dict)
    """None = the store has no such tile."""
    changed: set[TileId] = field(default_factory=set)


class FeatureDownloader:
    """The feature tiles of several layers around the vehicle. One thread calls it; its own threads ask.

    Args:
        bus: open.
        path: the cache's SQLite file; it may be that of the voxel map.
        layers: names of feature layers, each once.
        parameters: how patiently is asked; None = the defaults.
        archive: brings what the cache has nothing of; None = the bus does.

    Raises:
        AgentConfigError: a layer that is none, holds Gaussians, or is named twice.
        CacheError: the file cannot be opened.
    """

    def __init__(
        self,
        bus: Bus,
        path: Path,
        layers: Sequence[str],
        parameters: DownloadParameters | None = None,
        archive: Archive | None = None,
    ) -> None:
        _check_layers(layers)
        asked = parameters or DownloadParameters()
        few = replace(asked, in_flight=min(asked.in_flight, MOST_IN_FLIGHT))
        self._layers: dict[str, _Layer] = {}
        for layer in layers:
            self._layers[layer] = self._opened(bus, path, layer, few, archive)

    def _opened(
        self, bus: Bus, path: Path, layer: str, parameters: DownloadParameters, archive: Archive | None
    ) -> _Layer:
        cache: TileCache[FeatureTile] = TileCache(path, layer)
        fetcher = TileFetcher(bus, cache, parameters, archive=archive)
        return _Layer(cache, fetcher, Updates(bus, cache, fetcher, lambda tile: self._renew(layer, tile)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    @property
    def layers(self) -> tuple[str, ...]:
        """Their names, in the order given."""
        return tuple(self._layers)

    def follow(self, tiles: Sequence[TileId]) -> None:
        """These tiles are wanted of every layer, the first one most; others are let go (they stay in the cache)."""
        for layer in self._layers.values():
            layer.updates.follow(tiles)  # first, so that no version falls between answer and subscription
            for tile_id in layer.wanted.difference(tiles):
                layer.held.pop(tile_id, None)
                layer.changed.discard(tile_id)
                layer.fetcher.forget(tile_id)
            layer.wanted = frozenset(tiles)
            layer.fetcher.want(tiles)

    def step(self) -> dict[str, set[TileId]]:
        """Apply the notices and take the answers that have come; gives the tiles of each layer that are others now than
        at the last call.
        """
        self._take()
        changed: dict[str, set[TileId]] = {}
        for name, layer in self._layers.items():
            if layer.changed:
                changed[name], layer.changed = layer.changed, set()
        return changed

    def _take(self) -> None:
        for layer in self._layers.values():
            layer.updates.apply()
            for fetched in layer.fetcher.take():
                _arrive(layer, fetched)

    def wait_for(self, tiles: Collection[TileId], timeout_s: float, stop: threading.Event) -> dict[str, set[TileId]]:
        """Wait until every layer has an answer about all of `tiles`, time is up or `stop` is set, and take what has
        come; gives the tiles of each layer that have none. `step` tells what has changed.
        """
        deadline_s = time.monotonic() + timeout_s
        missing = {
            name: layer.fetcher.wait_for(tiles, max(deadline_s - time.monotonic(), 0.0), stop)
            for name, layer in self._layers.items()
        }
        self._take()
        return {name: found for name, found in missing.items() if found}

    def tile(self, layer: str, tile_id: TileId) -> FeatureTile | None:
        """What is held of a tile; None where nothing is, because it is absent, not wanted or still on its way."""
        return self._layer(layer).held.get(tile_id)

    def tiles(self, layer: str) -> Mapping[TileId, FeatureTile | None]:
        """All wanted tiles of a layer about which something is known; None = the store has none."""
        return MappingProxyType(self._layer(layer).held)

    @property
    def counts(self) -> Counter[str]:
        """Answers and notices of all layers: blob, delta, unchanged, absent, cached, refused, failed, and of notices
        notice-received, notice-delta, notice-refused.
        """
        total: Counter[str] = Counter()
        for layer in self._layers.values():
            total.update(layer.fetcher.counts)
            total.update({f"notice-{what}": n for what, n in layer.updates.counts.items()})
        return total

    def close(self) -> None:
        """End the threads and close the files; close the bus first where questions may be under way."""
        for layer in self._layers.values():
            layer.fetcher.close()
            layer.updates.close()
            layer.cache.close()

    def _renew(self, name: str, tile: FeatureTile) -> None:
        """A notice's delta has made a newer version."""
        layer = self._layers[name]
        if tile.tile_id in layer.wanted:
            _hold(layer, tile.tile_id, tile)

    def _layer(self, name: str) -> _Layer:
        if name not in self._layers:
            raise AgentConfigError(f"layer {name!r} is not downloaded; those that are: {', '.join(self._layers)}")
        return self._layers[name]


def _arrive(layer: _Layer, fetched: Fetched[FeatureTile]) -> None:
    """Take an answer; what a notice has brought meanwhile is newer, and in the cache."""
    if fetched.tile_id not in layer.wanted:
        return
    newest = fetched.tile
    try:
        if newest is not None and layer.cache.head(newest.tile_id)[1] != newest.sha:
            newest = layer.cache.get(newest.tile_id) or newest
    except CacheError as error:
        _log.warning("taken as it came: %s", error)
    _hold(layer, fetched.tile_id, newest)


def _hold(layer: _Layer, tile_id: TileId, tile: FeatureTile | None) -> None:
    """Hold what came; it counts as changed unless the same content was held."""
    before = layer.held.get(tile_id)
    if tile_id not in layer.held or (before and before.sha) != (tile and tile.sha):
        layer.changed.add(tile_id)
    layer.held[tile_id] = tile


def _check_layers(layers: Sequence[str]) -> None:
    for layer in layers:
        if not LAYER_PATTERN.fullmatch(layer) or not is_feature_layer(layer):
            raise AgentConfigError(f"{layer[:80]!r} is no feature layer: lower-case, and not beginning with ndt")
    if len(set(layers)) < len(layers):
        raise AgentConfigError(f"feature layers {', '.join(layers)}: one comes twice")
