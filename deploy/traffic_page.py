"""The account of a run as a page."""

from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path

from gnd.deploy.html_page import document, section, write_html
from gnd.deploy.traffic_page_chart import curves
from gnd.deploy.traffic_page_map import tile_map
from gnd.deploy.traffic_page_tables import agents_table, arrivals_text, cards, kinds_table, links_table, sources
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.traffic import AgentTraffic, fleet_tiles
from gnd.fleet_bus.traffic_table import notes

_HOW = """<p>Payload is the content of the messages. On the wire are the bytes that the kernel counted on each
vehicle's connection (TCP_INFO: stream and packet headers). Each of them is assigned: every message has its
payload, key, envelope and packets; <b>TCP acks</b> are packets without data (<b>TCP acks of tiles</b> those that answer
tiles, by the share of packets), <b>resent</b> is what was lost and sent again, <b>opening</b> and <b>closing</b> are
those of connections, <b>keep-alives</b> what an idle session sends to stay open, and <b>session</b> is the rest:
declarations, answers that arrived too late. A kind without messages of its own consists of shares of other messages:
one answer may contain many tiles.</p>"""


def page(run: str, agents: Sequence[AgentTraffic], links: Sequence[LinkProfile]) -> str:
    """The page of a run as HTML.

    Args:
        run: its name.
        agents: the account of each agent, at least one.
        links: profiles to compare with.
    """
    title = f"Traffic of {escape(run)}"
    parts = (section(name, content) if name else content for name, content in traffic_sections(agents, links))
    return document(title, (f"<header><h1>{title}</h1>{_subtitle(agents)}</header>", *parts))


def traffic_sections(agents: Sequence[AgentTraffic], links: Sequence[LinkProfile]) -> Iterator[tuple[str, str]]:
    """Titles and contents of the parts of the page, as HTML; the cards have no title."""
    yield "", cards(agents)
    yield "By kind of message", kinds_table(agents) + _notes(agents) + _details("How bytes are counted", _HOW)
    yield "Along the drive", _along(agents, links)
    yield "On mobile links", links_table(agents, links) + _details("Where the figures come from", sources(links))
    yield "Time that a tile needs to arrive", arrivals_text(agents)
    yield "Bytes by tile", tile_map(fleet_tiles(agents))
    yield "By vehicle", agents_table(agents)


def write_page(path: Path, run: str, agents: Sequence[AgentTraffic], links: Sequence[LinkProfile]) -> None:
    """Write the page; an earlier one is replaced at once.

    Raises:
        PageError: the file cannot be written.
    """
    write_html(path, page(run, agents, links))


def _subtitle(agents: Sequence[AgentTraffic]) -> str:
    drive_km = sum(agent.drive_km for agent in agents)
    drive_s = sum(agent.drive_s for agent in agents)
    names = sorted({agent.link for agent in agents if agent.link})
    by = f" on {escape(', '.join(names))} links" if names else ""
    vehicles = "1 vehicle" if len(agents) == 1 else f"{len(agents)} vehicles"
    return f"<p>{vehicles}{by}, {drive_km:.2f} km driven in {drive_s / 60:.1f} min of driving</p>"


def _details(title: str, content: str) -> str:
    return f"<details><summary>{title}</summary>{content}</details>"


def _notes(agents: Sequence[AgentTraffic]) -> str:
    return "".join(f'<p class="note">{escape(note)}</p>' for note in notes(tuple(agents)))


def _along(agents: Sequence[AgentTraffic], links: Sequence[LinkProfile]) -> str:
    text = (
        "<p>Payload of each vehicle from the start of its drive, against what each link could have carried until then "
        "(dashed). The scale is logarithmic: a curve that stays below a line leaves that link room.</p>"
    )
    return f'{text}<div class="charts">{curves(agents, links, "down")}{curves(agents, links, "up")}</div>'
