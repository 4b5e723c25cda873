"""Times as text into int ns UTC: seconds, milli-, micro-, nanoseconds since 1970, dates, GPS weeks."""

import re
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from typing import Final

from gnd.vehicle_agent.errors import ImportDriveError

NS: Final = 1_000_000_000
GPS_EPOCH_S: Final = 315_964_800
WEEK_S: Final = 604_800
_LEAPS: Final = (
    ("1981-07-01", 1), ("1982-07-01", 2), ("1983-07-01", 3), ("1985-07-01", 4), ("1988-01-01", 5), ("1990-01-01", 6),
    ("1991-01-01", 7), ("1992-07-01", 8), ("1993-07-01", 9), ("1994-07-01", 10), ("1996-01-01", 11), ("1997-07-01", 12),
    ("1999-01-01", 13), ("2006-01-01", 14), ("2009-01-01", 15), ("2012-07-01", 16), ("2015-07-01", 17),
    ("2017-01-01", 18),
)  # fmt: skip
"""From which day on GPS time is ahead of UTC by how many seconds (IERS Bulletin C)."""


def leap_seconds(utc_s: int) -> int:
    """GPS time less UTC at a time."""
    day = datetime.fromtimestamp(utc_s, UTC).date().isoformat()
    return max((leaps for since, leaps in _LEAPS if since <= day), default=0)


def ns_of_gps(week: int, seconds: str) -> int:
    """Of a GPS week (not rolled over) and seconds of it."""
    gps_ns = (GPS_EPOCH_S + week * WEEK_S) * NS + _ns(seconds)
    return gps_ns - leap_seconds(gps_ns // NS) * NS


def ns_of_number(text: str) -> int:
    """Of a number since 1970 (or since the recording began), whose size tells seconds, ms, us or ns."""
    value = _ns(text)
    if value < 100_000_000_000 * NS:
        return value
    for per, most in ((1_000, 10**14), (1_000_000, 10**17), (NS, 10**20)):
        if value < most * NS:
            return value // per
    raise ImportDriveError(f"time {text[:40]!r} is no time since 1970")


def ns_of_date(text: str, *, gps: bool = False) -> int:
    """Of a date and time such as 2011-09-26T13:02:25.964Z or 2023/07/11 06:04:30.000; `gps`: in GPS time.

    Raises:
        ImportDriveError: it is none.
    """
    stripped = text.strip().replace("/", "-").removesuffix("Z").removesuffix("z")
    found = re.fullmatch(r"(.*?:\d{2}:\d{2})(?:\.(\d+))?(.*)", stripped)
    whole, digits, zone = (found[1], (found[2] or "")[:9], found[3]) if found else (stripped, "", "")
    try:
        moment = datetime.fromisoformat(whole + zone)
    except ValueError as error:
        raise ImportDriveError(f"time {text[:40]!r} is no date and time: {error}") from None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=UTC)
    t_ns = int(moment.timestamp()) * NS + int(digits.ljust(9, "0") or 0)
    return t_ns - leap_seconds(t_ns // NS) * NS if gps else t_ns


def _ns(text: str) -> int:
    """Seconds as text into int ns, exactly."""
    try:
        return int((Decimal(text.strip()) * NS).to_integral_value())
    except (InvalidOperation, ValueError, OverflowError):
        raise ImportDriveError(f"time {text[:40]!r} is no number") from None
