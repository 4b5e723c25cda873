"""The figures of the traffic page: cards, tables, and where the links' figures come from."""

import itertools
import math
from collections.abc import Iterable, Sequence
from html import escape

from gnd.deploy.html_page import card_list
from gnd.deploy.live_traffic import size_text
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.traffic import AgentTraffic, KindTraffic, fleet_lines, fleet_totals, is_of_tiles, kind_text, per_km

PAPER_UP_KB_PER_KM = 56.32
"""Upload of the GND paper, kB/km (section 7.5 and abstract)."""


def cards(agents: Sequence[AgentTraffic]) -> str:
    """The totals, large: all bytes on the wire first."""
    total = fleet_totals(agents)
    down, up = total["down_wire_bytes"], total["up_wire_bytes"]
    payload = total["down_bytes"] + total["up_bytes"]
    tiles = sum(line.wire_bytes for line in fleet_lines(agents) if is_of_tiles(line))
    changes = sum(line.app_bytes for line in fleet_lines(agents) if (line.kind, line.direction) == ("change", "up"))
    extra = f"{100 * (down + up - payload) / (down + up):.1f} %" if down + up else "–"
    items = (
        (_rate(down + up, total["drive_km"]), f"all bytes on the wire ({down + up:,} B)"),
        (_rate(tiles, total["drive_km"]), "of it tiles, asking included"),
        (_rate(down + up - tiles, total["drive_km"]), "of it all else, keep-alives and telemetry included"),
        (_rate(total["down_bytes"], total["drive_km"]), "down, payload"),
        (_rate(total["up_bytes"], total["drive_km"]), "up, payload"),
        (_rate(changes, total["drive_km"]), f"of it map changes (GND paper: {PAPER_UP_KB_PER_KM} kB/km)"),
        (size_text(down), "down on the wire"),
        (size_text(up), "up on the wire"),
        (extra, "of the wire is not payload"),
    )
    return card_list(items)


def kinds_table(agents: Sequence[AgentTraffic]) -> str:
    """All agents together: a row a kind and direction, with a bar of payload and what the wire adds."""
    lines = fleet_lines(agents)
    drive_km = sum(agent.drive_km for agent in agents)
    most = max((line.wire_bytes for line in lines), default=0) or 1
    rows = [_kind_row(line, drive_km, most) for line in lines]
    key = (
        '<p class="key"><i class="down"></i>payload down<i class="up"></i>payload up'
        '<i class="extra"></i>what the wire adds</p>'
    )
    head = _head(("kind", "way"), ("messages", "kB", "kB/km", "wire kB", "wire kB/km", ""))
    return key + _table(head, [*rows, *_sums(agents)])


def _kind_row(line: KindTraffic, drive_km: float, most: int) -> str:
    payload, extra = 100 * line.app_bytes / most, 100 * max(line.wire_bytes - line.app_bytes, 0) / most
    bar = f'<td class="bar"><i class="{line.direction}" style="width:{payload:.2f}%"></i>'
    bar += f'<i class="extra" style="width:{extra:.2f}%"></i></td>'
    style = "" if line.app_bytes or line.messages else ' class="rest"'
    return f"<tr{style}>{_kind_cells(line, drive_km)}{bar}</tr>"


def _kind_cells(line: KindTraffic, drive_km: float) -> str:
    is_rest = not (line.app_bytes or line.messages)
    numbers = (
        str(line.messages) if line.messages else "–",
        "–" if is_rest else _kb(line.app_bytes),
        "–" if is_rest else _per_km(line.app_bytes, drive_km),
        _kb(line.wire_bytes),
        _per_km(line.wire_bytes, drive_km),
    )
    return f'<td class="t">{escape(kind_text(line.kind))}</td><td class="t">{line.direction}</td>' + _cells(numbers)


def _sums(agents: Sequence[AgentTraffic]) -> Iterable[str]:
    total = fleet_totals(agents)
    for way in ("down", "up"):
        payload, wire = total[f"{way}_bytes"], total[f"{way}_wire_bytes"]
        per = (_per_km(payload, total["drive_km"]), _per_km(wire, total["drive_km"]))
        messages = sum(line.messages for line in fleet_lines(agents) if line.direction == way)
        cells = _cells((str(messages), _kb(payload), per[0], _kb(wire), per[1], ""))
        yield f'<tr class="sum"><td class="t">all</td><td class="t">{way}</td>{cells}</tr>'


def links_table(agents: Sequence[AgentTraffic], links: Sequence[LinkProfile]) -> str:
    """A row a link: the vehicle that takes the most of it, and how long a tile takes on it."""
    head = _head(
        ("link",),
        ("down Mbit/s", "up Mbit/s", "round trip ms", "most of down", "most of up", "longest wait s", "a tile after s"),
    )
    rows = [_link_row(agents, link) for link in links]
    text = (
        '<p class="note">Most of down and up: of the vehicle that takes the largest part of what the link could carry '
        "during its drive, by the bytes on the wire. Longest wait: of a message, each sent at its place of the drive. "
        "A tile: of median size, asked for and received on the idle link.</p>"
    )
    return _table(head, rows) + text


