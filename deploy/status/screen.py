"""The operator's room as text: alerts with what to do, the cloud, the vehicles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from gnd.deploy.live import HEALTH_STYLE, FleetState, doubts_text
from gnd.deploy.live_traffic import size_text
from gnd.deploy.status.figures import CloudFigures
from gnd.deploy.status.raised import RaisedAlert, Severity

MOST_VEHICLES: Final = 30
_MOST_NAMES: Final = 8
_COLOURS: Final[dict[Severity, str]] = {"critical": "bold red", "warning": "yellow"}
_OPEN: Final = {
    "waiting": "not looked at yet",
    "early": "wait for the rest of their report",
    "wanted": "wait for Gaussians that were asked for",
    "resend": "to be sent whole",
}
"""Acknowledged uploads that are not settled, in words."""


@dataclass(frozen=True, slots=True)
class RoomView:
    """One look: figures, the alerts that they raise, and the rate since the look before (None: there was none).

    Attributes:
        parts_per_s: report parts acknowledged a second.
    """

    figures: CloudFigures
    raised: tuple[RaisedAlert, ...]
    parts_per_s: float | None = None


def screen(view: RoomView, fleet: FleetState | None, hint: str = "") -> Group:
    """Everything, one part below the other.

    Args:
        view: what was looked at.
        fleet: vehicles that were heard of; None: nobody listened.
        hint: how to end, for a terminal.
    """
    figures = view.figures
    at = datetime.fromtimestamp(figures.at_ns / 1e9, UTC)
    head = Text.assemble((figures.source, "bold"), f"  {at:%H:%M:%S} UTC  ", (hint, "dim"))
    parts: list[RenderableType] = [head, _alerts(view.raised), Text(), _cloud(view)]
    if fleet is not None:
        parts += [Text(), vehicles_table(fleet)]
    return Group(*parts)


def _alerts(raised: Sequence[RaisedAlert]) -> RenderableType:
    if not raised:
        return Text("no alert", style="green")
    lines: list[RenderableType] = []
    for one in raised:
        lines.append(Text.assemble((f"{one.severity:8}", _COLOURS[one.severity]), f"  {one.alert}: {one.says}"))
        lines.append(Text(f"          → {one.do}"))
    return Group(*lines)


def _cloud(view: RoomView) -> Table:
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for name, says in cloud_lines(view).items():
        table.add_row(name, Text(says))
    return table


def cloud_lines(view: RoomView) -> dict[str, str]:
    """What is said of the cloud: a line each, by its name."""
    figures, queue = view.figures, view.figures.queue
    rate = "" if view.parts_per_s is None else f", {view.parts_per_s:.1f} a second"
    lines = {
        "shards": _listed(figures.alive, "none runs")
        + (f"; not heard of: {_listed(figures.silent)}" if figures.silent else ""),
        "map": f"{_counted(figures.tiles, 'tile')}",
        "acknowledged": f"{_counted(figures.parts, 'report part')}{rate}{_unsettled(figures.uploads)}",
        "queue": _queue(figures),
        "from receipt to version": _lag(view),
        "set aside": f"{_counted(figures.tiles_set_aside, 'tile')}",
        "waiting for confirmation": _waiting(figures.waiting),
        "releases": f"{_counted(figures.on_trial, 'version')} on trial"
        + (f", {figures.paused} paused" * (figures.paused > 0)),
        "quarantine": f"{_counted(queue.quarantined, 'message')}, {size_text(queue.quarantined_bytes)}",
        "vehicles not counted": _listed([f"{name} ({why})" for name, why in figures.not_counted.items()], "none"),
    }
    if figures.to_check:
        lines["vehicles to check"] = _listed(figures.to_check)
    lines["disk"] = _disk(figures)
    if figures.certificate_s is not None:
        lines["own certificate"] = f"holds {figures.certificate_s / 86400:.1f} days"
    return lines


def _queue(figures: CloudFigures) -> str:
    queue = figures.queue
    if not figures.tiles_to_merge:
        return "empty"
    return (
        f"{_counted(figures.tiles_to_merge, 'tile')} to merge, {_counted(figures.parts_waiting, 'report part')};"
        f" the oldest waits {queue.waiting_s:.1f} s, overdue {queue.overdue_s:.1f} s"
    )


def _lag(view: RoomView) -> str:
    queue = view.figures.queue
    median_s, most_s = queue.lag_s(0.5), queue.lag_s(0.95)
    if median_s is None or most_s is None:
        return "nothing published yet"
    return f"median {median_s:.1f} s, 95 % within {most_s:.1f} s"


def _unsettled(uploads: Mapping[str, int]) -> str:
    found = [f"{uploads[name]} {words}" for name, words in _OPEN.items() if uploads.get(name)]
    return f"; of the uploads {', '.join(found)}" if found else ""


def _waiting(waiting: Mapping[str, int]) -> str:
    parked = f"; {waiting['parked']} voxels until they have stood long enough" if waiting["parked"] else ""
    season = f"; {waiting['season']} voxels of leaves" if waiting["season"] else ""
    return f"{_counted(waiting['voxels'], 'voxel')} in {_counted(waiting['tiles'], 'tile')}{parked}{season}"


def _disk(figures: CloudFigures) -> str:
    used = f"the store takes {size_text(figures.disk.store_bytes)}"
    if figures.disk.free_bytes is None:
        return f"{used} of its database"
    return f"{used}; {figures.disk.free_bytes / 1e9:.1f} GB are free in {figures.disk.folder}"


def vehicles_table(fleet: FleetState) -> RenderableType:
    """A line for each vehicle that was heard of or has a ledger in the run's folder."""
    with fleet.lock:
        names = sorted(fleet.samples.keys() | fleet.ledgers.agents.keys())
        rows = [_vehicle(fleet, name) for name in names[:MOST_VEHICLES]]
    if not rows:
        return Text("no vehicle was heard of yet", style="dim")
    left = f" ({MOST_VEHICLES} of {len(names)} are shown)" if len(names) > MOST_VEHICLES else ""
    table = Table(box=None, pad_edge=False, title=f"{_counted(len(names), 'vehicle')}{left}", title_justify="left")
    for name in ("vehicle", "health", "driven", "down", "up", "tiles", "reports", "doubts"):
        table.add_column(name, justify="left" if name in ("vehicle", "health", "doubts") else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table


def _vehicle(fleet: FleetState, name: str) -> tuple[str | Text, ...]:
    sample, traffic = fleet.samples.get(name), fleet.ledgers.agents.get(name)
    driven_m = max(sample.odometer_m if sample else 0.0, 1000 * traffic.drive_km if traffic else 0.0)
    down = traffic.down_wire_bytes if traffic else sample.wire_down_bytes if sample else 0
    up = traffic.up_wire_bytes if traffic else sample.wire_up_bytes if sample else 0
    health = Text(sample.health, style=HEALTH_STYLE.get(sample.health, "dim")) if sample else Text("not heard", "dim")
    told = (str(sample.tiles), str(sample.reports), doubts_text(sample)) if sample else ("", "", "")
    return (name, health, f"{driven_m:.0f} m", size_text(down), size_text(up), *told)


def _counted(n: int, noun: str) -> str:
    return f"{n:,} {noun}{'s' * (n != 1)}"


def _listed(names: Sequence[str], none: str = "") -> str:
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return (", ".join(names[:_MOST_NAMES]) + more) or none


def one_line(view: RoomView, fleet: FleetState | None) -> str:
    """The same in a line, for a log or for `--check`."""
    figures = view.figures
    worst = view.raised[0].severity.upper() if view.raised else "OK"
    says = "; ".join(f"{one.alert}: {one.says}" for one in view.raised)
    vehicles = f", {_counted(len(fleet.samples), 'vehicle')} heard" if fleet is not None else ""
    shards = f"{_counted(len(figures.alive), 'shard')}, {_counted(figures.tiles_to_merge, 'tile')} to merge"
    return f"{worst}: {says or 'no alert'} ({shards}, overdue {figures.queue.overdue_s:.0f} s{vehicles})"
