"""What a run cost, and whether 3G, 4G and 5G could have carried it (GND paper, Figure 23)."""

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from gnd.fleet_bus.ledger import Direction
from gnd.fleet_bus.ledger_file import AgentLedger, Booking
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.pacer import MESSAGE_OVERHEAD_BYTES
from gnd.fleet_bus.traffic_links import Arrivals, LinkUse, link_use, measured_arrivals, tile_arrival_s
from gnd.fleet_bus.traffic_wire import RESIDUES, TILE_KINDS, WireAccount, wire_account

DEFAULT_LINKS: Final = ("3g", "4g", "5g")
_TILES: Final = (*TILE_KINDS, "tile acks")
_KIND_WORDS: Final = {"ack": "acknowledgement", "acks": "TCP acks", "tile acks": "TCP acks of tiles"}
_SERIES_POINTS: Final = 100


@dataclass(frozen=True, slots=True)
class KindTraffic:
    """One line of the account: a kind of message, or what the connection itself cost (`RESIDUES`: no messages).

    Attributes:
        kind: ledger kind, or one of `RESIDUES`.
        direction: "up" or "down".
        messages: how many; 0 where all came as shares of messages of another kind.
        app_bytes: payload, bytes.
        wire_bytes: the same on the wire; the lines of a direction add up to its total.
    """

    kind: str
    direction: Direction
    messages: int
    app_bytes: int
    wire_bytes: int


@dataclass(frozen=True, slots=True)
class TileTraffic:
    """What messages about one tile came to; sizes in bytes.

    Attributes:
        tile: its path.
        down_bytes: payload to the agents.
        up_bytes: payload from the agents.
        down_wire_bytes: likewise, on the wire.
        up_wire_bytes: likewise, on the wire.
    """

    tile: str
    down_bytes: int
    up_bytes: int
    down_wire_bytes: int
    up_wire_bytes: int


@dataclass(frozen=True, slots=True)
class AgentTraffic:
    """The account of one agent.

    Attributes:
        agent: who.
        link: profile that its messages travelled by; "" where the ledger does not say.
        drive_km: way driven, km.
        drive_s: time driven, s.
        lines: by kind and direction.
        tiles: by tile.
        up_bytes: payload bytes from the agent.
        down_bytes: payload bytes to the agent.
        up_wire_bytes: the same on the wire.
        down_wire_bytes: the same on the wire.
        estimated_wire_bytes: of both, what no reading of TCP_INFO covers.
        kB_per_km_up: payload per way driven, kB/km (0 where nothing was driven).
        kB_per_km_down: likewise.
        links: use of each link, both directions.
        tile_arrival_s: by link, time from asking for a tile of median size to having it on an idle link, s; None
            where no tile came.
        arrivals: how long tiles took in the run itself.
        along: (drive_s, odometer_m, down_bytes, up_bytes) accumulated, at most 100 points of the drive.
        ignored_lines: ledger lines that are unfinished or damaged.
    """

    agent: str
    link: str
    drive_km: float
    drive_s: float
    lines: tuple[KindTraffic, ...]
    tiles: tuple[TileTraffic, ...]
    up_bytes: int
    down_bytes: int
    up_wire_bytes: int
    down_wire_bytes: int
    estimated_wire_bytes: int
    kB_per_km_up: float  # noqa: N815 - the unit
    kB_per_km_down: float  # noqa: N815 - the unit
    links: tuple[LinkUse, ...]
    tile_arrival_s: dict[str, float | None]
    arrivals: Arrivals | None
    along: tuple[tuple[float, float, int, int], ...]
    ignored_lines: int


def kind_text(kind: str) -> str:
    """A kind of bytes for people: the acknowledgement of a report is no "ack" beside the "acks" of the connection."""
    return _KIND_WORDS.get(kind, kind)


def agent_traffic(ledger: AgentLedger, links: tuple[LinkProfile, ...]) -> AgentTraffic:
    """The account of one agent against some links."""
    up, down = wire_account(ledger, "up"), wire_account(ledger, "down")
    up_bytes, down_bytes = ledger.total_bytes("up"), ledger.total_bytes("down")
    drive_km = ledger.drive_m / 1000
    return AgentTraffic(
        agent=ledger.agent,
        link=ledger.link.name if ledger.link is not None else "",
        drive_km=drive_km,
        drive_s=ledger.drive_s,
        lines=_lines(ledger, (up, down)),
        tiles=_tiles(ledger.bookings, up, down),
        up_bytes=up_bytes,
        down_bytes=down_bytes,
        up_wire_bytes=up.total,
        down_wire_bytes=down.total,
        estimated_wire_bytes=up.estimated + down.estimated,
        kB_per_km_up=per_km(up_bytes, drive_km),
        kB_per_km_down=per_km(down_bytes, drive_km),
        links=tuple(link_use(ledger, link, way.direction, way.total) for link in links for way in (down, up)),
        tile_arrival_s={link.name: tile_arrival_s(ledger.bookings, link) for link in links},
        arrivals=measured_arrivals(ledger.bookings),
        along=_along(ledger.bookings),
        ignored_lines=ledger.ignored_lines,
    )


def as_json(run: str, agents: tuple[AgentTraffic, ...], links: tuple[LinkProfile, ...]) -> dict[str, Any]:
    """The report of a run as plain values."""
    report = {
        "run": run,
        "message_overhead_bytes": MESSAGE_OVERHEAD_BYTES,
        "agents": [asdict(agent) for agent in agents],
        "fleet": fleet_totals(agents) | {"lines": [asdict(line) for line in fleet_lines(agents)]},
        "tiles": [asdict(tile) for tile in fleet_tiles(agents)],
        "links": {link.name: asdict(link) for link in links},
    }
    result: dict[str, Any] = _finite(report)
    return result


