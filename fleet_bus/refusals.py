"""What this process has refused, by kind and reason: shown with its metrics."""

from typing import Final

from prometheus_client import CollectorRegistry, Counter

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
