"""UDP packets of a capture (pcap, pcapng): fragments of IP put together again, what is cut off is counted.

A LiDAR's packet is longer than a network frame (1500 bytes), so most captures hold it in pieces (RFC 791, section
3.2). Read are Ethernet with and without VLAN tags, Linux' cooked captures, loopback and bare IP.
"""

import struct
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field
from decimal import Decimal
from ipaddress import ip_address
from pathlib import Path
from typing import IO, Final

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.optional import library

EXTRA: Final = "import"
PENDING: Final = 256
"""Packets whose pieces are waited for at a time; the oldest is given up."""
MAX_FRAME_BYTES: Final = 1 << 18
"""The longest that libpcap captures (its MAXIMUM_SNAPLEN); a UDP packet has at most 65,535 bytes."""
NS: Final = 1_000_000_000
MAX_STAMP_S: Final = 9_223_372_036
"""From here on ns do not fit into 64 bits (2262)."""
_UDP: Final = 17
_VLAN: Final = (0x8100, 0x88A8)
_PLAIN_LINKS: Final = {0: 4, 108: 4, 113: 16, 276: 20, 12: 0, 14: 0, 101: 0, 228: 0, 229: 0}
"""Length of the header of other links than Ethernet, by the number of the link's type."""


@dataclass(frozen=True, slots=True)
class UdpPacket:
    """host_ns: when the computer that captured got its last piece; 0: not known."""

    host_ns: int
    source: str
    port: int
    payload: bytes


class BoundedFile:
    """A file of which a single read gives at most a longest frame: the library asks for as much as the file says, and
    cuts options off the front of a block one after the other.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        self.name, self.seek, self.fileno, self._stream = stream.name, stream.seek, stream.fileno, stream

    def read(self, size: int) -> bytes:
        """As a file's; ValueError: more than `MAX_FRAME_BYTES`, or fewer than none."""
        if not 0 <= size <= MAX_FRAME_BYTES:
            raise ValueError(f"a packet or block of {size} bytes (0 ... {MAX_FRAME_BYTES})")
        return self._stream.read(size)


def _host_ns(stamp_s: float | Decimal) -> int:
    """A stamp in ns; 0, not known, before 1970 and from 2262 on, which a pcapng can say."""
    return round(stamp_s * NS) if 0 <= stamp_s < MAX_STAMP_S else 0


@dataclass(slots=True)
class _Pieces:
    parts: dict[int, bytes] = field(default_factory=dict)
    end: int | None = None
    held: int = 0

    def add(self, at: int, data: bytes, *, more: bool) -> bytes | None:
        """The whole packet once it is complete."""
        self.parts[at] = data
        self.held += len(data)
        if not more:
            self.end = at + len(data)
        if self.end is None or self.held < self.end:
            return None
        return b"".join(self.parts[one] for one in sorted(self.parts))


@dataclass(slots=True)
class UdpCapture:
    """A capture's packets, in their order.

    incomplete: packets cut off or without some of their pieces, known once `packets` was read to its end. damaged: why
    the file could not be read to its end; empty where it could.
    """

    path: Path
    incomplete: int = 0
    damaged: str = ""
    _pending: OrderedDict[tuple[bytes, int], _Pieces] = field(default_factory=OrderedDict)

    def packets(self) -> Iterator[UdpPacket]:
        """Every whole UDP packet.

        Raises:
            ImportDriveError: no capture.
            MissingExtra: dpkt is not installed.
        """
        reader_of = library("dpkt.pcap", EXTRA).UniversalReader
        damage: type[Exception] = library("dpkt", EXTRA).dpkt.Error
        self.incomplete, self.damaged = 0, ""
        with self.path.open("rb") as stream:
            try:
                reader = reader_of(BoundedFile(stream))
                link = int(reader.datalink())
                for stamp_s, frame in reader:
                    found = self._udp(self._ip_packet(link, frame))
                    if found is not None:
                        yield UdpPacket(_host_ns(stamp_s), *found)
            except (ValueError, OverflowError, struct.error, damage) as error:
                self.damaged = " ".join(str(error).split())[:200] or type(error).__name__
        self.incomplete += len(self._pending)
        self._pending.clear()

    def _ip_packet(self, link: int, frame: bytes) -> bytes:
        """The frame without the header of its link; empty where the link carries something else than IP.

        Raises:
            ImportDriveError: a link of another type.
        """
        if link in _PLAIN_LINKS:
            return frame[_PLAIN_LINKS[link] :]
        if link != 1:
            raise ImportDriveError(
                f"{self.path}: a capture of link type {link}; known are 1 (Ethernet), {sorted(_PLAIN_LINKS)}"
            )
        at = 12
        while int.from_bytes(frame[at : at + 2], "big") in _VLAN:
            at += 4
        return frame[at + 2 :] if frame[at : at + 2] in (b"\x08\x00", b"\x86\xdd") else b""

    def _udp(self, packet: bytes) -> tuple[str, int, bytes] | None:
        """Source, port it goes to, payload; None where it is no UDP or not yet whole."""
        if len(packet) < 20:
            return None
        if packet[0] >> 4 == 6:
            whole = packet[40:] if len(packet) > 48 and packet[6] == _UDP else None
            source = packet[8:24]
        else:
            whole, source = self._ip4(packet), packet[12:16]
        if whole is None or len(whole) < 8:
            return None
        _, port, length, _ = struct.unpack_from(">HHHH", whole)
        payload = whole[8 : length or None]
        if len(payload) < length - 8:
            self.incomplete += 1
            return None
        return str(ip_address(source)), int(port), payload

    def _ip4(self, packet: bytes) -> bytes | None:
        """What an IP packet carries, once all its pieces are there."""
        first, _, length, number, fragment, _, protocol = struct.unpack_from(">BBHHHBB", packet)
        if first >> 4 != 4 or protocol != _UDP:
            return None
        data = packet[4 * (first & 15) : length or None]
        at, more = 8 * (fragment & 0x1FFF), bool(fragment & 0x2000)
        if not more and at == 0:
            return data
        key = (packet[12:20], int(number))
        if at in self._pending.get(key, _Pieces()).parts:  # the number was used again: the older packet lost a piece
            self._give_up(key)
        whole = self._pending.setdefault(key, _Pieces()).add(at, data, more=more)
        if whole is not None:
            del self._pending[key]
        elif len(self._pending) > PENDING:
            self._give_up(next(iter(self._pending)))
        return whole

    def _give_up(self, key: tuple[bytes, int]) -> None:
        del self._pending[key]
        self.incomplete += 1
