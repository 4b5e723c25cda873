"""The traffic of a running fleet: rates of each vehicle against its link, and totals by kind.

All of it is read from the ledgers, which the vehicles write as they go: the bus carries no message for it, and the
last table of a run is its account.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from rich.table import Table

from gnd.fleet_bus.errors import LedgerError
from gnd.fleet_bus.ledger_file import AgentLedger, read_run
from gnd.fleet_bus.links import UNLIMITED, LinkProfile
from gnd.fleet_bus.traffic import AgentTraffic, agent_traffic, fleet_lines, fleet_totals, kind_text, per_km
from gnd.fleet_bus.traffic_wire import RESIDUES

_OLD_S: Final = 15.0
"""A running vehicle notes what its connection carried every second."""
_READ_EVERY_S: Final = 2.0
_READ_SHARE: Final = 0.05
"""Reading the ledgers may take this part of the time."""


@dataclass(frozen=True, slots=True)
class Rate:
    """How much a vehicle's connection carried between two looks at its ledger.

    Attributes:
        up_byte_s: from the vehicle, on the wire, byte/s.
        down_byte_s: to the vehicle.
        at_s: when the ledger had grown last, monotonic clock, s.
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


@dataclass(slots=True)
class LiveLedgers:
    """The accounts of a run that goes on, read anew now and then.

    Attributes:
        run: folder of the run; None where there is none to read.
        agents: accounts by vehicle.
        rates: what each vehicle's connection carries now.
        clock: monotonic time, s.
    """

    run: Path | None = None
    agents: dict[str, AgentTraffic] = field(default_factory=dict)
    rates: dict[str, Rate] = field(default_factory=dict)
    clock: Callable[[], float] = time.monotonic
    _grown_s: dict[str, float] = field(default_factory=dict)
    _not_before_s: float = 0.0

    def refresh(self, *, now: bool = False) -> None:
        """Read the ledgers if it is time to, or `now`."""
        begin_s = self.clock()
        if self.run is None or (begin_s < self._not_before_s and not now):
            return
        try:
            ledgers = read_run(self.run)
        except LedgerError:  # none yet, or one without a whole line yet
            ledgers = ()
        for ledger in ledgers:
            self._take(ledger, begin_s)
        end_s = self.clock()
        self._not_before_s = end_s + max(_READ_EVERY_S, (end_s - begin_s) / _READ_SHARE)

    def _take(self, ledger: AgentLedger, now_s: float) -> None:
        traffic, known = agent_traffic(ledger, ()), self.agents.get(ledger.agent)
        if traffic == known:
            return
        if known is not None:
            self.rates[ledger.agent] = rate_between(known, self._grown_s[ledger.agent], traffic, now_s)
        self.agents[ledger.agent], self._grown_s[ledger.agent] = traffic, now_s


def rate_between(older: AgentTraffic, older_s: float, newer: AgentTraffic, newer_s: float) -> Rate:
    """The rate between two accounts of one vehicle and their times; restarts add to an account."""
    passed_s = max(newer_s - older_s, 1e-3)
    up, down = newer.up_wire_bytes - older.up_wire_bytes, newer.down_wire_bytes - older.down_wire_bytes
    return Rate(max(up, 0) / passed_s, max(down, 0) / passed_s, newer_s)


def size_text(size: float) -> str:
    """Return a number of bytes for people: 812 B, 4.1 kB, 2.35 MB."""
    if size < 1000:
        return f"{size:.0f} B"
    return f"{size / 1e3:.1f} kB" if size < 1e6 else f"{size / 1e6:.2f} MB"


def rate_cell(rate: Rate | None, link: LinkProfile, direction: Literal["up", "down"], now_s: float) -> str:
    """The rate and its share of the link: 34.1 kB/s 0.2 %; a rate of long ago is none."""
    if rate is None or now_s - rate.at_s > _OLD_S:
        return "–"
    kb_s = (rate.up_byte_s if direction == "up" else rate.down_byte_s) / 1000
    share = rate.share(link, direction)
    return f"{kb_s:.1f} kB/s" if share is None else f"{kb_s:.1f} kB/s {_percent(share)}"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"


