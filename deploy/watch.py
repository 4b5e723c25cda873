"""An ordinary subscriber of tile updates: what `gnd watch` prints and what a fleet run's watcher records.

Notices can be lost while a router or a publisher is down (they are notices, the store is the truth), so a watch also
compares the catalog of its region from time to time and reports what it missed.
"""

import json
import logging
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.errors import BusError
from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.region import Region
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import SchemaError
from gnd.schemas.keys import catalog_keys, update_keys
from gnd.schemas.tiles import Catalog
from gnd.schemas.updates import TileUpdate

LAYER: Final = "ndt"
CATALOG_PERIOD_S: Final = 3.0
CATALOG_TIMEOUT_S: Final = 5.0

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class WatchEvent:
    """One update as a watcher sees it.

    Attributes:
        received_ns: time of arrival, ns UTC.
        layer: map layer.
        tile: Morton id of the tile.
        path: the same as text path.
        version: version that is now current.
        previous_version: version that it follows.
        reason: why: merged, base, rollback; or catalog when the notice itself was missed.
        put: voxels (of a feature layer: features) written by this version, None where the notice carried no delta.
        removed: voxels or features removed by this version, likewise.
        size: bytes of the notice.
    """

    received_ns: int
    layer: str
    tile: int
    path: str
    version: int
    previous_version: int
    reason: str
    put: int | None
    removed: int | None
    size: int

    def line(self) -> str:
        """Return the event as a line for people."""
        clock = time.strftime("%H:%M:%S", time.gmtime(self.received_ns // 1_000_000_000))
        noun = "features" if is_feature_layer(self.layer) else "voxels"
        change = "" if self.put is None else f"  +{self.put} -{self.removed} {noun}"
        place = self.path if self.layer == LAYER else f"{self.layer} {self.path}"
        return f"{clock}  {place}  v{self.previous_version} -> v{self.version}  {self.reason}{change}  {self.size} B"

    def json(self) -> str:
        """Return the event as one JSON object on one line."""
        return json.dumps(asdict(self), separators=(",", ":"))


class TileWatch:
    """Follows the tile versions of a region in one layer or several.

    Args:
        bus: an open bus.
        region: which tiles.
        emit: called with each event, from one thread at a time.
        layers: names of map layers, of Gaussians or of features.
    """

    def __init__(
        self, bus: Bus, region: Region, emit: Callable[[WatchEvent], None], layers: Sequence[str] = (LAYER,)
    ) -> None:
        self._bus, self._region, self._emit, self._layers = bus, region, emit, tuple(dict.fromkeys(layers))
        self._seen: set[tuple[str, int, int]] = set()
        self._latest: dict[tuple[str, int], int] = {}
        self._lock = threading.Lock()

    def run(self, stop: threading.Event) -> None:
        """Follow the region until `stop` is set."""
        with ExitStack() as subscriptions:
            for layer in self._layers:
                keys = update_keys(layer, self._region.prefix)
                subscriptions.enter_context(self._bus.subscribe(keys, self._on_update, history=True))
            self._compare_catalogs(report=False)
            while not stop.wait(CATALOG_PERIOD_S):
                self._compare_catalogs(report=True)

    def _on_update(self, key: str, payload: bytes) -> None:
        try:
            update = TileUpdate.decode(payload)
        except SchemaError as error:
            _log.warning("unreadable update on %s: %s", key, error)
            return
        if update.tile in self._region:
            self._note(_event_of(update, len(payload)))

    def _note(self, event: WatchEvent) -> None:
        with self._lock:
            place = event.layer, event.tile
            if (*place, event.version) in self._seen:
                return
            self._seen.add((*place, event.version))
            self._latest[place] = max(event.version, self._latest.get(place, 0))
            self._emit(event)

    def _compare_catalogs(self, *, report: bool) -> None:
        for layer in self._layers:
            self._compare_catalog(layer, report=report)

    def _compare_catalog(self, layer: str, *, report: bool) -> None:
        """Find versions whose notice never came; the first call only learns where the region stands."""
        for tile, version, size in self._catalog(layer):
            known = self._latest.setdefault((layer, tile.morton), 0 if report else version)
            if version > known:
                self._note(_missed(layer, tile, known, version, size))

    def _catalog(self, layer: str) -> list[tuple[TileId, int, int]]:
        try:
            key = catalog_keys(layer, self._region.prefix)
            replies = self._bus.request_many(key, b"", kind="catalog", timeout_s=CATALOG_TIMEOUT_S)
        except BusError as error:
            _log.warning("no catalog: %s", error)
            return []
        return [
            (entry.tile, entry.version, len(payload))
            for _, payload in replies
            for entry in Catalog.decode(payload).entries
            if entry.tile in self._region
        ]


def _event_of(update: TileUpdate, size: int) -> WatchEvent:
    put, removed = update.voxels or (None, None)
    return WatchEvent(
        received_ns=time.time_ns(),
        layer=update.layer,
        tile=update.tile.morton,
        path=update.tile.path,
        version=update.version,
        previous_version=update.previous_version,
        reason=update.reason,
        put=put,
        removed=removed,
        size=size,
    )


def _missed(layer: str, tile: TileId, known: int, version: int, size: int) -> WatchEvent:
    return WatchEvent(time.time_ns(), layer, tile.morton, tile.path, version, known, "catalog", None, None, size)


def record_updates(
    bus: Bus, region: Region, path: Path, stop: threading.Event, layers: Sequence[str] = (LAYER,)
) -> None:
    """Write each update of a region as a JSON line until `stop` is set.

    Args:
        bus: an open bus.
        region: which tiles.
        path: file to append to; every line is complete or absent.
        stop: ends the recording.
        layers: names of map layers.
    """
    with path.open("a", encoding="utf-8", buffering=1) as lines:
        TileWatch(bus, region, lambda event: print(event.json(), file=lines), layers).run(stop)
