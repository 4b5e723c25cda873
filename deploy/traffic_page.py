"""The account of a run as one HTML file: no script, nothing from elsewhere, readable on a phone, light and dark."""

import contextlib
import os
from collections.abc import Sequence
from html import escape
from pathlib import Path

from gnd.deploy.errors import PageError
from gnd.deploy.traffic_page_chart import curves
from gnd.deploy.traffic_page_map import tile_map
from gnd.deploy.traffic_page_style import STYLE
from gnd.deploy.traffic_page_tables import agents_table, arrivals_text, cards, kinds_table, links_table, sources
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.traffic import AgentTraffic, fleet_tiles
from gnd.fleet_bus.traffic_table import notes

_HOW = """<p>Payload is what the messages themselves hold. On the wire are the bytes that the kernel counted on each
vehicle's connection (TCP_INFO: stream and packet headers). They are shared out to the last one: each message has its
payload, key, envelope and packets; <b>acks</b> are packets without data (<b>tile acks</b> those that answer tiles, by
the share of packets), <b>resent</b> is what was lost and sent again, <b>opening</b> and <b>closing</b> are those of
connections, <b>keep-alives</b> what a silent session says to live on, and <b>session</b> is the rest: declarations,
answers that nobody waited for. A kind without messages of its own came as shares of others, as many tiles come in one
answer.</p>"""
_HEAD = """<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">"""


def page(run: str, agents: Sequence[AgentTraffic], links: Sequence[LinkProfile]) -> str:
    """The page of a run as HTML.

    Args:
        run: its name.
        agents: the account of each agent, at least one.
        links: profiles to compare with.
    """
    title = f"Traffic of {escape(run)}"
    body = "\n".join(
        (
            f"<header><h1>{title}</h1>{_subtitle(agents)}</header>",
            cards(agents),
            _section(
                "By kind of message", kinds_table(agents) + _notes(agents) + _details("How bytes are counted", _HOW)
            ),
            _section("Along the drive", _along(agents, links)),
            _section(
                "On mobile links", links_table(agents, links) + _details("Where the figures come from", sources(links))
            ),
            _section("Time that a tile needs to arrive", arrivals_text(agents)),
            _section("Bytes by tile", tile_map(fleet_tiles(agents))),
            _section("By vehicle", agents_table(agents)),
        )
    )
    return (
        f'<!doctype html>\n<html lang="en"><head>{_HEAD}<title>{title}</title><style>{STYLE}</style></head>\n'
        f"<body><main>\n{body}\n</main></body></html>\n"
    )


def write_page(path: Path, run: str, agents: Sequence[AgentTraffic], links: Sequence[LinkProfile]) -> None:
    """Writes the page; an earlier one is replaced at once.

    Raises:
        PageError: the file cannot be written.
    """
    if path.is_dir():
        raise PageError(f"cannot write the page {path}: that is a folder, name a file in it")
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        partial.write_text(page(run, agents, links), encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):  # where nothing can be written nothing is left
            partial.unlink()
        raise PageError(f"cannot write the page {path}: {error.strerror}") from error


def _subtitle(agents: Sequence[AgentTraffic]) -> str:
    drive_km = sum(agent.drive_km for agent in agents)
    drive_s = sum(agent.drive_s for agent in agents)
    names = sorted({agent.link for agent in agents if agent.link})
    by = f" on {escape(', '.join(names))} links" if names else ""
    vehicles = "1 vehicle" if len(agents) == 1 else f"{len(agents)} vehicles"
    return f"<p>{vehicles}{by}, {drive_km:.2f} km driven in {drive_s / 60:.1f} min of driving</p>"


def _section(title: str, content: str) -> str:
    return f"<section><h2>{title}</h2>\n{content}</section>"


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
