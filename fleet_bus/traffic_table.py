"""The report of `gnd traffic` as tables for people."""

from rich.console import Console
from rich.table import Table

from fleet_bus.traffic import AgentTraffic, fleet_totals


def print_tables(agents: tuple[AgentTraffic, ...], console: Console) -> None:
    """Prints the messages by agent and kind, then the use of each link."""
    console.print(_messages(agents))
    console.print(_links(agents))
    ignored = sum(agent.ignored_lines for agent in agents)
    if ignored:
        console.print(f"{ignored} unfinished ledger lines left out (a process was killed while writing)")


def _messages(agents: tuple[AgentTraffic, ...]) -> Table:
    table = Table("agent", "kind", "way", title="Payload by agent and kind", caption=_caption(agents))
    for column in ("messages", "kB", "kB/km"):
        table.add_column(column, justify="right")
    for agent in agents:
        for line in agent.lines:
            size_kb = line.app_bytes / 1000
            per_km = f"{size_kb / agent.drive_km:.1f}" if agent.drive_km > 0 else "–"
            table.add_row(agent.agent, line.kind, line.direction, str(line.messages), f"{size_kb:.1f}", per_km)
        table.add_section()
    return table


def _links(agents: tuple[AgentTraffic, ...]) -> Table:
    caption = "share = part of what the link can carry during the drive; sizes with the overhead of each message"
    table = Table("agent", "link", "way", title="On mobile links", caption=caption)
    for column in ("busy s", "share %", "longest wait s", "a tile arrives after s"):
        table.add_column(column, justify="right")
    for agent in agents:
        for use in agent.links:
            arrival = f"{agent.tile_arrival_s[use.link]:.3f}" if use.direction == "down" else ""
            numbers = (f"{use.sending_s:.3f}", f"{100 * use.share:.3f}", f"{use.longest_wait_s:.3f}", arrival)
            table.add_row(agent.agent, use.link, use.direction, *numbers)
        table.add_section()
    return table


def _caption(agents: tuple[AgentTraffic, ...]) -> str:
    total = fleet_totals(agents)
    return (
        f"{total['agents']} agents, {total['drive_km']:.2f} km: "
        f"down {total['down_bytes'] / 1000:.1f} kB ({total['kB_per_km_down']:.1f} kB/km), "
        f"up {total['up_bytes'] / 1000:.1f} kB ({total['kB_per_km_up']:.1f} kB/km); on the wire "
        f"down {total['down_wire_bytes'] / 1000:.1f} kB, up {total['up_wire_bytes'] / 1000:.1f} kB"
    )
