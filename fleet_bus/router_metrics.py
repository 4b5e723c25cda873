"""What a router shows of itself: who is connected, over how many links."""

from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING

from prometheus_client import CollectorRegistry
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.certificate_metrics import certificate_checks, register_certificate
from gnd.fleet_bus.health import HealthServer
from gnd.fleet_bus.refusals import show_refusals

if TYPE_CHECKING:
    from gnd.fleet_bus.gate import SecureRouter


class _Router(Collector):
    def __init__(self, router: "Bus | SecureRouter") -> None:
        self._router = router

    def collect(self) -> Iterator[GaugeMetricFamily]:
        sessions = GaugeMetricFamily("gnd_router_sessions", "Sessions connected to this router.", labels=["kind"])
        found = Counter(self._router.neighbours())
        for kind in sorted({"client", "router", *found}):  # also those of which there are none: alerts compare them
            sessions.add_metric([kind], found[kind])
        yield sessions


def watch_router(router: "Bus | SecureRouter", port: int, host: str) -> HealthServer:
    """Metrics and health of a router that runs in this process."""
    registry = CollectorRegistry()
    registry.register(_Router(router))
    show_refusals(registry)
    register_certificate(registry, router.certificate)
    checks = {"router": lambda: "it is closed" if router.is_closed else None, **certificate_checks(router.certificate)}
    return HealthServer(port, registry, checks, host=host)
