"""A client of the bus: the tiles of a region as they are, and every new version from now on."""

import logging
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import DEFAULT_ENDPOINT, BusConfig
from gnd.fleet_bus.errors import BusClosed, BusError
from gnd.fleet_bus.identity.following import follow_revoked
from gnd.gnd_map.content import AnyTile
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.region import Region, as_region
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas.changes import ChangeAck
from gnd.schemas.errors import SchemaError, WrongHash
from gnd.schemas.tiles import CatalogEntry
from gnd.schemas.updates import updated
from gnd.tile_client.archive_check import SeenStates, seen_beside
from gnd.tile_client.fetching import TileServerClient
from gnd.tile_client.following import NewVersion, RegionFollower

if TYPE_CHECKING:
    from gnd.vehicle_agent.report.sink import OutgoingReport

GAUSSIANS: Final = "ndt"
"""The layer of Gaussians; every layer whose name does not begin so holds features."""
COMPARED_EVERY_S: Final = 10.0
"""Notices may be lost: so often the catalog is compared with what is known."""
MOST_HELD: Final = 4096
"""So many tiles are held to apply deltas to; of others the whole tile is asked for."""
_POLL_S: Final = 0.2
_log = logging.getLogger(__name__)

AnyRegion = Region | TileId | str | None
"""A region as users give it: a wildcard `13033/03021/**`, a tile (its path or number), a circle `lat,lon,radius` in
degrees and metres, a `Region`, a `TileId`, or None: everywhere."""


class ReportRefused(GndError):
    """The cloud has refused a report by name: trying again does not help."""


@dataclass(frozen=True, slots=True)
class MapUpdate:
    """A new version of a tile, with its content.

    Attributes:
        layer: name of the layer.
        tile: the content as it is now: a `Tile` of Gaussians, or a `FeatureTile`.
        before: the content that it replaces, where the client held it; else None.
        reason: "merged", "base" or "rollback"; "missed" where the notice did not come and the catalog told;
            "existing" for what was there when the subscription began.
    """

    layer: str
    tile: AnyTile
    before: AnyTile | None
    reason: str

    @property
    def version(self) -> int:
        """The version of `tile`."""
        return self.tile.version


def connect(
    router: str = DEFAULT_ENDPOINT,
    *,
    timeout_s: float = 10.0,
    oldest_catalog_s: float | None = None,
    seen: Path | None = None,
) -> "Client":
    """Join the bus as a client of a router; use it in a `with` block.

    Args:
        router: endpoint of the router.
        timeout_s: how long a router is looked for, and how long each question is asked again, s.
        oldest_catalog_s: with an identity, a catalog that was signed longer ago is refused, s (shards sign each again
            once an hour), and so is a layer of which no signed list of districts comes; None: any age will do, and one
            of more than a day is told in the log and by `Client.stale`.
        seen: with an identity, the file in which it is kept which catalogs and lists of districts were seen, so that
            older ones are refused after a new start, too; None: `catalogs_seen.json` in the folder of the identity.

    Raises:
        NoRouter: nothing answers at `router` within `timeout_s`; the message says both.
        BusConfigError: `router` is no endpoint.
    """
    bus = open_bus(BusConfig(connect=(router,), open_timeout_s=timeout_s), name="client")
    follow_revoked(bus)
    remembered = SeenStates(seen) if seen is not None and bus.config.identity else seen_beside(bus.config.identity)
    return Client(bus, timeout_s, oldest_catalog_s, remembered)


