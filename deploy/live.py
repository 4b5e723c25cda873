"""The display of a running fleet: a table of the agents, or plain lines where there is no terminal."""

import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from gnd.deploy.live_traffic import LiveLedgers, kinds_table, link_of, plain_traffic, rate_cell, size_text
from gnd.deploy.map_use import MapUse
from gnd.fleet_bus.links import LinkProfile
from gnd.schemas.errors import SchemaError
from gnd.schemas.traffic import TrafficSample

HEALTH_STYLE = {"good": "green", "degraded": "yellow", "lost": "red"}
PLAIN_PERIOD_S = 10.0
WIDE = 108
_COLUMNS = (
    "vehicle", "position", "health", "driven", "map renewed", "down", "of link, down", "up", "of link, up", "tiles",
    "reports", "doubts",
)  # fmt: skip
_TEXTS = ("vehicle", "position", "health")
_WIDE_ONLY = ("position", "tiles", "reports")
_RENEWED = "map renewed"


@dataclass(slots=True)
class FleetState:
    """The newest sample of every agent and the totals of the cloud.

    Attributes:
        samples: newest traffic sample by vehicle.
        published: tile versions published so far.
        reports: reports in the store so far.
        updates: updates that the watcher has received.
        waiting: tiles that wait for a merge.
        events: the last things that happened, newest last.
        maps: which map each vehicle drives on, as far as known.
        links: profile of each vehicle's link, as far as known.
        ledgers: what the vehicles have sent and received.
    """

    samples: dict[str, TrafficSample] = field(default_factory=dict)
    published: int = 0
    reports: int = 0
    updates: int = 0
    waiting: int = 0
    events: list[str] = field(default_factory=list)
    maps: dict[str, MapUse] = field(default_factory=dict)
    links: dict[str, LinkProfile] = field(default_factory=dict)
    ledgers: LiveLedgers = field(default_factory=LiveLedgers)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def on_traffic(self, key: str, payload: bytes) -> None:
        """Take a traffic sample from the bus; an unreadable one is noted and left out."""
        try:
            sample = TrafficSample.decode(payload)
        except SchemaError as error:
            self.note(f"unreadable sample on {key}: {error}")
            return
        with self.lock:
            known = self.samples.get(sample.vehicle)
            if known is None or sample.t_ns >= known.t_ns:
                self.samples[sample.vehicle] = sample

    def note(self, text: str) -> None:
        """Remember an event; the last three are shown."""
        with self.lock:
            self.events = [*self.events[-2:], f"{time.strftime('%H:%M:%S')} {text}"]


def render(state: FleetState, width: int = WIDE) -> Group:
    """Draw the state as tables and a line of totals; less a vehicle where there is no room for a line each.

    Args:
        state: what to draw.
        width: columns of the terminal.
    """
    table = Table(box=None, pad_edge=False, header_style="bold")
    doubts = any(map(doubts_text, state.samples.values()))
    shown = [name for name in _COLUMNS if width >= WIDE or name not in _WIDE_ONLY]
    shown = [name for name in shown if (doubts or name != "doubts") and (state.maps or name != _RENEWED)]
    for name in shown:
        table.add_column(name.split(",")[0], justify="left" if name in _TEXTS else "right", no_wrap=True)
    with state.lock:
        for vehicle in sorted(state.samples):
            row = dict(zip(_COLUMNS, _row(state, state.samples[vehicle]), strict=True))
            table.add_row(*(row[name] for name in shown))
        totals = (
            f"store: {state.reports} reports, {state.waiting} tiles waiting, {state.published} versions published"
            f"   watcher: {state.updates} updates"
        )
        events = (Text(event, style="dim") for event in state.events)
        agents = tuple(state.ledgers.agents.values())
        kinds = (Text(), kinds_table(agents), Text()) if agents else ()
        return Group(table, *kinds, Text(totals, style="bold"), *events)


