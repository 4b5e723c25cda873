"""What messages cost on the wire: the bytes that TCP_INFO counted, shared out to the last one.

Measured is only the total of each connection. It is laid out so:

    measured = payloads + heads of messages + acks + resent + opening + closing + keep-alives + session

Payloads are exact. A message's head is its key and envelope (exact but for some bytes) and its part of the headers of
packets; a ledger of version 1 does not know keys and takes `MESSAGE_OVERHEAD_BYTES`. Acknowledgements (packets without
data) and what was sent again are counted by the kernel; acknowledgements are shared out by the packets that they
answer, so that those of tiles stand with the tiles. The opening is what had passed when the connection was new,
closing what passed since the session was being closed, keep-alives are known by their size (`fleet_bus.wire`); a ledger
of version 2 knows none of them, there they are in the rest. What is left is the session itself: declarations, answers
that nobody waited for. Where messages travel
together in packets less is left than their heads come to; then they share it.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from gnd.fleet_bus.ledger import Direction
from gnd.fleet_bus.ledger_file import AgentLedger, Booking
from gnd.fleet_bus.pacer import MESSAGE_OVERHEAD_BYTES
from gnd.fleet_bus.wire import KEEP_ALIVE_BYTES, WireBytes

RESIDUES: Final = ("tile acks", "acks", "resent", "opening", "closing", "keep-alives", "session")
"""Lines of the account beside the kinds of messages."""
TILE_KINDS: Final = ("tile", "delta")
"""Questions about tiles and what they brought: the map itself. All else is what a vehicle costs that holds its map."""


@dataclass(frozen=True, slots=True)
class WireAccount:
    """One direction of one agent's traffic on the wire; all sizes in bytes.

    Attributes:
        direction: "up" or "down".
        measured: what TCP_INFO counted.
        estimated: what no reading covers: sent after the last one before a kill, or the system counts nothing.
        by_kind: wire bytes of the messages of each kind.
        by_tile: wire bytes of the messages, or shares of them, about each tile.
        rest: the lines of `RESIDUES`: packets without data, those that answer tiles apart; data sent again; handshakes
            of connections; their closing; keep-alives; declarations and what else the session carries.
    """

    direction: Direction
    measured: int
    estimated: int
    by_kind: dict[str, int]
    by_tile: dict[str, int]
    rest: dict[str, int]

    @property
    def total(self) -> int:
        """Sum of all lines: `measured` + `estimated`."""
        return sum(self.by_kind.values()) + sum(self.rest.values())


def wire_account(ledger: AgentLedger, direction: Direction) -> WireAccount:
    """Shares out what was measured in one direction over all sessions of an agent."""
    by_session: dict[str, list[Booking]] = {session: [] for session in ledger.wires}
    for booking in ledger.bookings:
        by_session.setdefault(booking.session, []).append(booking)
    parts = [
        _session_account(bookings, ledger.wires.get(session, WireBytes()), direction)
        for session, bookings in by_session.items()
    ]
    return _sum(parts, direction)


def apportion(total: int, weights: Sequence[float]) -> list[int]:
    """Whole numbers in the proportion of weights (>= 0, not all 0 unless `total` is) that add up to `total`."""
    whole = sum(weights)
    if whole <= 0:
        return [0] * len(weights)
    result, reached, given = [], 0.0, 0
    for weight in weights:
        reached += weight
        due = min(total, round(total * (reached / whole)))
        result.append(due - given)
        given = due
    if result:
        result[-1] += total - given
    return result


def _session_account(all_bookings: list[Booking], wire: WireBytes, direction: Direction) -> WireAccount:
    bookings = [booking for booking in all_bookings if booking.direction == direction]
    answered = [booking for booking in all_bookings if booking.direction != direction]
    measured, counted = _counted(wire, direction, answered)
    payload = sum(booking.app_bytes for booking in bookings)
    heads = [_head_bytes(booking, wire) for booking in bookings]
    room = measured - sum(counted.values()) - payload
    # Too little room for the payloads alone: the last reading is older than the last messages.
    share = round(sum(heads)) if room < 0 else min(round(sum(heads)), room)
    sizes = [b.app_bytes + head for b, head in zip(bookings, apportion(share, heads), strict=True)]
    rest = counted | {"session": max(room - share, 0)}
    return WireAccount(
        direction=direction,
        measured=measured,
        estimated=sum(sizes) + sum(rest.values()) - measured,
        by_kind=_totals((booking.kind, size) for booking, size in zip(bookings, sizes, strict=True)),
        by_tile=_totals((b.tile, size) for b, size in zip(bookings, sizes, strict=True) if b.tile is not None),
        rest=rest,
    )


def _counted(wire: WireBytes, direction: Direction, answered: list[Booking]) -> tuple[int, dict[str, int]]:
    """Measured total, and of it what the meter itself could tell, bytes; `answered` came from the other side."""
    if direction == "up":
        tiles, acks = _acks(wire.up_acks, wire, answered, wire.down_alive)
        parts = (tiles, acks, wire.up_resent, wire.up_opening, wire.up_closing, wire.up_alive)
        return wire.up, dict(zip(RESIDUES, parts, strict=False))
    tiles, acks = _acks(wire.down_acks, wire, answered, wire.up_alive)
    parts = (tiles, acks, 0, wire.down_opening, wire.down_closing, wire.down_alive)
    return wire.down, dict(zip(RESIDUES, parts, strict=False))


def _acks(acks: int, wire: WireBytes, answered: list[Booking], alive_bytes: int) -> tuple[int, int]:
    """Acknowledgements of tiles and of all else, in the proportion of the packets that were answered."""
    alive = alive_bytes / (KEEP_ALIVE_BYTES + wire.header_bytes)
    weights = [_packets(booking, wire) for booking in answered]
    of_tiles = sum(n for booking, n in zip(answered, weights, strict=True) if booking.kind in TILE_KINDS)
    tiles, rest = apportion(acks, (of_tiles, sum(weights) - of_tiles + alive))
    return (tiles, rest) if tiles + rest == acks else (0, acks)


def _packets(booking: Booking, wire: WireBytes) -> float:
    """In how many packets a message travels: a share of one only fills them, the end of an answer has one more."""
    size = booking.app_bytes + (booking.head_bytes or 0)
    ends = booking.messages if booking.took_s is not None else 0
    return ends + max(size / wire.segment_bytes if wire.segment_bytes else 0.0, float(booking.messages))


def _head_bytes(booking: Booking, wire: WireBytes) -> float:
    """Estimate of what a message costs beside its payload: key, envelope, and headers of the packets that it fills."""
    if booking.head_bytes is None or not wire.segment_bytes:
        return float(MESSAGE_OVERHEAD_BYTES * booking.messages)
    return booking.head_bytes + wire.header_bytes * _packets(booking, wire)


def _totals(items: Iterator[tuple[str, int]]) -> dict[str, int]:
    sums: dict[str, int] = defaultdict(int)
    for name, size in items:
        sums[name] += size
    return dict(sorted(sums.items()))


def _sum(parts: list[WireAccount], direction: Direction) -> WireAccount:
    return WireAccount(
        direction=direction,
        measured=sum(part.measured for part in parts),
        estimated=sum(part.estimated for part in parts),
        by_kind=_totals(item for part in parts for item in part.by_kind.items()),
        by_tile=_totals(item for part in parts for item in part.by_tile.items()),
        rest={name: sum(part.rest[name] for part in parts) for name in RESIDUES},
    )
