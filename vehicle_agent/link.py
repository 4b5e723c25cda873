"""The vehicle's side of the bus: session, ledger, cache, outbox, and the threads that download and send."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from fleet_bus.bus import Bus, open_bus
from fleet_bus.config import BusConfig
from fleet_bus.ledger import Ledger
from gnd_map.tile import Tile
from schemas.keys import alive_key
from vehicle_agent.cache import TileCache
from vehicle_agent.config import AgentConfig
from vehicle_agent.download import TileFetcher
from vehicle_agent.outbox import Outbox
from vehicle_agent.sending import SenderThread


@dataclass(frozen=True, slots=True)
class Link:
    """Everything by which the vehicle speaks with the cloud."""

    bus: Bus
    ledger: Ledger
    cache: TileCache[Tile]
    outbox: Outbox
    fetcher: TileFetcher[Tile]
    sender: SenderThread


@contextmanager
def open_link(config: AgentConfig) -> Iterator[Link]:
    """Open files, join the bus, show that the agent is alive, start the threads that download and send.

    Raises:
        OutboxError, CacheError: a file cannot be opened.
        NoRouter: nothing answers at `config.connect`.
    """
    outbox = Outbox(config.work_dir / "outbox.sqlite")
    cache: TileCache[Tile] = TileCache(config.work_dir / "cache.sqlite", config.layer)
    ledger = Ledger(config.vehicle, config.ledger_path)
    bus_config = BusConfig(connect=config.connect, link=config.link, open_timeout_s=config.open_timeout_s)
    bus = open_bus(bus_config, ledger, config.vehicle)
    bus.declare_alive(alive_key("agent", config.vehicle))
    fetcher, sender = TileFetcher(bus, cache, config.download), SenderThread(bus, outbox, config.vehicle)
    try:
        yield Link(bus, ledger, cache, outbox, fetcher, sender)
    finally:
        bus.close()  # ends the requests under way, so that the threads can end
        sender.close()
        fetcher.close()
        cache.close()
        outbox.close()
