"""An ordinary subscriber of tile updates: what `gnd watch` prints and what a fleet run's watcher records.

Notices can be lost while a router or a publisher is down (they are notices, the store is the truth), so a watch also
compares the catalog of its region from time to time and reports what it missed.
"""

import json
import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.errors import BusError
from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.region import Region
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import SchemaError
from gnd.tile_client.archive_check import seen_beside
from gnd.tile_client.fetching import TileServerClient
from gnd.tile_client.following import NewVersion, RegionFollower
from gnd.tile_client.notices import QueuedNotice

LAYER: Final = "ndt"
CATALOG_PERIOD_S: Final = 3.0
CATALOG_TIMEOUT_S: Final = 5.0
_POLL_S: Final = 0.2

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
        size: bytes of the notice; 0 where it was missed.
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
        self._bus, self._region, self._emit = bus, region, emit
        seen = seen_beside(bus.config.identity)
        self._asking = {layer: TileServerClient(bus, layer, CATALOG_TIMEOUT_S, seen=seen) for layer in layers}
        self._seen: set[tuple[str, TileId, int]] = set()

    def run(self, stop: threading.Event) -> None:
        """Follow the region until `stop` is set."""
        follower = RegionFollower(self._bus, self._asking, self._region, CATALOG_PERIOD_S, history=True)
        try:
            follower.begin()
        except (BusError, SchemaError) as error:
            _log.warning("no catalog: %s", error)
        while not stop.is_set():
            try:
                versions = follower.next(_POLL_S)
            except (BusError, SchemaError) as error:
                _log.warning("notice or catalog left out: %s", error)
                stop.wait(_POLL_S)
                continue
            for version in versions:
                if self._is_proven(version, follower):
                    self._note(version, follower.known)
        follower.close()

    def _is_proven(self, found: NewVersion, follower: RegionFollower) -> bool:
        """Whether a publisher answers for it. What the catalog alone names is fetched for that."""
        asking = self._asking[found.layer]
        if found.notice is not None or asking.check is None:
            return True
        try:
            return any(tile.version == found.version for tile in asking.fetch([found.tile]))
        except (BusError, SchemaError) as error:
            _log.warning("a version of the catalog is left out: %s", error)
            follower.look_again(found)
            return False

    def _note(self, found: NewVersion, known: dict[tuple[str, TileId], int]) -> None:
        """Emit a version that was not seen before."""
        place = found.layer, found.tile
        if (*place, found.version) in self._seen:
            return
        self._seen.add((*place, found.version))
        before = known.get(place, 0)
        known[place] = max(found.version, before)
        self._emit(_missed(found, before) if found.notice is None else _event_of(found.notice))


def _event_of(notice: QueuedNotice) -> WatchEvent:
    update = notice.update
    put, removed = update.voxels or (None, None)
    return WatchEvent(
        received_ns=notice.received_ns,
        layer=update.layer,
        tile=update.tile.morton,
        path=update.tile.path,
        version=update.version,
        previous_version=update.previous_version,
        reason=update.reason,
        put=put,
        removed=removed,
        size=notice.size_bytes,
    )


def _missed(found: NewVersion, known: int) -> WatchEvent:
    tile = found.tile
    return WatchEvent(
        time.time_ns(), found.layer, tile.morton, tile.path, found.version, known, "catalog", None, None, size=0
    )


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
