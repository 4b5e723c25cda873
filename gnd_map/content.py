"""What a tile of any layer holds, Gaussians or features: one way to write, read and compare both.

The codec id says which of the two a body is; the name of a layer says which of the two it holds.
"""

from dataclasses import replace
from typing import Final, TypeAlias, TypeVar, cast

from gnd.gnd_map.codec import PREFERRED, best_codec, codec_of, decode_delta, encode_delta, lattice_of
from gnd.gnd_map.day import UNKNOWN_DAY
from gnd.gnd_map.errors import CodecError
from gnd.gnd_map.features import (
    CODEC_FEATURES,
    FeatureTile,
    decode_feature_delta,
    decode_features,
    diff_features,
    encode_feature_delta,
    encode_features,
    is_feature_layer,
)
from gnd.gnd_map.tile import Tile, diff
from gnd.gnd_map.tile_id import TileId

AnyTile: TypeAlias = Tile | FeatureTile
TileT = TypeVar("TileT", bound=Tile | FeatureTile)

FEATURE_CODECS: Final = (CODEC_FEATURES,)
"""All codecs of features that this program reads."""


def codecs_of_layer(layer: str) -> tuple[int, ...]:
    """All codec ids that this program reads in a layer, smallest bodies first."""
    return FEATURE_CODECS if is_feature_layer(layer) else PREFERRED


def kind_of_layer(layer: str) -> type[Tile] | type[FeatureTile]:
    """The class of the tiles of a layer."""
    return FeatureTile if is_feature_layer(layer) else Tile


def fits_layer(tile: AnyTile, layer: str) -> bool:
    """Whether the tile holds what this layer holds."""
    return isinstance(tile, FeatureTile) == is_feature_layer(layer)


def noun_of(tile: AnyTile | type[object]) -> str:
    """What the tile holds, for messages."""
    kind = tile if isinstance(tile, type) else type(tile)
    return "features" if kind is FeatureTile else "Gaussians"


def dated(tile: TileT, day: int) -> TileT:
    """The tile with its day; features have none."""
    return replace(tile, day=day) if isinstance(tile, Tile) and tile.day != day else tile


def day_of_tile(tile: AnyTile) -> int:
    """The day of a tile of Gaussians; `UNKNOWN_DAY` of features."""
    return tile.day if isinstance(tile, Tile) else UNKNOWN_DAY


def has_deltas(codec_id: int) -> bool:
    """Whether there is a short way to write what changed in content of this codec (floats have none)."""
    return codec_id in FEATURE_CODECS or lattice_of(codec_id) is not None


def encode_content(tile: AnyTile) -> tuple[int, bytes]:
    """Codec and body of the tile in the best codec that can express it; CodecError when there is too much in it."""
    if isinstance(tile, FeatureTile):
        return CODEC_FEATURES, encode_features(tile.features)
    codec_id = best_codec(tile.gaussians)
    return codec_id, codec_of(codec_id).encode(tile.tile_id, tile.gaussians)


def decode_content(tile_id: TileId, version: int, codec_id: int, body: bytes) -> AnyTile:
    """The tile in a body.

    Raises:
        CodecError: an unknown codec, or bytes that are none of it.
        MapError: values that are no tile.
    """
    if codec_id in FEATURE_CODECS:
        return FeatureTile(tile_id, version, decode_features(body))
    return Tile(tile_id, version, codec_of(codec_id).decode(tile_id, body))


def encode_content_delta(before: AnyTile, after: AnyTile) -> bytes:
    """What turns the content of one tile into that of another; CodecError between Gaussians and features."""
    if isinstance(before, FeatureTile) and isinstance(after, FeatureTile):
        return encode_feature_delta(before.features, after.features)
    if isinstance(before, Tile) and isinstance(after, Tile):
        return encode_delta(after.tile_id, before.gaussians, after.gaussians)
    raise _unlike(before, after)


def decode_content_delta(held: TileT, version: int, body: bytes) -> TileT:
    """The tile that a delta makes of the one held; compare its hash afterwards.

    Raises:
        CodecError: the bytes are no delta.
        DeltaError: they do not fit what is held.
    """
    after: AnyTile
    if isinstance(held, FeatureTile):
        after = FeatureTile(held.tile_id, version, decode_feature_delta(held.features, body))
    else:
        after = Tile(held.tile_id, version, decode_delta(held.tile_id, held.gaussians, body))
    return cast("TileT", after)


def changed_between(before: AnyTile, after: AnyTile) -> tuple[int, int]:
    """How many voxels or features the delta puts and removes; CodecError between Gaussians and features."""
    if isinstance(before, FeatureTile) and isinstance(after, FeatureTile):
        changes = diff_features(before.features, after.features)
        return len(changes.put), len(changes.removed)
    if isinstance(before, Tile) and isinstance(after, Tile):
        delta = diff(before.gaussians, after.gaussians)
        return len(delta.put), len(delta.removed)
    raise _unlike(before, after)


def _unlike(before: AnyTile, after: AnyTile) -> CodecError:
    return CodecError(f"tile {after.tile_id}: no delta from {noun_of(before)} to {noun_of(after)}")
