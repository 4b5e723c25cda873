"""What rmw_zenoh puts beside each message, request and answer: a number, a time, and whose it is.

Two layouts are about, both of zenoh's serialiser. Releases since spring 2025 (rmw_zenoh #601; humble 0.1.2) have the
three values alone, 33 bytes; those before have the name of each in front of it. Neither side of ROS 2 reads the other.
Source: rmw_zenoh_cpp/src/detail/attachment_helpers.cpp, docs/design.md.
"""

import struct
from dataclasses import dataclass
from typing import Final

from zenoh import ext

GID_BYTES: Final = 16
_NAMES: Final = ("sequence_number", "source_timestamp", "source_gid")
_TOLD: Final = tuple(bytes([len(name)]) + name.encode() for name in _NAMES)
"""As zenoh writes texts: their length, then themselves."""
_PLAIN: Final = struct.Struct("<qqB16s")
_NAMED: Final = struct.Struct(f"<{len(_TOLD[0])}sq{len(_TOLD[1])}sq{len(_TOLD[2])}sB16s")


@dataclass(frozen=True, slots=True)
class RosAttachment:
    """The three values.

    Attributes:
        sequence: number of the message at its publisher, or of the request at its client, from 1.
        sent_ns: when it was sent, by the sender's clock, ns.
        gid: 16 bytes that name the publisher or the client.
        has_names: the layout before spring 2025.
    """

    sequence: int
    sent_ns: int
    gid: bytes
    has_names: bool = False

    def encode(self) -> bytes:
        """The bytes of zenoh's serialiser."""
        values = ext.Int64(self.sequence), ext.Int64(self.sent_ns), self.gid
        if not self.has_names:
            return bytes(ext.z_serialize(values).to_bytes())
        named = (_NAMES[0], values[0], _NAMES[1], values[1], _NAMES[2], values[2])
        return bytes(ext.z_serialize(named).to_bytes())

    @classmethod
    def decode(cls, data: bytes) -> "RosAttachment | None":
        """Read either layout; None where it is neither.

        Not with zenoh's deserialiser: it makes room for any length that is told before it looks whether so many bytes
        are there, and ends the process where there is no such room.
        """
        if len(data) == _PLAIN.size:
            sequence, sent_ns, n, gid = _PLAIN.unpack(data)
            return cls(sequence, sent_ns, gid) if n == GID_BYTES else None
        if len(data) != _NAMED.size:
            return None
        first, sequence, second, sent_ns, third, n, gid = _NAMED.unpack(data)
        known = (first, second, third) == _TOLD and n == GID_BYTES
        return cls(sequence, sent_ns, gid, has_names=True) if known else None