def _finite(value: Any) -> Any:
    """The value with null for what JSON has no number for: the rate of a link without limits."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def fleet_totals(agents: Sequence[AgentTraffic]) -> dict[str, Any]:
    """Sums over all agents; per km over the km of all."""
    drive_km = sum(agent.drive_km for agent in agents)
    up_bytes, down_bytes = sum(a.up_bytes for a in agents), sum(a.down_bytes for a in agents)
    return {
        "agents": len(agents),
        "drive_km": drive_km,
        "up_bytes": up_bytes,
        "down_bytes": down_bytes,
        "up_wire_bytes": sum(agent.up_wire_bytes for agent in agents),
        "down_wire_bytes": sum(agent.down_wire_bytes for agent in agents),
        "estimated_wire_bytes": sum(agent.estimated_wire_bytes for agent in agents),
        "kB_per_km_up": per_km(up_bytes, drive_km),
        "kB_per_km_down": per_km(down_bytes, drive_km),
        **headline(agents),
    }


def is_of_tiles(line: KindTraffic) -> bool:
    """Whether a line is the map itself: questions about tiles, what they brought, and its acknowledgements."""
    return line.kind in _TILES


def headline(agents: Sequence[AgentTraffic]) -> dict[str, float]:
    """All bytes on the wire, up and down together, a km: in all, tiles apart, all else together; then of this else
    upload and download, and what keep-alives and telemetry are of it.
    """
    drive_km = sum(agent.drive_km for agent in agents)
    lines = fleet_lines(agents)

    def rate(wanted: Callable[[KindTraffic], bool]) -> float:
        return per_km(sum(line.wire_bytes for line in lines if wanted(line)), drive_km)

    return {
        "all_kB_per_km": rate(lambda _: True),
        "tiles_kB_per_km": rate(is_of_tiles),
        "other_kB_per_km": rate(lambda line: not is_of_tiles(line)),
        "other_up_kB_per_km": rate(lambda line: not is_of_tiles(line) and line.direction == "up"),
        "other_down_kB_per_km": rate(lambda line: not is_of_tiles(line) and line.direction == "down"),
        "keep_alives_kB_per_km": rate(lambda line: line.kind == "keep-alives"),
        "telemetry_kB_per_km": rate(lambda line: line.kind == "telemetry"),
    }


def fleet_lines(agents: Sequence[AgentTraffic]) -> tuple[KindTraffic, ...]:
    """The lines of all agents added up: download first, the connection's own lines last."""
    place = {name: number for number, name in enumerate(RESIDUES, start=1)}
    sums: dict[tuple[Direction, int, str], list[int]] = defaultdict(lambda: [0, 0, 0])
    for line in (line for agent in agents for line in agent.lines):
        total = sums[line.direction, place.get(line.kind, 0), line.kind]
        total[0] += line.messages
        total[1] += line.app_bytes
        total[2] += line.wire_bytes
    return tuple(KindTraffic(kind, way, *total) for (way, _, kind), total in sorted(sums.items()))


def fleet_tiles(agents: Sequence[AgentTraffic]) -> tuple[TileTraffic, ...]:
    """The tiles of all agents added up, sorted by path."""
    sums: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0, 0])
    for tile in (tile for agent in agents for tile in agent.tiles):
        sizes = (tile.down_bytes, tile.up_bytes, tile.down_wire_bytes, tile.up_wire_bytes)
        sums[tile.tile] = [have + size for have, size in zip(sums[tile.tile], sizes, strict=True)]
    return tuple(TileTraffic(path, *sums[path]) for path in sorted(sums))


def per_km(size_bytes: float, drive_km: float) -> float:
    """Size over way, kB/km; 0 where nothing was driven."""
    return size_bytes / 1000 / drive_km if drive_km > 0 else 0.0


def _lines(ledger: AgentLedger, accounts: tuple[WireAccount, WireAccount]) -> tuple[KindTraffic, ...]:
    wire = {account.direction: account for account in accounts}
    messages = [
        KindTraffic(line.kind, line.direction, line.messages, line.app_bytes, wire[line.direction].by_kind[line.kind])
        for line in ledger.lines()
    ]
    rest = [KindTraffic(name, account.direction, 0, 0, account.rest[name]) for account in accounts for name in RESIDUES]
    return (*messages, *(line for line in rest if line.wire_bytes))


def _tiles(bookings: tuple[Booking, ...], up: WireAccount, down: WireAccount) -> tuple[TileTraffic, ...]:
    payload: dict[tuple[str, Direction], int] = defaultdict(int)
    for booking in bookings:
        if booking.tile is not None:
            payload[booking.tile, booking.direction] += booking.app_bytes
    return tuple(
        TileTraffic(
            tile, payload[tile, "down"], payload[tile, "up"], down.by_tile.get(tile, 0), up.by_tile.get(tile, 0)
        )
        for tile in sorted({tile for tile, _ in payload})
    )


def _along(bookings: tuple[Booking, ...]) -> tuple[tuple[float, float, int, int], ...]:
    points, total = [], {"down": 0, "up": 0}
    for booking in bookings:
        total[booking.direction] += booking.app_bytes
        points.append((booking.drive_s, booking.odometer_m, total["down"], total["up"]))
    if len(points) <= _SERIES_POINTS:
        return tuple(points)
    return tuple(points[round(i * (len(points) - 1) / (_SERIES_POINTS - 1))] for i in range(_SERIES_POINTS))