def _row(state: FleetState, sample: TrafficSample) -> tuple[str | Text, ...]:
    ledgers, link = state.ledgers, link_of(state.links, sample.vehicle)
    rate, traffic = ledgers.rates.get(sample.vehicle), ledgers.agents.get(sample.vehicle)
    driven_m = max(sample.odometer_m, 1000 * traffic.drive_km if traffic else 0.0)
    return (
        sample.vehicle,
        f"{math.degrees(sample.lat_rad):.5f} {math.degrees(sample.lon_rad):.5f}" if sample.has_position else "private",
        Text(sample.health, style=HEALTH_STYLE.get(sample.health, "dim")),
        f"{driven_m:.0f} m",
        renewed_text(state.maps.get(sample.vehicle)),
        size_text(traffic.down_wire_bytes if traffic else sample.wire_down_bytes),
        rate_cell(rate, link, "down", ledgers.clock()),
        size_text(traffic.up_wire_bytes if traffic else sample.wire_up_bytes),
        rate_cell(rate, link, "up", ledgers.clock()),
        str(sample.tiles),
        str(sample.reports),
        Text(doubts_text(sample), style="yellow"),
    )


def renewed_text(use: MapUse | None) -> str:
    """Share of the map under a vehicle that others have updated: "80 %, 12 s old"; empty where unknown."""
    if use is None:
        return ""
    age = f", {use.newest_age_s:.0f} s old" if use.newest_age_s is not None else ""
    return f"{use.renewed_share:.0%}".replace("%", " %") + age


def doubts_text(sample: TrafficSample) -> str:
    """Tiles in doubt ("4 tiles (2 held back)"), scans taken back, a map that is stale; empty where there are none."""
    parts = [f"{sample.tiles_doubtful} tiles ({sample.tiles_held_back} held back)"] if sample.tiles_doubtful else []
    parts += [f"{sample.scans_taken_back} scans"] if sample.scans_taken_back else []
    parts += [f"map not confirmed for {sample.map_stale_h} h"] if sample.map_stale_h else []
    return ", ".join(parts)


@contextmanager
def live_view(state: FleetState, console: Console) -> Iterator["LiveView"]:
    """Show the state while the block runs."""
    if not console.is_terminal:
        yield LiveView(state, console, None)
        return
    with Live(render(state, console.width), console=console, refresh_per_second=2, transient=False) as live:
        try:
            yield LiveView(state, console, live)
        finally:  # what stays on the screen is the account of the whole run
            state.ledgers.refresh(now=True)
            live.update(render(state, console.width))


@dataclass(slots=True)
class LiveView:
    """A place to redraw the state; on a plain stream it prints a line every ten seconds."""

    state: FleetState
    console: Console
    live: Live | None
    printed_s: float = 0.0

    def refresh(self) -> None:
        """Show the newest state."""
        self.state.ledgers.refresh()
        if self.live is not None:
            self.live.update(render(self.state, self.console.width))
        elif time.monotonic() - self.printed_s >= PLAIN_PERIOD_S:
            self.printed_s = time.monotonic()
            self.console.print(self._plain(), soft_wrap=True)

    def _plain(self) -> str:
        with self.state.lock:
            agents = tuple(self.state.ledgers.agents.values())
            driven_m = 1000 * sum(agent.drive_km for agent in agents)
            doubtful = sum(sample.tiles_doubtful for sample in self.state.samples.values())
            held_back = sum(sample.tiles_held_back for sample in self.state.samples.values())
            doubts = f"{doubtful} tiles doubtful ({held_back} held back); " if doubtful else ""
            on_found = sum(use.renewed_share > 0 for use in self.state.maps.values())
            found = f"{on_found} use updates of others; " if on_found else ""
            return (
                f"{len(self.state.samples)} agents, {driven_m:.0f} m driven, {self.state.reports} reports, "
                f"{self.state.waiting} tiles waiting, {self.state.published} versions, {self.state.updates} updates; "
                + found
                + doubts
                + plain_traffic(agents)
            )


@contextmanager
def progress_bars(console: Console) -> Iterator[Progress]:
    """Show progress bars while the block runs."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        yield progress
