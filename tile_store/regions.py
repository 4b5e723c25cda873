"""Regions of tiles as ranges of Morton numbers: a prefix of a tile's path is one contiguous range."""

from typing import Final

from tile_store.errors import StoreError

LEVELS: Final = 20
"""Base-4 digits of a tile's path (DESIGN of the key: four chunks of five)."""
ALL_TILES: Final = (0, 4**LEVELS)


def morton_range(prefix: str) -> tuple[int, int]:
    """First tile and one past the last of a region.

    Args:
        prefix: leading part of a tile's path, with or without slashes: "", "13033", "13033/03021", ...

    Raises:
        StoreError: a digit is not in 0..3, or there are more than 20.
    """
    digits = prefix.replace("/", "")
    if len(digits) > LEVELS or not set(digits) <= set("0123"):
        raise StoreError(f"region {prefix!r} must be at most {LEVELS} base-4 digits, e.g. 13033/03021")
    span = 4 ** (LEVELS - len(digits))
    first = int(digits or "0", 4) * span
    return first, first + span