def kinds_table(agents: Sequence[AgentTraffic]) -> Table:
    """Bytes of all vehicles so far by kind on the wire, down and up, in kB and kB/km; the last row is their sum."""
    total, rows = fleet_totals(agents), _by_kind(agents)
    table = Table("on the wire", box=None, pad_edge=False, header_style="bold")
    for column in ("down kB", "kB/km", "up kB", "kB/km"):
        table.add_column(column, justify="right")
    for kind, sizes in rows.items():
        table.add_row(
            kind_text(kind), *_cells(sizes["down"], total["drive_km"]), *_cells(sizes["up"], total["drive_km"])
        )
    sums = (_cells(total[f"{way}_wire_bytes"], total["drive_km"]) for way in ("down", "up"))
    table.add_row("all", *(cell for cells in sums for cell in cells), style="bold")
    return table


def _by_kind(agents: Sequence[AgentTraffic]) -> dict[str, dict[str, int]]:
    """Wire bytes by kind and direction: kinds of messages first, then what the connections themselves cost."""
    lines = fleet_lines(agents)
    kinds = sorted({line.kind for line in lines if line.messages or line.app_bytes})
    rest = [name for name in RESIDUES if any(line.kind == name for line in lines)]
    sums = {kind: {"down": 0, "up": 0} for kind in (*kinds, *rest)}
    for line in lines:
        sums[line.kind][line.direction] += line.wire_bytes
    return sums


def _cells(size_bytes: int, drive_km: float) -> tuple[str, str]:
    rate = f"{per_km(size_bytes, drive_km):.1f}" if drive_km > 0 and size_bytes else "–"
    return f"{size_bytes / 1000:.3f}" if size_bytes else "–", rate


def plain_traffic(agents: Sequence[AgentTraffic]) -> str:
    """The same in a line: what there is on the wire a km, tiles and all else."""
    total = fleet_totals(agents)
    if not agents or total["drive_km"] <= 0:
        return "no traffic yet"
    return (
        f"on the wire {total['all_kB_per_km']:.1f} kB/km: tiles {total['tiles_kB_per_km']:.1f}, "
        f"all else {total['other_kB_per_km']:.1f}"
    )


def traffic_lines(traffic: Mapping[str, Any]) -> list[str]:
    """The account of a run in two lines for people: every byte on the wire, and what messages themselves hold.

    Args:
        traffic: `summary.json`'s "traffic", or `fleet_totals`.
    """
    wire = traffic["down_wire_bytes"] + traffic["up_wire_bytes"]
    problem = [f"traffic is not accounted for: {traffic['problem']}"] if traffic.get("problem") else []
    return [
        *problem,
        f"traffic, all bytes on the wire: {wire:,} B, {traffic['all_kB_per_km']:.1f} kB/km: "
        f"tiles {traffic['tiles_kB_per_km']:.1f}, all else {traffic['other_kB_per_km']:.1f} "
        f"(up {traffic['other_up_kB_per_km']:.1f}, down {traffic['other_down_kB_per_km']:.1f}; "
        f"in it keep-alives {traffic['keep_alives_kB_per_km']:.2f}, telemetry {traffic['telemetry_kB_per_km']:.2f})",
        f"of it messages themselves: {traffic['down_bytes']:,} B down, {traffic['up_bytes']:,} B up "
        f"({traffic['kB_per_km_down']:.1f} and {traffic['kB_per_km_up']:.1f} kB/km)",
    ]


def link_of(links: dict[str, LinkProfile], vehicle: str) -> LinkProfile:
    """The link of a vehicle, as far as it is known."""
    return links.get(vehicle, UNLIMITED)
