"""Bytes on the wire of a session's own connections, from the kernel's TCP_INFO.

The zenoh wheel keeps no transport statistics, but Linux counts for every TCP socket. The counters die with the socket,
so a duplicate of the descriptor is kept until the link is reported as gone, and its last reading is added to the past.
"""

import contextlib
import socket
import struct
import threading
from dataclasses import dataclass, field
from typing import Final

from gnd.fleet_bus.sockets import duplicate_of

_TCP_INFO_BYTES: Final = 232
KEEP_ALIVE_BYTES: Final = 3
"""Of a keep-alive within the stream; nothing else that zenoh sends is as short (counted again in a test)."""
_TIMESTAMPS: Final = 1  # TCPI_OPT_TIMESTAMPS of linux/tcp.h
# Offsets in struct tcp_info of linux/tcp.h.
_OPTIONS_AT, _SEGMENT_SIZE_AT, _BYTES_RECEIVED_AT, _SEGMENTS_AT, _DATA_SEGMENTS_AT = 5, 16, 128, 136, 152
_BYTES_SENT_AT = 200  # with the bytes sent again beside it


@dataclass(frozen=True, slots=True)
class WireBytes:
    """IP bytes of all connections of a session: TCP payload with retransmissions, plus the headers of each packet.

    Attributes:
        up: sent, bytes.
        down: received, bytes.
        connections: how many connections these are.
        up_acks: of `up`, packets in between that carry no data: acknowledgements, bytes.
        down_acks: likewise of `down`.
        up_resent: of `up`, data that had to be sent again, bytes. (What was lost on the way down never came.)
        segment_bytes: data that one packet can carry, the largest of the connections; 0 where nothing was measured.
        header_bytes: headers of one packet, the largest of the connections.
        up_opening: of `up`, what had passed when a connection was new: handshakes with their acknowledgements, bytes.
        down_opening: likewise of `down`.
        up_alive: of `up`, keep-alives with their packet headers, as far as readings came between them, bytes.
        down_alive: likewise of `down`.
        up_closing: of `up`, what passed once the session was being closed: ends of declarations, bytes.
        down_closing: likewise of `down`.
    """

    up: int = 0
    down: int = 0
    connections: int = 0
    up_acks: int = 0
    down_acks: int = 0
    up_resent: int = 0
    segment_bytes: int = 0
    header_bytes: int = 0
    up_opening: int = 0
    down_opening: int = 0
    up_alive: int = 0
    down_alive: int = 0
    up_closing: int = 0
    down_closing: int = 0

    def __add__(self, other: "WireBytes") -> "WireBytes":
        return WireBytes(
            self.up + other.up,
            self.down + other.down,
            self.connections + other.connections,
            self.up_acks + other.up_acks,
            self.down_acks + other.down_acks,
            self.up_resent + other.up_resent,
            max(self.segment_bytes, other.segment_bytes),
            max(self.header_bytes, other.header_bytes),
            self.up_opening + other.up_opening,
            self.down_opening + other.down_opening,
            self.up_alive + other.up_alive,
            self.down_alive + other.down_alive,
            self.up_closing + other.up_closing,
            self.down_closing + other.down_closing,
        )


@dataclass(slots=True)
class _Tap:
    """A second descriptor of a connection's socket, and what has been seen on it.

    A keep-alive is known by its size: as many packets with data as threes of bytes since the reading before. Readings
    must come oftener than keep-alives, or these are booked as the rest of the session: too few, never too many.
    """

    end: socket.socket
    opening: "_Counters"
    counted: "_Counters"
    closing: "_Counters | None" = None
    alive: list[int] = field(default_factory=lambda: [0, 0])

    @classmethod
    def of(cls, tap: socket.socket) -> "_Tap":
        """Begins to count; what has passed until now is the opening."""
        counted = _Counters.read(tap)
        return cls(tap, counted, counted)

    def close_from_now(self) -> None:
        """What passes from now on is the closing."""
        self.read()
        self.closing = self.counted

    def read(self) -> WireBytes:
        """Everything until now."""
        now = _Counters.read(self.end)
        then, self.counted = self.counted, now
        if self.closing is None and now.resent == then.resent:
            self.alive[0] += _keep_alive_bytes(now.sent - then.sent, now.data_out - then.data_out, now)
            self.alive[1] += _keep_alive_bytes(now.received - then.received, now.data_in - then.data_in, now)
        first, last = self.opening, self.closing or now
        return WireBytes(
            up=now.up,
            down=now.down,
            connections=1,
            up_acks=last.up_acks - first.up_acks,
            down_acks=last.down_acks - first.down_acks,
            up_resent=last.resent - first.resent,
            segment_bytes=now.segment_bytes,
            header_bytes=now.header_bytes,
            up_opening=first.up,
            down_opening=first.down,
            up_alive=self.alive[0],
            down_alive=self.alive[1],
            up_closing=now.up - last.up,
            down_closing=now.down - last.down,
        )


