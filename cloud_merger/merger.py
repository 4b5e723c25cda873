"""The cloud's half of the loop: reports come in, tiles are merged, versions go out."""

import logging
import threading

from cloud_merger.announce import Announcer
from cloud_merger.config import ShardConfig
from cloud_merger.expander import Expander
from cloud_merger.expander_threads import working
from cloud_merger.ingest import Ingest
from cloud_merger.ownership import Members, following
from cloud_merger.reception import Reception
from cloud_merger.states import States
from cloud_merger.warm import warm_up
from cloud_merger.work import Worker
from cloud_merger.worker_process import worker_process
from fleet_bus.bus import open_bus
from fleet_bus.config import BusConfig
from tile_store.sqlite_store import SqliteStore

__all__ = ["ShardConfig", "run_shard", "run_worker"]
_LOG = logging.getLogger(__name__)


def run_shard(config: ShardConfig, stop: threading.Event) -> None:
    """Run one merger shard until `stop` is set: this process receives and acknowledges, its worker does the rest.

    Any number of shards may share a store. What one leaves undone, when it ends or is killed, another does.

    Raises:
        StoreError: the store cannot be opened or has failed.
    """
    bus_config = BusConfig(connect=config.connect, lease_ms=config.bus_lease_ms, patient=True)
    with (
        SqliteStore(config.store_path, config.store, create=False) as store,
        open_bus(bus_config, name=config.shard_id) as bus,
    ):
        store.release(config.shard_id)  # leases of an earlier life
        with worker_process(config) as worker:
            ingest = Ingest(store, config.shard_id, on_stored=worker.wake)  # look at the outside, keep the bytes
            members = Members(config.shard_id)
            States(store, bus).open()
            Reception(bus, members, ingest.answer, on_death=store.release).open()
            _LOG.info("merger %s: store %s, mode %s", config.shard_id, config.store_path, config.merge.mode)
            while not stop.wait(config.poll_s):
                if worker.has_ended():
                    store.release(config.shard_id)  # what it had in hand need not wait for the ends of its leases
                    worker.restart()
        store.release(config.shard_id)


def run_worker(config: ShardConfig, stop: threading.Event, arrived: threading.Event) -> None:
    """Expand, merge and announce until `stop` is set; `arrived` is set when something has come.

    Raises:
        StoreError, NoRouter: as `run_shard`.
    """
    warm_up()  # or the first tile and the first report would wait for the kernels, and their leases with them
    bus_config = BusConfig(connect=config.connect, lease_ms=config.bus_lease_ms)
    with (
        SqliteStore(config.store_path, config.store, create=False) as store,
        open_bus(bus_config, name=f"{config.shard_id}-worker") as bus,
    ):
        members, wake = following(bus, config.shard_id), threading.Event()

        # Expand: what was acknowledged becomes reports of tiles, and vehicles hear what is wanted; in threads.
        expander = Expander(store, config, States(store, bus).tell, on_journaled=wake.set)
        worker, announcer = Worker(store, config), Announcer(store, bus, members)
        with working(expander.work, arrived, config.expanders, config.poll_s):
            while not stop.is_set():
                claims = store.claim(config.shard_id, config.tiles_at_once, config.lease_s, prefer=expander.districts)
                merged = worker.merge(claims)  # load, decode, cluster, decide
                store.publish(merged)  # compare-and-swap; a stale one is refused and its tile claimed again
                n_announced = announcer.announce(config.announce_at_once)  # after the commit
                if not claims and not n_announced:
                    wake.wait(worker.idle_s(store.next_ready_ns()))
                    wake.clear()
