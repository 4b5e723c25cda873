"""What a run cost, and whether 3G, 4G and 5G could have carried it (GND paper, Figure 23)."""

import statistics
from dataclasses import asdict, dataclass
from typing import Any, Final

from fleet_bus.ledger import Direction, LedgerLine
from fleet_bus.ledger_file import AgentLedger, Booking
from fleet_bus.links import LinkProfile
from fleet_bus.pacer import MESSAGE_OVERHEAD_BYTES, Bucket

_SERIES_POINTS: Final = 100


@dataclass(frozen=True, slots=True)
class LinkUse:
    """One direction of one agent's traffic on one link. Sizes include the overhead of each message.

    Attributes:
        link: name of the profile.
        direction: "up" or "down".
        sending_s: time that the link is busy with it, s.
        share: part of what the link could carry during the drive (below Figure 23's line where < 1).
        longest_wait_s: longest time a message takes when all are sent at their place of the drive, s.
    """

    link: str
    direction: Direction
    sending_s: float
    share: float
    longest_wait_s: float


@dataclass(frozen=True, slots=True)
class AgentTraffic:
    """The account of one agent.

    Attributes:
        agent: who.
        drive_km: way driven, km.
        drive_s: time driven, s.
        lines: payload by kind and direction.
        up_bytes: payload bytes from the agent.
        down_bytes: payload bytes to the agent.
        up_wire_bytes: the same on the wire.
        down_wire_bytes: the same on the wire.
        kB_per_km_up: payload per way driven, kB/km (0 where nothing was driven).
        kB_per_km_down: likewise.
        links: use of each link, both directions.
        tile_arrival_s: by link, time from asking for a tile of median size to having it on an idle link, s.
        along: (drive_s, odometer_m, down_bytes, up_bytes) accumulated, at most 100 points of the drive.
        ignored_lines: ledger lines that a crash left unfinished.
    """

    agent: str
    drive_km: float
    drive_s: float
    lines: tuple[LedgerLine, ...]
    up_bytes: int
    down_bytes: int
    up_wire_bytes: int
    down_wire_bytes: int
    kB_per_km_up: float  # noqa: N815 - the unit
    kB_per_km_down: float  # noqa: N815 - the unit
    links: tuple[LinkUse, ...]
    tile_arrival_s: dict[str, float]
    along: tuple[tuple[float, float, int, int], ...]
    ignored_lines: int


def agent_traffic(ledger: AgentLedger, links: tuple[LinkProfile, ...]) -> AgentTraffic:
    """The account of one agent against some links."""
    up_bytes, down_bytes = ledger.total_bytes("up"), ledger.total_bytes("down")
    drive_km = ledger.drive_m / 1000
    return AgentTraffic(
        agent=ledger.agent,
        drive_km=drive_km,
        drive_s=ledger.drive_s,
        lines=ledger.lines(),
        up_bytes=up_bytes,
        down_bytes=down_bytes,
        up_wire_bytes=ledger.wire_up,
        down_wire_bytes=ledger.wire_down,
        kB_per_km_up=_per_km(up_bytes, drive_km),
        kB_per_km_down=_per_km(down_bytes, drive_km),
        links=tuple(link_use(ledger, link, direction) for link in links for direction in ("down", "up")),
        tile_arrival_s={link.name: _tile_arrival_s(ledger.bookings, link) for link in links},
        along=_along(ledger.bookings),
        ignored_lines=ledger.ignored_lines,
    )


def link_use(ledger: AgentLedger, link: LinkProfile, direction: Direction) -> LinkUse:
    """Sends one direction of a ledger over a link, each message at its time of the drive."""
    rate_byte_s = link.rate_byte_s(direction)
    bucket = Bucket(rate_byte_s, link.burst_bytes)
    sent_bytes, longest_wait_s = 0, 0.0
    for booking in ledger.bookings:
        if booking.direction == direction:
            size_bytes = booking.app_bytes + booking.messages * MESSAGE_OVERHEAD_BYTES
            sent_bytes += size_bytes
            arrival_s = bucket.book(booking.drive_s, size_bytes) + link.delay_s
            longest_wait_s = max(longest_wait_s, arrival_s - booking.drive_s)
    sending_s = sent_bytes / rate_byte_s
    share = sending_s / ledger.drive_s if ledger.drive_s > 0 else 0.0
    return LinkUse(link.name, direction, sending_s, share, longest_wait_s)


def as_json(run: str, agents: tuple[AgentTraffic, ...], links: tuple[LinkProfile, ...]) -> dict[str, Any]:
    """The report of a run as plain values."""
    return {
        "run": run,
        "message_overhead_bytes": MESSAGE_OVERHEAD_BYTES,
        "agents": [asdict(agent) for agent in agents],
        "fleet": fleet_totals(agents),
        "links": {link.name: asdict(link) for link in links},
    }


def fleet_totals(agents: tuple[AgentTraffic, ...]) -> dict[str, float]:
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
        "kB_per_km_up": _per_km(up_bytes, drive_km),
        "kB_per_km_down": _per_km(down_bytes, drive_km),
    }


def _per_km(size_bytes: int, drive_km: float) -> float:
    return size_bytes / 1000 / drive_km if drive_km > 0 else 0.0


def _tile_arrival_s(bookings: tuple[Booking, ...], link: LinkProfile) -> float:
    sizes = [b.app_bytes for b in bookings if b.direction == "down" and b.kind in ("tile", "delta") and b.app_bytes]
    if not sizes:
        return 0.0
    asking_s = MESSAGE_OVERHEAD_BYTES / link.rate_byte_s("up") + link.delay_s
    return asking_s + (statistics.median(sizes) + MESSAGE_OVERHEAD_BYTES) / link.rate_byte_s("down") + link.delay_s


def _along(bookings: tuple[Booking, ...]) -> tuple[tuple[float, float, int, int], ...]:
    points, total = [], {"down": 0, "up": 0}
    for booking in bookings:
        total[booking.direction] += booking.app_bytes
        points.append((booking.drive_s, booking.odometer_m, total["down"], total["up"]))
    if len(points) <= _SERIES_POINTS:
        return tuple(points)
    return tuple(points[round(i * (len(points) - 1) / (_SERIES_POINTS - 1))] for i in range(_SERIES_POINTS))
