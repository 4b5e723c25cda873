"""What this process has refused, by kind and reason: shown with its metrics."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:  # a vehicle shows no metrics: what makes them is not loaded for it
    from prometheus_client import CollectorRegistry
    from prometheus_client.metrics_core import CounterMetricFamily

TOLD_EVERY_S: Final = 60.0
_COUNTS: Final[Counter[tuple[str, str]]] = Counter()
_LOCK: Final = threading.Lock()


def counted(kind: str, reason: str, n: int = 1) -> None:
    """Count refusals; kind and reason are words of the program, never of a message."""
    with _LOCK:
        _COUNTS[kind, reason] += n


class RefusalsTold:
    """Tells in the log what was refused, once a minute where anything was: for processes that show no metrics.

    Args:
        log: where it is told.
        clock_s: a clock that does not step, s.
    """

    def __init__(self, log: logging.Logger, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._log, self._clock_s = log, clock_s
        self._told: dict[tuple[str, str], int] = {}
        self._next_s = clock_s() + TOLD_EVERY_S

    def tell(self) -> None:
        """Call it often."""
        if self._clock_s() < self._next_s:
            return
        self._next_s = self._clock_s() + TOLD_EVERY_S
        now = refusals()
        new = {at: n - self._told.get(at, 0) for at, n in now.items() if n > self._told.get(at, 0)}
        self._told = now
        if new:
            self._log.warning("refused: %s", ", ".join(f"{n} {kind} ({why})" for (kind, why), n in sorted(new.items())))


def refusals() -> dict[tuple[str, str], int]:
    """How many there were until now, by (kind, reason)."""
    with _LOCK:
        return dict(_COUNTS)


class _RefusalsCollector:
    """Collector of the refusals, as prometheus_client asks one."""

    def collect(self) -> "Iterator[CounterMetricFamily]":
        """The counter with a sample for each kind and reason."""
        from prometheus_client.metrics_core import CounterMetricFamily

        shown = CounterMetricFamily(
            "gnd_refusals",
            "Requests, messages and connections that were not served, by kind and reason.",
            labels=["kind", "reason"],
        )
        for at, n in refusals().items():
            shown.add_metric(at, n)
        yield shown


def show_refusals(registry: "CollectorRegistry") -> None:
    """Show them among the metrics of a registry."""
    registry.register(_RefusalsCollector())
