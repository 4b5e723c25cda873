"""Report ids: ULIDs that a restarted agent makes again for the same report, so that sending twice applies once."""

import hashlib
from functools import lru_cache

from ulid import ULID

from gnd.schemas.errors import BadValue
from gnd.schemas.wire import refusing

_RANDOM_BYTES = 10
_TIME_BYTES = 6


def deterministic_report_id(t_ms: int, *parts: str | bytes) -> str:
    """The ULID of `t_ms` (milliseconds since 1970 UTC; sorts first) whose 80 random bits are a hash of `parts`.

    The same arguments give the same id on every machine; `("ab", "c")` and `("a", "bc")` differ.
    """
    if not 0 <= t_ms < 2 ** (8 * _TIME_BYTES):
        raise BadValue(f"report time {t_ms} ms is outside the 48 bits of a ULID")
    digest = hashlib.blake2b(digest_size=_RANDOM_BYTES)
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "little") + data)
    return str(ULID.from_bytes(t_ms.to_bytes(_TIME_BYTES, "big") + digest.digest()))


@lru_cache(maxsize=4096)  # of a report many times: once a tile, part and reader
def check_report_id(report_id: str) -> None:
    """`BadValue` unless `report_id` is a ULID in its one canonical spelling (26 upper-case characters)."""
    with refusing(f"report id {report_id[:40]!r}"):
        canonical = str(ULID.from_str(report_id))
    if canonical != report_id:
        raise BadValue(f"report id {report_id[:40]!r} is not a ULID in canonical spelling")


def report_id_of_bytes(data: bytes) -> str:
    """The report id whose ULID has these 16 bytes; `BadValue` when there are more or fewer."""
    if len(data) != _RANDOM_BYTES + _TIME_BYTES:
        raise BadValue(f"report id has {len(data)} bytes, expected {_RANDOM_BYTES + _TIME_BYTES}")
    return str(ULID.from_bytes(data))


def bytes_of_report_id(report_id: str) -> bytes:
    """The 16 bytes of a report id; `BadValue` when it is none."""
    with refusing(f"report id {report_id[:40]!r}"):
        return bytes(ULID.from_str(report_id).bytes)
