"""What this process has refused, by kind and reason: shown with its metrics."""

import logging
import time
from collections.abc import Callable
from typing import Final

from prometheus_client import CollectorRegistry, Counter

TOLD_EVERY_S: Final = 60.0
_REGISTRY: Final = CollectorRegistry()
REFUSALS: Final = Counter(
    "gnd_refusals",
    "Requests, messages and connections that were not served, by kind and reason.",
    ["kind", "reason"],
    registry=_REGISTRY,
)


def counted(kind: str, reason: str, n: int = 1) -> None:
    """Count refusals; kind and reason are words of the program, never of a message."""
    REFUSALS.labels(kind, reason).inc(n)


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


def show_refusals(registry: CollectorRegistry) -> None:
    """Show them among the metrics of a registry."""
    registry.register(REFUSALS)


def refusals() -> dict[tuple[str, str], int]:
    """How many there were until now, by (kind, reason)."""
    found = {}
    for metric in REFUSALS.collect():
        for sample in metric.samples:
            if sample.name.endswith("_total"):
                found[sample.labels["kind"], sample.labels["reason"]] = int(sample.value)
    return found
