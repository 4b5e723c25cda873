"""What a store shows of itself to Prometheus, and when it is ill."""

from collections.abc import Iterator
from typing import Final

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.health import Check
from gnd.tile_store.connection import change, fetch
from gnd.tile_store.sqlite_store import SqlStore

OVERDUE_S: Final = 60.0
"""A tile that has been ready for so long and is not merged makes the store ill."""


class StoreCollector(Collector):
    """The store's counts, read when Prometheus asks; all cheap, whatever the store's size."""

    def __init__(self, store: SqlStore) -> None:
        self._store = store

    def collect(self) -> Iterator[Metric]:
        """The metrics of one moment."""
        store = self._store
        tiles, arrivals, waiting, dirty, aside = store.look(lambda c: fetch(c, "metrics")[0])
        state = store.queue_state()
        yield _gauge("gnd_tiles", "Tiles of all layers.", tiles)
        arrived = "Report parts that were made durable, since the store began."
        yield CounterMetricFamily("gnd_report_parts", arrived, value=arrivals)
        yield _gauge("gnd_report_parts_waiting", "Report parts that no merge has read.", waiting)
        yield _gauge("gnd_tiles_to_merge", "Tiles that wait to be merged.", dirty)
        yield _gauge("gnd_tiles_set_aside", "Tiles that cannot be merged; their reports wait.", aside)
        yield _gauge("gnd_queue_overdue_seconds", "Since when a tile that is ready is not merged.", state.overdue_s)
        yield _gauge("gnd_report_waiting_seconds", "Since when the oldest unread report part waits.", state.waiting_s)
        yield _gauge("gnd_quarantine_messages", "Refused messages that are kept.", state.quarantined)
        yield _gauge("gnd_quarantine_bytes", "Their bytes.", state.quarantined_bytes)
        lag = GaugeMetricFamily(
            "gnd_merge_lag_seconds",
            "From receipt to published version, of the newest report parts.",
            labels=["quantile"],
        )
        for share in (0.5, 0.95, 1.0):
            if (value := state.lag_s(share)) is not None:
                lag.add_metric([str(share)], value)
        yield lag
        alive = GaugeMetricFamily("gnd_shard_alive", "1: the shard was heard of lately, 0: not.", labels=["shard"])
        for shard in store.shards():
            alive.add_metric([shard.owner], shard.is_alive)
        yield alive
        size = GaugeMetricFamily("gnd_store_file_bytes", "Size of the store's files.", labels=["file"])
        for name, n_bytes in store.sizes().items():
            size.add_metric([name], n_bytes)
        yield size
        if (free := store.disk_free_bytes()) is not None:
            yield _gauge("gnd_store_disk_free_bytes", "Room on the disk of the store's file.", free)


def store_checks(store: SqlStore, bus: Bus) -> dict[str, Check]:
    """What makes a process over a store ill: it cannot write, the queue stands still, no router."""

    def can_write() -> None:
        store.transact(lambda c, _now: change(c, "touch", {}))

    def queue() -> str | None:
        overdue_s = store.queue_state().overdue_s
        if overdue_s <= OVERDUE_S:
            return None
        return f"a tile is overdue by {overdue_s:.0f} s, more than {OVERDUE_S:.0f} s"

    return {"store": can_write, "queue": queue, "router": lambda: None if bus.is_connected() else "no router answers"}


def _gauge(name: str, what: str, value: float) -> GaugeMetricFamily:
    return GaugeMetricFamily(name, what, value=value)
