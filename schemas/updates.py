"""Update notices: a tile has a new version, with what changed."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from gnd_map.codec import CODEC_FLOAT32, codec_of, encode_gaussians
from gnd_map.tile import TileDelta
from gnd_map.tile_id import TileId
from schemas import limits
from schemas.errors import BadValue
from schemas.generated import tile_delta_pb2, tile_update_pb2
from schemas.wire import (
    LAYER_PATTERN,
    MAJOR,
    check_length,
    check_major,
    check_pair,
    check_sha,
    check_text,
    check_version,
    check_word,
    number_of,
    parse,
    refusing,
    serialise,
    tile_id,
    word_of,
)

UpdateReason = Literal["merged", "base", "rollback"]
_REASON: Final[dict[int, UpdateReason]] = {1: "merged", 2: "base", 3: "rollback"}


@dataclass(frozen=True, slots=True)
class TileUpdate:
    """The notice that a tile has a new version, sent after the commit."""

    tile: TileId
    layer: str
    version: int
    previous_version: int
    """0 = the tile is new."""
    sha: bytes
    previous_sha: bytes
    """Empty = the tile is new."""
    reason: UpdateReason
    delta: TileDelta | None = None
    """What turns the previous content into the new one; None = fetch the tile."""

    def __post_init__(self) -> None:
        check_text("layer", self.layer, LAYER_PATTERN)
        check_version("tile version", self.version, lowest=1)
        check_sha("tile sha", self.sha)
        check_pair("previous", self.previous_version, self.previous_sha)
        check_word(self.reason, _REASON, "update reason")
        _check_removed(0 if self.delta is None else len(self.delta.removed))
        if self.previous_version >= self.version:
            raise BadValue(f"update of tile {self.tile} to version {self.version} from {self.previous_version}")

    def encode(self) -> bytes:
        """Bytes of gnd.v1.TileUpdate."""
        message = tile_update_pb2.TileUpdate(
            major=MAJOR,
            tile=self.tile.morton,
            layer=self.layer,
            version=self.version,
            previous_version=self.previous_version,
            sha=self.sha,
            previous_sha=self.previous_sha,
            delta=None if self.delta is None else _delta_message(self.delta),
        )
        message.reason = tile_update_pb2.TileUpdate.Reason.ValueType(number_of(self.reason, _REASON))
        return serialise(message, limits.MAX_TILE_UPDATE_BYTES)

    @classmethod
    def decode(cls, data: bytes) -> "TileUpdate":
        """The value in `data`; `SchemaError` when it is none."""
        message = parse(tile_update_pb2.TileUpdate, data, limits.MAX_TILE_UPDATE_BYTES)
        check_major(message, "TileUpdate")
        tile = tile_id(message.tile)
        with refusing(f"update of tile {tile}"):
            delta = _delta_value(message.delta) if message.HasField("delta") else None
        return cls(
            tile=tile,
            layer=message.layer,
            version=message.version,
            previous_version=message.previous_version,
            sha=message.sha,
            previous_sha=message.previous_sha,
            reason=word_of(message.reason, _REASON, "update reason"),
            delta=delta,
        )


def _delta_message(delta: TileDelta) -> tile_delta_pb2.TileDelta:
    return tile_delta_pb2.TileDelta(
        removed=delta.removed.tolist(), codec_id=CODEC_FLOAT32, put=encode_gaussians(delta.put)
    )


def _delta_value(message: tile_delta_pb2.TileDelta) -> TileDelta:
    _check_removed(len(message.removed))
    return TileDelta(np.array(message.removed, np.int32), codec_of(message.codec_id).decode(message.put))


def _check_removed(count: int) -> None:
    check_length("delta", count, limits.MAX_REMOVED_VOXELS, "removed voxels")
