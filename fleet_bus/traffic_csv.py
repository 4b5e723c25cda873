"""The report of `gnd traffic` as one tidy table: a row for each agent, kind and direction."""

import csv
import io
from collections.abc import Iterator

from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.traffic import AgentTraffic, KindTraffic, per_km


def as_csv(agents: tuple[AgentTraffic, ...], links: tuple[LinkProfile, ...]) -> str:
    """Comma-separated values with a header.

    Columns: agent, drive_km, drive_s, kind, direction, messages, app_bytes, wire_bytes, kB_per_km and wire_kB_per_km,
    then for each link `share_NAME`, the part of its capacity during the drive that the wire bytes take up (empty for
    an agent that did not drive). Wire bytes of an agent and direction add up to its measured total.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow((*_COLUMNS, *(f"share_{link.name}" for link in links)))
    writer.writerows(_row(agent, line, links) for agent, line in _lines(agents))
    return text.getvalue()


_COLUMNS = (
    "agent", "drive_km", "drive_s", "kind", "direction", "messages", "app_bytes", "wire_bytes", "kB_per_km",
    "wire_kB_per_km",
)  # fmt: skip


def _lines(agents: tuple[AgentTraffic, ...]) -> Iterator[tuple[AgentTraffic, KindTraffic]]:
    return ((agent, line) for agent in agents for line in agent.lines)


def _row(agent: AgentTraffic, line: KindTraffic, links: tuple[LinkProfile, ...]) -> list[str | int]:
    return [
        agent.agent,
        f"{agent.drive_km:.6f}",
        f"{agent.drive_s:.3f}",
        line.kind,
        line.direction,
        line.messages,
        line.app_bytes,
        line.wire_bytes,
        f"{per_km(line.app_bytes, agent.drive_km):.6f}",
        f"{per_km(line.wire_bytes, agent.drive_km):.6f}",
        *(_share(agent, line, link) for link in links),
    ]


def _share(agent: AgentTraffic, line: KindTraffic, link: LinkProfile) -> str:
    if agent.drive_s <= 0:
        return ""
    return f"{line.wire_bytes / (link.rate_byte_s(line.direction) * agent.drive_s):.9f}"