class Client:
    """Reads the map that a fleet keeps. Methods may be called from any thread. `connect` makes one."""

    def __init__(
        self, bus: Bus, timeout_s: float, oldest_catalog_s: float | None = None, seen: SeenStates | None = None
    ) -> None:
        self._seen = SeenStates() if seen is None else seen
        self._bus, self._timeout_s, self._oldest_catalog_s = bus, timeout_s, oldest_catalog_s
        self._streams: list[UpdateStream] = []
        self._asked: dict[str, TileServerClient] = {}  # each remembers the newest versions that it has seen

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    @property
    def bus(self) -> Bus:
        """The session behind it, for what this class does not do."""
        return self._bus

    def close(self) -> None:
        """End all subscriptions and the session. May be called again."""
        self._bus.close()  # first: it ends what the streams wait for
        for stream in self._streams:
            stream.close()

    def catalog(self, region: AnyRegion = None, *, layer: str = GAUSSIANS) -> list[CatalogEntry]:
        """The newest version of each tile of a region: `tile`, `version` and `sha`, by tile; no content is sent.

        Raises:
            RegionError: `region` is none.
            RequestFailed: no tile server answers within `timeout_s`.
            NotSigned: with an identity: no publisher answers for the catalog of any district there, or it is too old.
        """
        return self._asking(layer).catalog(as_region(region))

    def refused(self, *, layer: str = GAUSSIANS) -> dict[District, str]:
        """Districts that the last answer to `catalog`, `tiles` or a subscription went without, and why: nobody answers
        for them, they are older than was seen, or the signed list names them and they did not come.
        """
        return dict(self._asking(layer).refused)

    def stale(self, *, layer: str = GAUSSIANS) -> dict[District, float]:
        """Districts whose catalog was signed more than a day before the last answer, with its age, s: nobody has
        confirmed for so long that there is no newer one. They are used.
        """
        return dict(self._asking(layer).stale)

    def tiles(self, region: AnyRegion = None, *, layer: str = GAUSSIANS) -> Iterator[AnyTile]:
        """The newest version of each tile of a region, by tile, as it arrives: `Tile` or, of features, `FeatureTile`.

        Raises:
            RegionError, RequestFailed: as `catalog`.
            SchemaError: an answer that is none.
        """
        asking = self._asking(layer)
        known = [entry.tile for entry in asking.catalog(as_region(region))]
        return asking.fetch(known)

    def fetch(self, tiles: Sequence[TileId], *, layer: str = GAUSSIANS) -> Iterator[AnyTile]:
        """The newest versions of these tiles, by tile; those that are not there are left out.

        Raises:
            RequestFailed, SchemaError: as `tiles`.
        """
        return self._asking(layer).fetch(tiles)

    def upload(self, report: "OutgoingReport") -> str:
        """Hand a report of a `Vehicle` to the cloud. It may be handed over again: it counts once.

        Returns:
            "stored", or "duplicate": it was there already. Both are said only when it is on the cloud's disk; until
            then keep it, and try again.

        Raises:
            RequestFailed: no merger answers within `timeout_s`.
            ReportRefused: it can never be taken.
        """
        payload = self._bus.request(report.key, report.body, kind="change", timeout_s=self._timeout_s)
        ack = ChangeAck.decode(payload)
        if ack.status not in ("stored", "duplicate"):
            raise ReportRefused(f"report {report.report_id}: {ack.status}: {ack.reason}")
        return ack.status

    def subscribe(
        self,
        region: AnyRegion = None,
        on_update: Callable[[MapUpdate], object] | None = None,
        *,
        layers: Sequence[str] = (GAUSSIANS,),
        existing: bool = False,
    ) -> "UpdateStream":
        """Follow a region: every version that is published from now on, with its content.

        Args:
            region: which tiles.
            on_update: called with each update in a thread of its own; what it raises is logged. None: iterate over
                what this returns.
            layers: names of layers.
            existing: also give, first, every tile that is there now.

        Raises:
            RegionError, RequestFailed: as `catalog`.
        """
        asking = {layer: self._asking(layer) for layer in layers}
        stream = UpdateStream(self._bus, asking, as_region(region), existing=existing)
        self._streams = [one for one in self._streams if not one.is_closed]
        self._streams.append(stream)
        if on_update is not None:
            stream.call(on_update)
        return stream

    def _asking(self, layer: str) -> TileServerClient:
        known = self._asked.get(layer)
        if known is None:
            asking = TileServerClient(
                self._bus, layer, self._timeout_s, oldest_catalog_s=self._oldest_catalog_s, seen=self._seen
            )
            known = self._asked.setdefault(layer, asking)
        return known


