"""What 3G, 4G and 5G make of an agent's traffic, and how long tiles took to arrive."""

import statistics
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from gnd.fleet_bus.ledger import Direction
from gnd.fleet_bus.ledger_file import AgentLedger, Booking
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.pacer import MESSAGE_OVERHEAD_BYTES, Bucket

_NO_CONTENT_BYTES: Final = 40
"""An answer about a tile that is no longer than this says "unchanged" or "there is none": it brought no tile."""
_P95: Final = 0.95


@dataclass(frozen=True, slots=True)
class LinkUse:
    """One direction of one agent's traffic on one link.

    Attributes:
        link: name of the profile.
        direction: "up" or "down".
        sending_s: time that the link is busy with what was on the wire, s.
        share: part of what the link could carry during the drive (below Figure 23's line where < 1).
        longest_wait_s: longest time a message takes when all are sent at their place of the drive, each with
            `MESSAGE_OVERHEAD_BYTES`, s.
    """

    link: str
    direction: Direction
    sending_s: float
    share: float
    longest_wait_s: float


@dataclass(frozen=True, slots=True)
class Arrivals:
    """How long it took from asking for a tile (or its delta) to having it, as the run has seen it.

    Attributes:
        tiles: how many arrived.
        median_s: by the clock, s.
        p95_s: 95 % quantile, s.
        longest_s: the longest, s.
    """

    tiles: int
    median_s: float
    p95_s: float
    longest_s: float


def link_use(ledger: AgentLedger, link: LinkProfile, direction: Direction, wire_bytes: int) -> LinkUse:
    """Sends one direction of a ledger over a link: `wire_bytes` in all, each message at its time of the drive."""
    rate_byte_s = link.rate_byte_s(direction)
    bucket = Bucket(rate_byte_s, link.burst_bytes)
    longest_wait_s = 0.0
    for booking in ledger.bookings:
        if booking.direction == direction:
            size_bytes = booking.app_bytes + booking.messages * MESSAGE_OVERHEAD_BYTES
            arrival_s = bucket.book(booking.drive_s, size_bytes) + link.delay_s
            longest_wait_s = max(longest_wait_s, arrival_s - booking.drive_s)
    sending_s = wire_bytes / rate_byte_s
    share = sending_s / ledger.drive_s if ledger.drive_s > 0 else 0.0
    return LinkUse(link.name, direction, sending_s, share, longest_wait_s)


def brings_tile(booking: Booking) -> bool:
    """Whether this is a tile or a delta that came, rather than a word about one."""
    if booking.direction != "down" or booking.tile is None or booking.kind not in ("tile", "delta"):
        return False
    is_share = booking.messages == 0  # only bodies are shares of an answer about many tiles
    return is_share or booking.kind == "delta" or booking.app_bytes > _NO_CONTENT_BYTES


def tile_arrival_s(bookings: Iterable[Booking], link: LinkProfile) -> float | None:
    """Time from asking for a tile of median size to having it, on an idle link, s; None where no tile came."""
    sizes = [booking.app_bytes for booking in bookings if brings_tile(booking)]
    if not sizes:
        return None
    asking_s = MESSAGE_OVERHEAD_BYTES / link.rate_byte_s("up") + link.delay_s
    return asking_s + (statistics.median(sizes) + MESSAGE_OVERHEAD_BYTES) / link.rate_byte_s("down") + link.delay_s


def measured_arrivals(bookings: Iterable[Booking]) -> Arrivals | None:
    """Times of the tiles that came in answer to a request; None where the ledger has none."""
    took_s = sorted(b.took_s for b in bookings if b.took_s is not None and brings_tile(b))
    if not took_s:
        return None
    p95_s = took_s[round(_P95 * (len(took_s) - 1))]
    return Arrivals(len(took_s), statistics.median(took_s), p95_s, took_s[-1])