def _link_row(agents: Sequence[AgentTraffic], link: LinkProfile) -> str:
    uses = [use for agent in agents for use in agent.links if use.link == link.name]
    shares = [max((u.share for u in uses if u.direction == way), default=0.0) for way in ("down", "up")]
    tiles_s = [s for agent in agents if (s := agent.tile_arrival_s.get(link.name)) is not None]
    numbers = (
        _mbit(link.down_bit_s),
        _mbit(link.up_bit_s),
        f"{2 * link.delay_ms:.1f}",
        *(f"{100 * share:.3g} %" for share in shares),
        f"{max((use.longest_wait_s for use in uses), default=0.0):.3f}",
        f"{max(tiles_s):.3f}" if tiles_s else "–",
    )
    return f'<tr><td class="t">{escape(link.name)}</td>{_cells(numbers)}</tr>'


def sources(links: Sequence[LinkProfile]) -> str:
    """Publisher and year of each figure of the profiles."""
    return "<dl>" + "".join(f"<dt>{escape(link.name)}</dt>{_source(link)}" for link in links) + "</dl>"


def _source(link: LinkProfile) -> str:
    told = (
        ("Rates", link.rate_source),
        ("Delay", link.delay_source),
        ("Loss", link.loss_source),
        ("Jitter", link.jitter_source),
    )
    lines = [f"<dd>{what}: {escape(text)}</dd>" for what, text in told if text]
    return "".join(lines) or "<dd>The profile names no source.</dd>"


def arrivals_text(agents: Sequence[AgentTraffic]) -> str:
    """What the run itself measured, a row a vehicle."""
    rows = [
        f'<tr><td class="t">{escape(agent.agent)}</td><td class="t">{escape(agent.link) or "–"}</td>'
        + _cells((str(a.tiles), f"{a.median_s:.3f}", f"{a.p95_s:.3f}", f"{a.longest_s:.3f}"))
        + "</tr>"
        for agent in agents
        if (a := agent.arrivals) is not None
    ]
    if not rows:
        return (
            '<p class="note">The ledgers of this run do not say how long answers took (version 1), or no tile came.</p>'
        )
    head = _head(("vehicle", "link"), ("tiles", "median s", "95 % s", "longest s"))
    return (
        _table(head, rows)
        + '<p class="note">By the clock, from asking to having; a tile in a batch has the time of the batch.</p>'
    )


def agents_table(agents: Sequence[AgentTraffic]) -> str:
    """A row a vehicle, and the kinds of each behind a click."""
    head = _head(("vehicle",), ("km", "s", "down kB", "down kB/km", "up kB", "up kB/km", "wire down kB", "wire up kB"))
    return _table(head, [_agent_row(agent) for agent in agents]) + "".join(_agent_kinds(agent) for agent in agents)


def _agent_row(agent: AgentTraffic) -> str:
    numbers = (
        f"{agent.drive_km:.3f}",
        f"{agent.drive_s:.0f}",
        _kb(agent.down_bytes),
        _per_km(agent.down_bytes, agent.drive_km),
        _kb(agent.up_bytes),
        _per_km(agent.up_bytes, agent.drive_km),
        _kb(agent.down_wire_bytes),
        _kb(agent.up_wire_bytes),
    )
    return f'<tr><td class="t">{escape(agent.agent)}</td>{_cells(numbers)}</tr>'


def _agent_kinds(agent: AgentTraffic) -> str:
    head = _head(("kind", "way"), ("messages", "kB", "kB/km", "wire kB", "wire kB/km"))
    table = _table(head, [f"<tr>{_kind_cells(line, agent.drive_km)}</tr>" for line in agent.lines])
    return f"<details><summary>{escape(agent.agent)} by kind and link</summary>{table}{_agent_links(agent)}</details>"


def _agent_links(agent: AgentTraffic) -> str:
    rows = []
    for down, up in itertools.pairwise(agent.links):
        if (down.direction, up.direction, down.link) == ("down", "up", up.link):
            wait_s, tile_s = max(down.longest_wait_s, up.longest_wait_s), agent.tile_arrival_s.get(down.link)
            shares = (f"{100 * down.share:.3g} %", f"{100 * up.share:.3g} %")
            numbers = (*shares, f"{wait_s:.3f}", "–" if tile_s is None else f"{tile_s:.3f}")
            rows.append(f'<tr><td class="t">{escape(down.link)}</td>{_cells(numbers)}</tr>')
    return _table(_head(("link",), ("of down", "of up", "longest wait s", "a tile after s")), rows)


def _head(texts: Sequence[str], numbers: Sequence[str]) -> str:
    left = "".join(f'<th class="t">{text}</th>' for text in texts)
    return f"<tr>{left}{''.join(f'<th>{text}</th>' for text in numbers)}</tr>"


def _table(head: str, rows: Iterable[str]) -> str:
    return f'<div class="wide"><table><thead>{head}</thead><tbody>{"".join(rows)}</tbody></table></div>'


def _cells(numbers: Iterable[str]) -> str:
    return "".join(f"<td>{number}</td>" for number in numbers)


def _kb(size_bytes: float) -> str:
    return f"{size_bytes / 1000:,.3f}"


def _per_km(size_bytes: float, drive_km: float) -> str:
    if drive_km <= 0:
        return "–"
    rate = per_km(size_bytes, drive_km)
    if rate >= 1000:
        return f"{rate:,.0f}"
    return f"{rate:.1f}" if rate >= 10 else f"{rate:.2f}"


def _rate(size_bytes: float, drive_km: float) -> str:
    return f"{_per_km(size_bytes, drive_km)} kB/km" if drive_km > 0 else size_text(size_bytes)


def _mbit(rate_bit_s: float) -> str:
    return "no limit" if math.isinf(rate_bit_s) else f"{rate_bit_s / 1e6:g}"
