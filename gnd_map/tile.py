"""A version of a tile and its content hash; deltas between versions are in `gnd.gnd_map.delta`."""

import hashlib
from dataclasses import dataclass, field

from gnd.gnd_map.codec import encode_gaussians
from gnd.gnd_map.day import LAST_DAY, UNKNOWN_DAY
from gnd.gnd_map.delta import TileDelta, apply, diff
from gnd.gnd_map.errors import ShapeError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId

__all__ = ["Tile", "TileDelta", "apply", "content_sha", "diff"]


@dataclass(frozen=True, slots=True)
class Tile:
    """One published state of a tile. Its float32 columns are the truth: whoever holds the same hash holds the same
    bits.
    """

    tile_id: TileId
    """Which tile."""
    version: int
    """1, 2, 3 … as the store counts; 0 = not published."""
    gaussians: Gaussians
    """Its voxels, every count > 0."""
    day: int = field(default=UNKNOWN_DAY, compare=False)
    """When the world looked so: the day of the survey, or of the merge that made the version (`gnd_map.day`). No part
    of the content: the hash does not know it."""
    _sha: list[bytes] = field(default_factory=list, init=False, repr=False, compare=False)
    """The hash, once it was asked for."""

    def __post_init__(self) -> None:
        if self.version < 0:
            raise ShapeError(f"tile {self.tile_id}: version {self.version} is negative")
        if not UNKNOWN_DAY <= self.day <= LAST_DAY:
            raise ShapeError(f"tile {self.tile_id}: day {self.day} is outside {UNKNOWN_DAY} .. {LAST_DAY}")
        if not self.gaussians.exists.all():
            raise ShapeError(f"tile {self.tile_id}: {int((~self.gaussians.exists).sum())} voxels have count 0")

    @property
    def sha(self) -> bytes:
        """32 bytes: SHA-256 of the tile id (8 bytes little-endian) and the codec 0 body; the version does not enter."""
        if not self._sha:
            self._sha.append(content_sha(self.tile_id, self.gaussians))
        return self._sha[0]


def content_sha(tile_id: TileId, gaussians: Gaussians) -> bytes:
    """32 bytes: SHA-256 of the tile id (8 bytes little-endian) and the codec 0 body of the Gaussians."""
    return hashlib.sha256(tile_id.morton.to_bytes(8, "little") + encode_gaussians(gaussians)).digest()
