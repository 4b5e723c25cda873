"""What a process shows of its programs and of its clock, so that others can compare them with their own."""

import platform
import time
from collections.abc import Iterator
from importlib import metadata
from typing import Final

from prometheus_client import CollectorRegistry
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

BUILD: Final = "gnd_build_info"
CLOCK: Final = "gnd_clock_seconds"


def build_info() -> dict[str, str]:
    """Versions that must match on one bus, by label; "" of what was not installed as a distribution."""
    named = {"version": "gnd-fleet", "zenoh": "eclipse-zenoh", "protobuf": "protobuf"}
    return {label: _version(name) for label, name in named.items()} | {"python": platform.python_version()}


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""


class _Build(Collector):
    def collect(self) -> Iterator[GaugeMetricFamily]:
        told = build_info()
        family = GaugeMetricFamily(BUILD, "Always 1; the labels are versions of the programs.", labels=list(told))
        family.add_metric(list(told.values()), 1)
        yield family
        yield GaugeMetricFamily(CLOCK, "The clock of this machine when it was asked, s since 1970.", value=time.time())


def register_build(registry: CollectorRegistry) -> None:
    """Adds gnd_build_info and gnd_clock_seconds."""
    registry.register(_Build())
