"""What a merger shard shows of itself to Prometheus."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

from gnd.cloud_merger.served import ServedCpu
from gnd.tile_store.values import PublishResult

MERGE_BUCKETS_S = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0)


class ShardMetrics:
    """Counts of what one shard has done since it began."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self._settled = Counter(
            "gnd_merges", "Merges of tiles by what came of them.", ["outcome"], registry=self.registry
        )
        for outcome in ("published", "unchanged", "stale", "failed"):
            self._settled.labels(outcome)
        self._seconds = Histogram(
            "gnd_merge_seconds",
            "From the claim's turn to the commit.",
            buckets=MERGE_BUCKETS_S,
            registry=self.registry,
        )
        self._notices = Counter("gnd_notices", "Update notices that have gone out.", registry=self.registry)
        self._failures = Counter(
            "gnd_store_failures", "How often the store could not do what was asked.", registry=self.registry
        )

    def show_served(self, served: ServedCpu) -> None:
        """Shows the CPU that went into uploads, and how many vehicles wait because of it."""
        held = Gauge(
            "gnd_vehicles_held_back", "Vehicles whose uploads wait: beyond their share of CPU.", registry=self.registry
        )
        held.set_function(lambda: served.held_back)
        seconds = Gauge(
            "gnd_upload_cpu_seconds", "CPU that went into uploads, by whose.", ["whose"], registry=self.registry
        )
        for whose in served.spent_s:
            seconds.labels(whose).set_function(partial(served.spent_s.__getitem__, whose))

    @contextmanager
    def merging(self, tiles: int) -> Iterator[None]:
        """Times the merges of tiles that share a commit."""
        begin_s = time.monotonic()
        yield
        for _ in range(tiles):
            self._seconds.observe(time.monotonic() - begin_s)

    def settled(self, result: PublishResult | None) -> None:
        """Counts one merge; None: it has failed or its lease was gone."""
        self._settled.labels("failed" if result is None else result.status).inc()

    def merges(self) -> dict[str, int]:
        """Merges so far, by what came of them."""
        (family,) = self._settled.collect()
        return {s.labels["outcome"]: int(s.value) for s in family.samples if s.name == "gnd_merges_total"}

    def announced(self, n: int) -> None:
        """Counts notices."""
        self._notices.inc(n)

    def store_failed(self) -> None:
        """Counts a failure of the store."""
        self._failures.inc()
