"""Days, as they go with tiles: two bytes say how old a map is."""

from typing import Final

UNKNOWN_DAY: Final = 0
LAST_DAY: Final = 2**16 - 1
"""In the year 2179."""
_FIRST_NS: Final = 946_684_800_000_000_000  # 2000-01-01 UTC
_NS_PER_DAY: Final = 86_400_000_000_000


def day_of(t_ns: int) -> int:
    """The day of a time: 1 is 2000-01-01 UTC; `UNKNOWN_DAY` for times that no clock of a vehicle shows.

    Args:
        t_ns: ns since 1970-01-01 UTC.
    """
    day = (t_ns - _FIRST_NS) // _NS_PER_DAY + 1
    return day if 1 <= day <= LAST_DAY else UNKNOWN_DAY


def ns_of(day: int) -> int:
    """When a day begins, ns since 1970-01-01 UTC."""
    return _FIRST_NS + (day - 1) * _NS_PER_DAY