@dataclass(slots=True)
class WireMeter:
    """Follows the connections of one session. Thread-safe.

    Attributes:
        transmit_timeout_ms: a connection ends on which nothing that was sent is acknowledged for this long, and zenoh
            opens another; 0 leaves it to the kernel, which tries for a quarter of an hour. The other side may send
            its keep-alives as seldom as it likes: a dead link is noticed by what is not acknowledged, not by silence.
    """

    transmit_timeout_ms: int = 0
    _past: WireBytes = field(default_factory=WireBytes)
    _open: dict[tuple[str, str], _Tap] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def attach(self, source: str, destination: str) -> None:
        """Begins to count the connection between two locators ("tcp/host:port"), and bounds its time to transmit."""
        tap = duplicate_of(source, destination)
        if tap is None:
            return
        with contextlib.suppress(OSError):  # ended already, or not Linux
            tap.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, self.transmit_timeout_ms)
        with self._lock:
            old = self._open.pop((source, destination), None)
            self._open[source, destination] = _Tap.of(tap)
        if old is not None:
            old.end.close()

    def detach(self, source: str, destination: str) -> None:
        """Adds the last reading of a connection to the past and lets its socket go."""
        with self._lock:
            tap = self._open.pop((source, destination), None)
            if tap is not None:
                self._past += tap.read()
        if tap is not None:
            tap.end.close()

    def read(self) -> WireBytes:
        """Total of the past and the present connections."""
        with self._lock:
            return sum((tap.read() for tap in self._open.values()), self._past)

    def close_from_now(self) -> None:
        """The session is being closed: what its connections carry from now on is the closing."""
        with self._lock:
            for tap in self._open.values():
                tap.close_from_now()

    def cut(self) -> None:
        """Ends the connections themselves, whatever still waits on them."""
        with self._lock:
            taps = tuple(self._open.values())
        for tap in taps:
            with contextlib.suppress(OSError):  # ended already
                tap.end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Detaches everything; `read` keeps giving the final total."""
        for source, destination in tuple(self._open):
            self.detach(source, destination)


@dataclass(frozen=True, slots=True)
class _Counters:
    """What TCP_INFO counts of one connection."""

    sent: int = 0
    received: int = 0
    segments_out: int = 0
    segments_in: int = 0
    data_out: int = 0
    data_in: int = 0
    resent: int = 0
    segment_bytes: int = 0
    header_bytes: int = 0

    @classmethod
    def read(cls, tap: socket.socket) -> "_Counters":
        """Reads them; all 0 where the kernel is older than 4.19 and has no bytes_sent."""
        info = tap.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO_BYTES)
        if len(info) < _TCP_INFO_BYTES:
            return cls()
        (received,) = struct.unpack_from("=Q", info, _BYTES_RECEIVED_AT)
        segments_out, segments_in = struct.unpack_from("=II", info, _SEGMENTS_AT)
        data_in, data_out = struct.unpack_from("=II", info, _DATA_SEGMENTS_AT)
        sent, resent = struct.unpack_from("=QQ", info, _BYTES_SENT_AT)
        (segment_bytes,) = struct.unpack_from("=I", info, _SEGMENT_SIZE_AT)
        header = (40 if tap.family == socket.AF_INET6 else 20) + 20 + (12 if info[_OPTIONS_AT] & _TIMESTAMPS else 0)
        return cls(sent, received, segments_out, segments_in, data_out, data_in, resent, segment_bytes, header)

    @property
    def up(self) -> int:
        """IP bytes sent."""
        return self.sent + self.segments_out * self.header_bytes

    @property
    def down(self) -> int:
        """IP bytes received."""
        return self.received + self.segments_in * self.header_bytes

    @property
    def up_acks(self) -> int:
        """Of `up`, packets without data."""
        return (self.segments_out - self.data_out) * self.header_bytes

    @property
    def down_acks(self) -> int:
        """Of `down`, packets without data."""
        return max(self.segments_in - self.data_in, 0) * self.header_bytes


def _keep_alive_bytes(stream_bytes: int, packets: int, now: _Counters) -> int:
    """What keep-alives came to between two readings; 0 where anything else may have been among it."""
    if packets <= 0 or stream_bytes != packets * KEEP_ALIVE_BYTES:
        return 0
    return packets * (KEEP_ALIVE_BYTES + now.header_bytes)
