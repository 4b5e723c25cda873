"""Regions of tiles: path prefixes as ranges of Morton numbers, and key expressions with wildcards."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import BadKey
from gnd.schemas.wire import LAYER_PATTERN
from gnd.tile_store.errors import StoreError

LEVELS: Final = 20
"""Base-4 digits of a tile's path: four chunks of five."""
ALL_TILES: Final = (0, 4**LEVELS)
_LAYER: Final = re.compile(rf"{LAYER_PATTERN.pattern}|\*\*?")
_CHUNK: Final = re.compile(r"[0-3]{5}|\*\*?")


def morton_range(prefix: str) -> tuple[int, int]:
    """First tile of a region and one past its last: the tiles of a path prefix are one contiguous range.

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


def bounds_deg(tiles: Iterable[TileId]) -> tuple[float, float, float, float]:
    """South, west, north and east of the box around the tiles, degrees."""
    corners = np.degrees([(*tile.south_west_rad, *tile.north_east_rad) for tile in tiles])
    south, west = corners[:, :2].min(axis=0).tolist()
    north, east = corners[:, 2:].max(axis=0).tolist()
    return south, west, north, east


@dataclass(frozen=True, slots=True)
class TileRegion:
    """What a wildcard query asks for: the chunks behind its kind, `<layer>/<q5>/…`, each a name, `*` or `**`."""

    chunks: tuple[str, ...]

    @classmethod
    def of_key(cls, key: str, root: str) -> Self:
        """The region of a key expression below `root` (a key up to its kind, ending in a slash).

        Raises:
            BadKey: the key is not below the root, has a wildcard inside a chunk or a chunk that no path has.
        """
        layer, *path = key.removeprefix(root).split("/")
        if not (key.startswith(root) and _LAYER.fullmatch(layer) and all(map(_CHUNK.fullmatch, path))):
            raise BadKey(f"key {key[:160]!r}: a region is {root}<layer>/<q5>/<q10>/… with * or ** as whole chunks")
        return cls((layer, *path))

    @property
    def layer(self) -> str | None:
        """The one layer that is asked for; None: any."""
        return None if "*" in self.chunks[0] else self.chunks[0]

    @property
    def prefix(self) -> str:
        """The longest path prefix that holds the whole region."""
        if self.chunks[0] == "**":
            return ""
        wild = next((i for i, chunk in enumerate(self.chunks) if i and "*" in chunk), len(self.chunks))
        return "/".join(self.chunks[1:wild])

    @property
    def is_prefix(self) -> bool:
        """Whether the region holds every tile of its layers below its prefix."""
        return self.chunks[1 + len(self.prefix.split("/")) if self.prefix else 1 :] == ("**",)

    def matches(self, *names: str) -> bool:
        """Whether the region holds a key of these chunks (layer, then the path's)."""
        return _matches(self.chunks, names)


def _matches(pattern: tuple[str, ...], names: tuple[str, ...]) -> bool:
    if not pattern:
        return not names
    if pattern[0] == "**":
        return _matches(pattern[1:], names) or (bool(names) and _matches(pattern, names[1:]))
    return bool(names) and pattern[0] in ("*", names[0]) and _matches(pattern[1:], names[1:])
