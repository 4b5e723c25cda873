"""The number by which the tile server chooses who gets a new version first.

It says less than a name: one of 65,536, so a server that must answer who asks learns no pseudonym. A vehicle that names
another number gets another published version, and has no more votes by that: those are counted by name.
"""

from hashlib import blake2b
from typing import Final

TICKETS: Final = 1 << 16
_SALT: Final = b"gnd ticket"


def ticket_of(vehicle: str) -> int:
    """The ticket of a pseudonym, 1 .. `TICKETS`; the same in every process."""
    digest = blake2b(vehicle.encode(), digest_size=2, key=_SALT).digest()
    return 1 + int.from_bytes(digest, "little")
