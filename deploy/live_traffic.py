"""The traffic of a running fleet: rates of each vehicle against its link, and totals by kind."""

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal

from rich.table import Table

from fleet_bus.links import UNLIMITED, LinkProfile
from fleet_bus.traffic import per_km
from schemas.traffic import TrafficSample

_OLD_S: Final = 15.0
"""A vehicle that is well sends a sample every ten seconds at least."""


@dataclass(frozen=True, slots=True)
class Rate:
    """How much a vehicle's connection carried between its last two samples.

    Attributes:
        up_byte_s: from the vehicle, on the wire, byte/s.
        down_byte_s: to the vehicle.
        at_s: when the newer sample came, monotonic clock, s.
    """

    up_byte_s: float
    down_byte_s: float
    at_s: float

    def share(self, link: LinkProfile, direction: Literal["up", "down"]) -> float | None:
        """Part of the link's capacity, None where it has no limit."""
        rate_byte_s = link.rate_byte_s(direction)
        if math.isinf(rate_byte_s):
            return None
        return (self.up_byte_s if direction == "up" else self.down_byte_s) / rate_byte_s


def rate_between(older: TrafficSample, older_s: float, newer: TrafficSample, newer_s: float) -> Rate | None:
    """The rate between two samples and their times of arrival; None where the agent was started again meanwhile."""
    up, down = newer.wire_up_bytes - older.wire_up_bytes, newer.wire_down_bytes - older.wire_down_bytes
    passed_s = newer_s - older_s
    if up < 0 or down < 0 or passed_s <= 0:
        return None
    return Rate(up / passed_s, down / passed_s, newer_s)


def rate_cell(rate: Rate | None, link: LinkProfile, direction: Literal["up", "down"], now_s: float) -> str:
    """The rate and its share of the link: 34.1 kB/s 0.2 %; a rate of long ago is none."""
    if rate is None or now_s - rate.at_s > _OLD_S:
        return "–"
    kb_s = (rate.up_byte_s if direction == "up" else rate.down_byte_s) / 1000
    share = rate.share(link, direction)
    return f"{kb_s:.1f} kB/s" if share is None else f"{kb_s:.1f} kB/s {_percent(share)}"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"


def kinds_table(samples: Iterable[TrafficSample]) -> Table:
    """Payload of all vehicles so far by kind, down and up, in kB and kB/km; the last row is what the wires carried."""
    samples = tuple(samples)
    drive_km = sum(sample.odometer_m for sample in samples) / 1000
    table = Table("kind", box=None, pad_edge=False, header_style="bold")
    for column in ("down kB", "kB/km", "up kB", "kB/km"):
        table.add_column(column, justify="right")
    for kind, sizes in sorted(_by_kind(samples).items()):
        table.add_row(kind, *_cells(sizes["down"], drive_km), *_cells(sizes["up"], drive_km))
    down, up = sum(s.wire_down_bytes for s in samples), sum(s.wire_up_bytes for s in samples)
    table.add_row("on the wire", *_cells(down, drive_km), *_cells(up, drive_km), style="bold")
    return table


def _by_kind(samples: Iterable[TrafficSample]) -> dict[str, dict[str, int]]:
    sums: dict[str, dict[str, int]] = defaultdict(lambda: {"down": 0, "up": 0})
    for line in (line for sample in samples for line in sample.lines):
        sums[line.kind][line.direction] += line.app_bytes
    return sums


def _cells(size_bytes: int, drive_km: float) -> tuple[str, str]:
    rate = f"{per_km(size_bytes, drive_km):.1f}" if drive_km > 0 and size_bytes else "–"
    return f"{size_bytes / 1000:.1f}" if size_bytes else "–", rate


def plain_traffic(samples: Iterable[TrafficSample]) -> str:
    """The same in a line: kinds with their kB/km, down and up."""
    samples = tuple(samples)
    drive_km = sum(sample.odometer_m for sample in samples) / 1000
    kinds = sorted(_by_kind(samples).items())
    parts = (
        f"{way} " + ", ".join(f"{kind} {per_km(sizes[way], drive_km):.1f}" for kind, sizes in kinds if sizes[way])
        for way in ("down", "up")
        if any(sizes[way] for _, sizes in kinds)
    )
    text = "; ".join(parts)
    return f"kB/km {text}" if text and drive_km > 0 else "no traffic yet"


def link_of(links: dict[str, LinkProfile], vehicle: str) -> LinkProfile:
    """The link of a vehicle, as far as it is known."""
    return links.get(vehicle, UNLIMITED)
