"""What messages cost on the wire: the bytes that TCP_INFO counted, shared out to the last one.

Measured is only the total of each connection. It is laid out so:

    measured = payloads + heads of messages + acknowledgements + sent again + session

Payloads are exact. A message's head is its key and envelope (exact but for some bytes) and its part of the headers of
packets; a ledger of version 1 does not know keys and takes `MESSAGE_OVERHEAD_BYTES`. Acknowledgements (packets without
data) and what was sent again are counted by the kernel. What is left is the session itself: handshake, declarations,
keep-alives, answers that nobody waited for. Where messages travel together in packets less is left than their heads
come to; then they share it.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from fleet_bus.ledger import Direction
from fleet_bus.ledger_file import AgentLedger, Booking
from fleet_bus.pacer import MESSAGE_OVERHEAD_BYTES
from fleet_bus.wire import WireBytes

RESIDUES: Final = ("acks", "resent", "session")
"""Lines of the account beside the kinds of messages."""


@dataclass(frozen=True, slots=True)
class WireAccount:
    """One direction of one agent's traffic on the wire; all sizes in bytes.

    Attributes:
        direction: "up" or "down".
        measured: what TCP_INFO counted.
        estimated: what no reading covers: sent after the last one before a kill, or the system counts nothing.
        by_kind: wire bytes of the messages of each kind.
        by_tile: wire bytes of the messages, or shares of them, about each tile.
        acks: packets without data.
        resent: data sent again.
        session: handshakes, declarations, keep-alives, and the packets that carry them.
    """

    direction: Direction
    measured: int
    estimated: int
    by_kind: dict[str, int]
    by_tile: dict[str, int]
    acks: int
    resent: int
    session: int

    @property
    def total(self) -> int:
        """Sum of all lines: `measured` + `estimated`."""
        return sum(self.by_kind.values()) + self.acks + self.resent + self.session


def wire_account(ledger: AgentLedger, direction: Direction) -> WireAccount:
    """Shares out what was measured in one direction over all sessions of an agent."""
    by_session: dict[str, list[Booking]] = {session: [] for session in ledger.wires}
    for booking in ledger.bookings:
        if booking.direction == direction:
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


def _session_account(bookings: list[Booking], wire: WireBytes, direction: Direction) -> WireAccount:
    measured, acks, resent = _counted(wire, direction)
    payload = sum(booking.app_bytes for booking in bookings)
    heads = [_head_bytes(booking, wire) for booking in bookings]
    room = measured - acks - resent - payload
    # Too little room for the payloads alone: the last reading is older than the last messages.
    share = round(sum(heads)) if room < 0 else min(round(sum(heads)), room)
    sizes = [b.app_bytes + head for b, head in zip(bookings, apportion(share, heads), strict=True)]
    session = max(room - share, 0)
    return WireAccount(
        direction=direction,
        measured=measured,
        estimated=sum(sizes) + acks + resent + session - measured,
        by_kind=_totals((booking.kind, size) for booking, size in zip(bookings, sizes, strict=True)),
        by_tile=_totals((b.tile, size) for b, size in zip(bookings, sizes, strict=True) if b.tile is not None),
        acks=acks,
        resent=resent,
        session=session,
    )


def _counted(wire: WireBytes, direction: Direction) -> tuple[int, int, int]:
    """Measured total, and of it acknowledgements and what was sent again, bytes."""
    return (wire.up, wire.up_acks, wire.up_resent) if direction == "up" else (wire.down, wire.down_acks, 0)


def _head_bytes(booking: Booking, wire: WireBytes) -> float:
    """Estimate of what a message costs beside its payload: key, envelope, and headers of the packets that it fills."""
    if booking.head_bytes is None or not wire.segment_bytes:
        return float(MESSAGE_OVERHEAD_BYTES * booking.messages)
    packets = (booking.app_bytes + booking.head_bytes) / wire.segment_bytes
    return booking.head_bytes + wire.header_bytes * max(packets, float(booking.messages))


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
        acks=sum(part.acks for part in parts),
        resent=sum(part.resent for part in parts),
        session=sum(part.session for part in parts),
    )
