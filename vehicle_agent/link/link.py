"""The vehicle's side of the bus: session, ledger, cache, outbox, and the threads that download and send."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.identity.following import follow_revoked
from gnd.fleet_bus.ledger import Ledger
from gnd.gnd_map.tile import Tile
from gnd.schemas.keys import alive_key
from gnd.schemas.ticket import ticket_of
from gnd.tile_client.archive import Archive
from gnd.tile_client.archive_check import CATALOGS_SEEN_FILE, SEEN_FILE, SeenStates
from gnd.tile_client.http_reader import HURRIED
from gnd.vehicle_agent.config import AgentConfig
from gnd.vehicle_agent.link.cache import TileCache
from gnd.vehicle_agent.link.download import TileFetcher
from gnd.vehicle_agent.link.map_age import MapAge
from gnd.vehicle_agent.link.outbox import Outbox
from gnd.vehicle_agent.link.sending import SenderThread

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Link:
    """Everything by which the vehicle speaks with the cloud."""

    bus: Bus
    ledger: Ledger
    cache: TileCache[Tile]
    outbox: Outbox
    fetcher: TileFetcher[Tile]
    sender: SenderThread
    map_age: MapAge | None = None
    """None: without an identity nobody looks at signatures."""
    archive: Archive | None = None
    """Where tiles come from before the bus is asked; None: it is asked for all."""

    def traffic(self) -> dict[str, int]:
        """What this session came to, bytes; the whole of it once the link is closed."""
        return {
            "up_bytes": self.ledger.total_bytes("up"),
            "down_bytes": self.ledger.total_bytes("down"),
            "up_wire_bytes": self.ledger.wire.up,
            "down_wire_bytes": self.ledger.wire.down,
        }


@contextmanager
def open_link(config: AgentConfig) -> Iterator[Link]:
    """Open files, join the bus, show that the agent is alive, start the threads that download and send.

    Without a router for `config.open_timeout_s` the vehicle drives on what its cache holds; reports wait in the outbox,
    and the router is looked for all the time.

    Raises:
        OutboxError, CacheError: a file cannot be opened.
        ArchiveError: `config.tiles_from` cannot be an archive.
    """
    outbox = Outbox(config.work_dir / "outbox.sqlite")
    if config.pseudonyms is not None and (n := outbox.forget_others(config.vehicle)):
        _log.warning("%s: %d reports of an earlier name are not sent: they would link the two", config.vehicle, n)
    cache: TileCache[Tile] = TileCache(config.work_dir / "cache.sqlite", config.layer)
    ledger = Ledger(config.vehicle, config.ledger_path)
    archive = Archive(config.tiles_from, ledger, HURRIED) if config.tiles_from else None
    bus = open_bus(BusConfig(connect=config.connect, link=config.link, patient=True), ledger, config.vehicle)
    if not bus.wait_connected(config.open_timeout_s):
        where = ", ".join(config.connect)
        _log.warning("%s: no router at %s for %g s: off on the cache", config.vehicle, where, config.open_timeout_s)
    bus.declare_alive(alive_key("agent", config.vehicle))
    follow_revoked(bus)  # or versions of a publisher that was shut out would still count here
    seen = config.work_dir / SEEN_FILE
    fetcher = TileFetcher(bus, cache, config.download, ticket_of(config.vehicle), archive, seen)
    sender = SenderThread(bus, outbox, config.vehicle)
    map_age = None
    if fetcher.check is not None:
        lists_seen = SeenStates(config.work_dir / CATALOGS_SEEN_FILE)
        map_age = MapAge(bus, config.layer, fetcher.check.publishers, lists_seen)
    try:
        yield Link(bus, ledger, cache, outbox, fetcher, sender, map_age, archive)
    finally:
        if archive is not None:
            archive.close()
        bus.close()  # ends the requests under way, so that the threads can end
        if map_age is not None:
            map_age.close()
        sender.close()
        fetcher.close()
        cache.close()
        outbox.close()
