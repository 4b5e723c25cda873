"""Curves along the drive against the lines of mobile links, as in Figure 23 of the GND paper."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

from gnd.deploy.live_traffic import size_text
from gnd.fleet_bus.ledger import Direction
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.traffic import AgentTraffic

_WIDTH, _HEIGHT = 460, 330
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 40, 10, 42
_LINK_POINTS: Final = 40
_COLOURS: Final = 5
_X_TICKS: Final = 5
_SMALLEST_PART: Final = 100
_LABEL_PX: Final = 15
_NAMES: Final = {"down": "Download", "up": "Upload"}


@dataclass(frozen=True, slots=True)
class Axes:
    """Time of the drive (linear, s) and size (logarithmic, bytes) to places in the drawing.

    Attributes:
        end_s: longest drive, s.
        low: smallest decade shown, as a power of ten.
        high: largest decade shown.
    """

    end_s: float
    low: int
    high: int

    def x(self, t_s: float) -> float:
        """Place of a time."""
        return _LEFT + (_WIDTH - _LEFT - _RIGHT) * min(max(t_s / self.end_s, 0.0), 1.0)

    def y(self, size_bytes: float) -> float:
        """Place of a size; what is below the lowest decade lies on the axis."""
        decade = min(max(math.log10(max(size_bytes, 1e-9)), self.low), self.high)
        return _HEIGHT - _BOTTOM - (_HEIGHT - _TOP - _BOTTOM) * (decade - self.low) / (self.high - self.low)


def curves(agents: Sequence[AgentTraffic], links: Sequence[LinkProfile], direction: Direction) -> str:
    """A figure of one direction: a curve an agent, a dashed line a link with limits."""
    limited = [link for link in links if math.isfinite(link.rate_byte_s(direction))]
    axes = _axes(agents, limited, direction)
    name = _NAMES[direction]
    total = sum(_size(agent, direction) for agent in agents)
    parts = [*_grid(axes), *_links(axes, limited, direction), *_agents(axes, agents, direction)]
    label = f"{name} of each vehicle along its drive against {', '.join(link.name for link in limited) or 'no link'}"
    return (
        f"<figure><figcaption>{name}: {size_text(total)} in all</figcaption>"
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{escape(label)}">{"".join(parts)}</svg></figure>'
    )


def _size(agent: AgentTraffic, direction: Direction) -> int:
    return agent.down_bytes if direction == "down" else agent.up_bytes


def _axes(agents: Sequence[AgentTraffic], links: Sequence[LinkProfile], direction: Direction) -> Axes:
    end_s = max((agent.drive_s for agent in agents), default=0.0) or 1.0
    sizes = [float(_size(agent, direction)) for agent in agents if _size(agent, direction) > 0] or [1000.0]
    capacities = [link.rate_byte_s(direction) * end_s for link in links]
    low = math.floor(math.log10(max(min(sizes) / _SMALLEST_PART, 1.0)))
    high = math.ceil(math.log10(max(*sizes, *capacities, 10.0 ** (low + 1))))
    return Axes(end_s, low, max(high, low + 1))


def _points(agent: AgentTraffic, direction: Direction) -> list[tuple[float, int]]:
    return [(t_s, down if direction == "down" else up) for t_s, _, down, up in agent.along]


def _grid(axes: Axes) -> Iterator[str]:
    step = max(1, round((axes.high - axes.low) / 8))
    for decade in range(axes.low, axes.high + 1, step):
        y = axes.y(10.0**decade)
        yield f'<path class="grid" d="M{_LEFT} {y:.1f}H{_WIDTH - _RIGHT}"/>'
        yield f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{_decade_text(decade)}</text>'
    bottom = _HEIGHT - _BOTTOM + 18
    for t_s in time_ticks(axes.end_s):
        yield f'<text x="{axes.x(t_s):.1f}" y="{bottom}" text-anchor="middle">{t_s:g}</text>'
    middle = (_LEFT + _WIDTH - _RIGHT) / 2
    yield f'<text x="{middle:.0f}" y="{_HEIGHT - 5}" text-anchor="middle">time of the drive, s</text>'


def time_ticks(end_s: float) -> list[float]:
    """Round times from 0 to at most the end of the axis: steps of 1, 2 or 5 times a power of ten, about five."""
    decade = 10.0 ** math.floor(math.log10(end_s / _X_TICKS))
    step = next(decade * factor for factor in (1, 2, 5, 10) if decade * factor * _X_TICKS >= end_s * (1 - 1e-9))
    return [round(step * number, 6) for number in range(int(end_s / step + 1e-9) + 1)]


def _decade_text(decade: int) -> str:
    """Ten to that power as a size: 1 B, 10 kB, 1 MB for 0, 4, 6."""
    unit = min(max(decade, 0) // 3, 4)
    return f"{10 ** (decade - 3 * unit):g} {('B', 'kB', 'MB', 'GB', 'TB')[unit]}"


def _links(axes: Axes, links: Sequence[LinkProfile], direction: Direction) -> Iterator[str]:
    ends = [axes.y(link.rate_byte_s(direction) * axes.end_s) for link in links]
    for number, (link, label_y) in enumerate(zip(links, apart(ends, _LABEL_PX), strict=True)):
        colour, title = f"var(--l{number % _COLOURS})", _link_title(link, direction)
        path = _link_path(axes, link.rate_byte_s(direction))
        yield f'<path class="link" style="stroke:{colour}" d="M{path}"><title>{title}</title></path>'
        place = f'x="{_WIDTH - _RIGHT + 5}" y="{label_y + 4:.1f}"'
        yield f'<text {place} style="fill:{colour};font-weight:600">{escape(link.name)}</text>'


def _link_path(axes: Axes, rate_byte_s: float) -> str:
    """Points evenly spaced on the logarithmic scale, from where the line enters the drawing."""
    first_s = min(10.0**axes.low / rate_byte_s, axes.end_s)
    times_s = [first_s * (axes.end_s / first_s) ** (k / _LINK_POINTS) for k in range(_LINK_POINTS + 1)]
    return "L".join(f"{axes.x(t_s):.1f} {axes.y(rate_byte_s * t_s):.1f}" for t_s in times_s)


def apart(places: Sequence[float], least: float) -> list[float]:
    """The places, in their order, moved upwards (to smaller values) where two are nearer than `least`."""
    result = list(places)
    order = sorted(range(len(result)), key=lambda index: -result[index])
    for lower, upper in itertools.pairwise(order):
        result[upper] = min(result[upper], result[lower] - least)
    return result


def _link_title(link: LinkProfile, direction: Direction) -> str:
    return escape(f"{link.name}: {link.rate_byte_s(direction) * 8 / 1e6:g} Mbit/s")


def _agents(axes: Axes, agents: Sequence[AgentTraffic], direction: Direction) -> Iterator[str]:
    for agent in agents:
        points = [(t_s, size) for t_s, size in _points(agent, direction) if size > 0]
        if not points:
            continue
        steps = "".join(f"H{axes.x(t_s):.1f}V{axes.y(size):.1f}" for t_s, size in points[1:])
        start = f"M{axes.x(points[0][0]):.1f} {_HEIGHT - _BOTTOM}V{axes.y(points[0][1]):.1f}"
        title = escape(f"{agent.agent}: {size_text(_size(agent, direction))} over {agent.drive_km:.2f} km")
        end = f"H{axes.x(agent.drive_s):.1f}"
        yield f'<path class="curve {direction}" d="{start}{steps}{end}"><title>{title}</title></path>'
