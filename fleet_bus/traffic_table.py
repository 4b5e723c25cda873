"""The report of `gnd traffic` as tables for people."""

from collections.abc import Iterable

from rich.console import Console
from rich.table import Table

from gnd.fleet_bus.traffic import AgentTraffic, KindTraffic, fleet_lines, fleet_totals, kind_text, per_km
from gnd.words import many


def print_tables(agents: tuple[AgentTraffic, ...], console: Console) -> None:
    """Prints the kinds of the whole fleet, each agent's own, and the use of each link."""
    console.print(_fleet(agents))
    if len(agents) > 1:
        console.print(_by_agent(agents))
    console.print(_links(agents))
    for note in notes(agents):
        console.print(note)


def notes(agents: tuple[AgentTraffic, ...]) -> list[str]:
    """What a reader of the figures has to know about them."""
    ignored = sum(agent.ignored_lines for agent in agents)
    estimated = sum(agent.estimated_wire_bytes for agent in agents)
    lines = []
    if ignored:
        lines.append(
            f"{many(ignored, 'unfinished ledger line')} left out (a process was killed while writing, or damage)"
        )
    if estimated:
        lines.append(
            f"{estimated / 1000:.1f} kB on the wire are estimated: no reading of the connection covers them "
            "(sent after the last reading before a kill, or this system does not count)"
        )
    return lines


def _fleet(agents: tuple[AgentTraffic, ...]) -> Table:
    table = _kinds("Bytes by kind, all agents", caption(agents))
    drive_km = sum(agent.drive_km for agent in agents)
    _add(table, "all" if len(agents) > 1 else agents[0].agent, fleet_lines(agents), drive_km)
    return table


def _by_agent(agents: tuple[AgentTraffic, ...]) -> Table:
    table = _kinds("Bytes by agent and kind", "")
    for agent in agents:
        _add(table, agent.agent, agent.lines, agent.drive_km)
    return table


def _kinds(title: str, caption_: str) -> Table:
    table = Table("agent", "kind", "way", title=title, caption=caption_ or None)
    for column in ("messages", "kB", "kB/km", "wire kB", "wire kB/km"):
        table.add_column(column, justify="right")
    return table


def _add(table: Table, agent: str, lines: Iterable[KindTraffic], drive_km: float) -> None:
    for line in lines:
        app, wire = line.app_bytes, line.wire_bytes
        table.add_row(
            agent, kind_text(line.kind), line.direction, str(line.messages) if line.messages else "–",
            f"{app / 1000:.3f}" if app else "–", _per_km(app, drive_km) if app else "–",
            f"{wire / 1000:.3f}", _per_km(wire, drive_km),
        )  # fmt: skip
    table.add_section()


def _per_km(size_bytes: int, drive_km: float) -> str:
    return f"{per_km(size_bytes, drive_km):.1f}" if drive_km > 0 else "–"


def _links(agents: tuple[AgentTraffic, ...]) -> Table:
    text = "share = part of what the link can carry during the drive, by the bytes on the wire"
    table = Table("agent", "link", "way", title="On mobile links", caption=text)
    for column in ("busy s", "share %", "longest wait s", "a tile arrives after s"):
        table.add_column(column, justify="right")
    for agent in agents:
        for use in agent.links:
            arrival_s = agent.tile_arrival_s[use.link] if use.direction == "down" else None
            arrival = "" if arrival_s is None else f"{arrival_s:.3f}"
            numbers = (f"{use.sending_s:.3f}", f"{100 * use.share:.3f}", f"{use.longest_wait_s:.3f}", arrival)
            table.add_row(agent.agent, use.link, use.direction, *numbers)
        table.add_section()
    return table


def caption(agents: tuple[AgentTraffic, ...]) -> str:
    """The totals in one sentence."""
    total = fleet_totals(agents)
    return (
        f"{many(total['agents'], 'agent')}, {total['drive_km']:.2f} km: "
        f"down {total['down_bytes'] / 1000:.3f} kB ({total['kB_per_km_down']:.1f} kB/km), "
        f"up {total['up_bytes'] / 1000:.3f} kB ({total['kB_per_km_up']:.1f} kB/km); on the wire "
        f"down {total['down_wire_bytes'] / 1000:.3f} kB, up {total['up_wire_bytes'] / 1000:.3f} kB; "
        f"all bytes {total['all_kB_per_km']:.2f} kB/km: tiles {total['tiles_kB_per_km']:.2f}, "
        f"all else {total['other_kB_per_km']:.2f}"
    )
