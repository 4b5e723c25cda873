"""Tiles of a district by their places in it, as requests name them; those of other districts in a `TilesRequest`."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from gnd.gnd_map.codec import decode_tiles, encode_tiles
from gnd.gnd_map.tile_id import District, TileId
from gnd.schemas import limits
from gnd.schemas.errors import BadValue
from gnd.schemas.generated import other_tiles_pb2
from gnd.schemas.wire import check_length, refusing

HASH_BYTES: Final = 8
"""So much of a hash, or of a digest of hashes, says what a client holds: chance errs once in 10^19."""
MAX_HELD_VERSION: Final = 2**31
TILES: Final = limits.MAX_TILES_OF_DISTRICT


@dataclass(frozen=True, slots=True)
class OtherTiles:
    """Tiles that are wanted of another district than the key's."""

    step: int
    """Number of the district minus that of the key's; not 0."""
    wanted: tuple[tuple[int, int], ...]
    """As `TilesRequest.wanted`."""
    held_digest: bytes = b""
    """As `TilesRequest.held_digest`."""

    def __post_init__(self) -> None:
        if not 0 < abs(self.step) < limits.DISTRICTS:
            raise BadValue(
                f"TilesRequest for another district, {self.step} from the key's: 1 to {limits.DISTRICTS - 1}"
            )
        check_indices(self.wanted)
        n_held = n_held_of(self.wanted)
        if len(self.held_digest) != (HASH_BYTES if n_held else 0):
            raise BadValue(
                f"TilesRequest with {n_held} tiles held of another district and a digest of {len(self.held_digest)}"
                f" bytes: {HASH_BYTES} where any is held"
            )

    def district(self, of_key: District) -> District:
        """Which district; `BadValue` where there is none."""
        with refusing(f"TilesRequest for the district {self.step} from {of_key}"):
            return TileId(of_key.first_morton + self.step * TILES).district

    def message(self) -> other_tiles_pb2.OtherTiles:
        """As a part of a message."""
        return other_tiles_pb2.OtherTiles(
            step=self.step, wanted=encode_tiles(self.wanted), held_digest=self.held_digest
        )


def other_tiles(message: other_tiles_pb2.OtherTiles) -> OtherTiles:
    """The value of a part of a message; `SchemaError` when it is none."""
    with refusing("TilesRequest"):
        wanted = tuple((int(index), int(version)) for index, version in decode_tiles(message.wanted))
    return OtherTiles(message.step, wanted, message.held_digest)


def step_between(of_key: District, other: District) -> int:
    """Number of another district minus that of the key's."""
    return (other.first_morton - of_key.first_morton) // TILES


def check_others(others: Sequence[OtherTiles]) -> None:
    """`BadValue`, `TooLarge` where there are too many, or a district comes twice."""
    check_length("TilesRequest", len(others), limits.MAX_OTHER_DISTRICTS, "other districts")
    if len({other.step for other in others}) < len(others):
        raise BadValue(f"TilesRequest for {len(others)} other districts, some of them twice")


def n_held_of(wanted: Sequence[tuple[int, int]]) -> int:
    """Of how many tiles a version is held."""
    return sum(version > 0 for _, version in wanted)


def check_indices(wanted: Sequence[tuple[int, int]]) -> None:
    """`BadValue`, `TooLarge` unless these are (index, version) of tiles of one district, ascending."""
    check_length("TilesRequest", len(wanted), TILES, "tiles")
    if not wanted:
        raise BadValue("TilesRequest for no tiles")
    for index, version in wanted:
        if not 0 <= version < MAX_HELD_VERSION:
            raise BadValue(f"held version {version} of tile {index} is outside 0 .. {MAX_HELD_VERSION - 1}")
    if wanted[0][0] < 0 or wanted[-1][0] >= TILES or any(a >= b for (a, _), (b, _) in pairwise(wanted)):
        raise BadValue(
            f"TilesRequest for tiles {[i for i, _ in wanted][:9]}…: ascending in 0 .. {TILES - 1}, once each"
        )
