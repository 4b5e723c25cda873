"""Update notices: a tile has a new version, with what changed."""

from dataclasses import dataclass
from typing import Final, Literal, cast

import numpy as np

from gnd.gnd_map.codec import CODEC_FLOAT32, codec_of, encode_gaussians
from gnd.gnd_map.content import TileT, dated
from gnd.gnd_map.day import UNKNOWN_DAY
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.tile import Tile, TileDelta, apply
from gnd.gnd_map.tile_id import TileId
from gnd.schemas import limits
from gnd.schemas.errors import BadValue, WrongHash
from gnd.schemas.generated import tile_delta_pb2, tile_update_pb2
from gnd.schemas.tiles import check_day, check_hash, tile_from_delta
from gnd.schemas.version_signature import check_seconds
from gnd.schemas.wire import (
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
    """What turns the previous content into the new one, in plain columns; None = see `coded_delta`."""
    coded_delta: bytes = b""
    """The same by `gnd.gnd_map.content.encode_content_delta`; with neither, ask for what has changed."""
    put_voxels: int = 0
    """Voxels or features that come or are replaced by `coded_delta`."""
    removed_voxels: int = 0
    """Voxels or features that go by `coded_delta`."""
    day: int = UNKNOWN_DAY
    """When the world looked as the new version says (`gnd.gnd_map.day`)."""
    put_count: int = 0
    """Voxels or features that come or are replaced, where the notice has no delta to tell."""
    removed_count: int = 0
    """Voxels or features that go, where the notice has no delta to tell."""
    made_s: int = 0
    """When the new version was made, POSIX seconds; 0 = not told (versions are not signed)."""

    def __post_init__(self) -> None:
        check_text("layer", self.layer, LAYER_PATTERN)
        check_version("tile version", self.version, lowest=1)
        check_sha("tile sha", self.sha)
        check_pair("previous", self.previous_version, self.previous_sha)
        check_word(self.reason, _REASON, "update reason")
        _check_removed(0 if self.delta is None else len(self.delta.removed))
        check_length(f"delta of tile {self.tile}", len(self.coded_delta), limits.MAX_TILE_BODY_BYTES, "bytes")
        self._check_coded()
        self._check_counts()
        check_day(self.day)
        check_seconds(self.made_s)
        if self.previous_version >= self.version:
            raise BadValue(f"update of tile {self.tile} to version {self.version} from {self.previous_version}")

    def _check_coded(self) -> None:
        if self.coded_delta and self.delta is not None:
            raise BadValue(f"update of tile {self.tile} with a plain and a coded delta: one of them")
        if max(self.put_voxels, self.removed_voxels) > limits.MAX_REMOVED_VOXELS or (
            not self.coded_delta and (self.put_voxels or self.removed_voxels)
        ):
            raise BadValue(
                f"update of tile {self.tile} puts {self.put_voxels} and removes {self.removed_voxels} voxels by"
                f" {len(self.coded_delta)} coded bytes: at most {limits.MAX_REMOVED_VOXELS}, none without a delta"
            )

    def _check_counts(self) -> None:
        told = self.put_count, self.removed_count
        if max(told) > limits.MAX_REMOVED_VOXELS or (self.has_delta and any(told)):
            raise BadValue(
                f"update of tile {self.tile} counts {told} voxels beside its delta or more than"
                f" {limits.MAX_REMOVED_VOXELS}"
            )

    @property
    def has_delta(self) -> bool:
        """Whether it says what has changed; else that is to be asked for."""
        return self.delta is not None or bool(self.coded_delta)

    def follows(self, sha: bytes) -> bool:
        """Whether it says what has changed since the version of that hash."""
        return self.has_delta and self.previous_sha == sha

    @property
    def voxels(self) -> tuple[int, int] | None:
        """(put, removed) by this version; None where the notice does not tell."""
        if self.delta is not None:
            return len(self.delta.put), len(self.delta.removed)
        if self.coded_delta:
            return self.put_voxels, self.removed_voxels
        told = self.put_count, self.removed_count
        return told if any(told) else None

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
            coded_delta=self.coded_delta,
            put_voxels=self.put_voxels,
            removed_voxels=self.removed_voxels,
            day=self.day,
            put_count=self.put_count,
            removed_count=self.removed_count,
            made_s=self.made_s,
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
            delta = _delta_value(tile, message.delta) if message.HasField("delta") else None
        return cls(
            tile=tile,
            layer=message.layer,
            version=message.version,
            previous_version=message.previous_version,
            sha=message.sha,
            previous_sha=message.previous_sha,
            reason=word_of(message.reason, _REASON, "update reason"),
            delta=delta,
            coded_delta=message.coded_delta,
            put_voxels=message.put_voxels,
            removed_voxels=message.removed_voxels,
            day=message.day,
            put_count=message.put_count,
            removed_count=message.removed_count,
            made_s=message.made_s,
        )


def updated(update: TileUpdate, held: TileT) -> TileT:
    """The tile that a notice makes of the version before it.

    Raises:
        WrongHash: the notice has no delta, or its delta does not fit what is held, or what comes out has not the
            notice's hash: fetch the tile.
    """
    name = f"update of tile {update.tile} to version {update.version}"
    if not update.has_delta:
        raise WrongHash(f"{name} has no delta; fetch the tile")
    if update.delta is None:
        return dated(tile_from_delta(update.tile, update.version, update.coded_delta, held, update.sha), update.day)
    if not isinstance(held, Tile):
        raise WrongHash(f"{name} has a delta of Gaussians, held are features; fetch the tile")
    try:
        tile = Tile(update.tile, update.version, apply(held.gaussians, update.delta), update.day)
    except GndError as error:
        raise WrongHash(f"{name} does not fit version {held.version}: {error}; fetch the tile") from error
    check_hash(name, tile, update.sha)
    return cast("TileT", tile)


def _delta_message(delta: TileDelta) -> tile_delta_pb2.TileDelta:
    return tile_delta_pb2.TileDelta(
        removed=delta.removed.tolist(), codec_id=CODEC_FLOAT32, put=encode_gaussians(delta.put)
    )


def _delta_value(tile: TileId, message: tile_delta_pb2.TileDelta) -> TileDelta:
    _check_removed(len(message.removed))
    return TileDelta(np.array(message.removed, np.int32), codec_of(message.codec_id).decode(tile, message.put))


def _check_removed(count: int) -> None:
    check_length("delta", count, limits.MAX_REMOVED_VOXELS, "removed voxels")