class UpdateStream:
    """The updates of a region, as an iterator that ends when it, or its client, is closed. `Client.subscribe`.

    A notice is worked on when the next update is asked for: its delta is applied to the tile that is held, or the new
    tile is fetched where none is held or the delta does not fit. Of several versions that were published meanwhile the
    newest alone may be given. A version whose notice was lost is found in the catalog, which is compared every ten
    seconds.
    """

    def __init__(self, bus: Bus, asking: dict[str, TileServerClient], region: Region, *, existing: bool) -> None:
        self._bus, self._asking = bus, asking
        self._ready: deque[MapUpdate] = deque()
        self._held: OrderedDict[tuple[str, TileId], AnyTile] = OrderedDict()
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None
        # first listen, then ask for the catalog: no version falls between
        self._follower = RegionFollower(bus, asking, region, COMPARED_EVERY_S)
        try:
            catalogs = self._follower.begin()
            for layer, entries in catalogs.items() if existing else ():
                for tile in asking[layer].fetch([entry.tile for entry in entries]):
                    self._give(layer, tile, "existing")
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> MapUpdate:
        update = self.next()
        if update is None:
            raise StopIteration
        return update

    @property
    def is_closed(self) -> bool:
        """Whether it was closed, or its client."""
        return self._closed.is_set() or self._bus.is_closed

    def next(self, timeout_s: float | None = None) -> MapUpdate | None:
        """The next update; None when there was none for `timeout_s`, or when it was closed."""
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        while not self.is_closed:
            if self._ready:
                return self._ready.popleft()
            left_s = _POLL_S if deadline_s is None else min(_POLL_S, deadline_s - time.monotonic())
            try:
                for layer, versions in groupby(self._follower.next(max(left_s, 0.0)), key=lambda one: one.layer):
                    self._take(layer, list(versions))
            except BusClosed:
                break
            except (BusError, SchemaError) as error:  # asked for again when the catalog is compared
                _log.warning("an update could not be fetched: %s", error)
            if not self._ready and deadline_s is not None and time.monotonic() >= deadline_s:
                return None
        return None

    def call(self, on_update: Callable[[MapUpdate], object]) -> None:
        """Give each update to a function, in a thread of its own, until closed."""

        def run() -> None:
            for update in self:
                try:
                    on_update(update)
                except Exception:
                    _log.exception("tile %s version %d: the callback failed", update.tile.tile_id, update.version)

        self._thread = threading.Thread(target=run, name="map updates", daemon=True)
        self._thread.start()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until it is closed (a main thread beside a callback); False when it was not within `timeout_s`."""
        return self._closed.wait(timeout_s)

    def close(self) -> None:
        """End it. May be called again, and from the callback."""
        self._closed.set()
        self._follower.close()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def _take(self, layer: str, versions: Sequence[NewVersion]) -> None:
        """Give the newer ones among some versions of one layer: one by a notice, or all whose notices were lost."""
        known = self._follower.known
        newer = [one for one in versions if one.version > known.get((layer, one.tile), 0)]
        to_fetch = [one.tile for one in newer if not self._has_applied(one)]
        if not to_fetch:
            return
        notice = versions[0].notice
        held = {tile: self._held[layer, tile] for tile in to_fetch if (layer, tile) in self._held}
        for tile in self._asking[layer].fetch(to_fetch, held):
            if tile.version > known.get((layer, tile.tile_id), 0):
                self._give(layer, tile, "missed" if notice is None else notice.update.reason)

    def _has_applied(self, version: NewVersion) -> bool:
        """Give a version by the delta of its notice, where that fits the tile that is held."""
        held = self._held.get((version.layer, version.tile))
        if version.notice is None or held is None or not version.notice.update.follows(held.sha):
            return False
        try:
            self._give(version.layer, updated(version.notice.update, held), version.notice.update.reason)
        except WrongHash as error:
            _log.info("%s", error)
            return False
        return True

    def _give(self, layer: str, tile: AnyTile, reason: str) -> None:
        key = layer, tile.tile_id
        self._ready.append(MapUpdate(layer, tile, self._held.get(key), reason))
        self._follower.known[key] = tile.version
        self._held[key] = tile
        self._held.move_to_end(key)
        if len(self._held) > MOST_HELD:
            self._held.popitem(last=False)
