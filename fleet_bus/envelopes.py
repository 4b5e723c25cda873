"""What zenoh puts around a payload within the TCP stream: the key in full, and an envelope of nearly constant size.

The envelopes were counted on connections of their own (zenoh 1.10, `tests/fleet_bus/test_traffic_wire.py` counts them
again): lengths grow by a byte or two with the payload, and a message longer than a batch has 9 bytes more a fragment.
"""

from typing import Final

import zenoh

REQUEST_BYTES: Final = 21
"""Around a query: frame, ids, time-out, target."""
REPLY_BYTES: Final = 45
"""Around an answer, with the message that ends the query."""
NOTICE_BYTES: Final = 12
"""Around a put."""
ATTACHMENT_BYTES: Final = 2
"""Around an attachment."""
RECORD_BYTES: Final = 22
"""Around what is sent at once over TLS 1.3: a header, a type and a tag."""


def head_bytes(key: str, envelope_bytes: int) -> int:
    """Bytes of a message's key and envelope."""
    return len(key.encode()) + envelope_bytes


def attachment_bytes(attachment: "bytes | zenoh.ZBytes | None") -> int:
    """Bytes of what travels beside a payload."""
    return 0 if attachment is None else len(attachment) + ATTACHMENT_BYTES
