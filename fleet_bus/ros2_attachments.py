"""What rmw_zenoh puts beside each message, request and answer: a number, a time, and whose it is.

Two layouts are about, both of zenoh's serialiser. Releases since spring 2025 (rmw_zenoh #601; humble 0.1.2) have the
three values alone, 33 bytes; those before have the name of each in front of it. Neither side of ROS 2 reads the other.
Source: rmw_zenoh_cpp/src/detail/attachment_helpers.cpp, docs/design.md.
"""

from dataclasses import dataclass
from typing import Final

import zenoh
from zenoh import ext

GID_BYTES: Final = 16
_NAMES: Final = ("sequence_number", "source_timestamp", "source_gid")


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
        """Read either layout; None where it is neither."""
        packed = zenoh.ZBytes(data)
        has_names = data[1:].startswith(_NAMES[0].encode())
        try:
            if has_names:
                read = ext.z_deserialize(tuple[str, ext.Int64, str, ext.Int64, str, bytes], packed)
                sequence, sent_ns, gid = read[1], read[3], read[5]
            else:
                sequence, sent_ns, gid = ext.z_deserialize(tuple[ext.Int64, ext.Int64, bytes], packed)
        except ext.ZDeserializeError:
            return None
        return cls(int(sequence), int(sent_ns), bytes(gid), has_names) if len(gid) == GID_BYTES else None
