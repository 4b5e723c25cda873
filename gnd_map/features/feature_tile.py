"""A version of a tile of a feature layer, and the deltas between versions."""

import hashlib
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from gnd.gnd_map.errors import CodecError, DeltaError, FeatureError
from gnd.gnd_map.features.feature import MAX_ID, MAX_PART, Feature, snapped
from gnd.gnd_map.features.feature_codec import (
    MAX_FEATURES_OF_TILE,
    Reader,
    check_features,
    checked,
    decode_features,
    encode_features,
    put_numbers,
)
from gnd.gnd_map.tile_id import TileId

_DELTA_FORMAT: Final = 2


@dataclass(frozen=True, slots=True)
class FeatureTile:
    """One published state of a tile of a feature layer; `FeatureTile.of` makes one of any features."""

    tile_id: TileId
    """Which tile."""
    version: int
    """1, 2, 3 … as the store counts; 0 = not published."""
    features: tuple[Feature, ...]
    """Snapped, sorted by (id, part), none twice."""

    def __post_init__(self) -> None:
        if self.version < 0:
            raise FeatureError(f"tile {self.tile_id}: version {self.version} is negative")
        check_features(self.features)
        coarse = [feature.feature_id for feature in self.features if snapped(feature) != feature]
        if coarse:
            raise FeatureError(f"tile {self.tile_id}: {len(coarse)} features are not snapped, first {coarse[0]}")

    @classmethod
    def of(cls, tile_id: TileId, version: int, features: Iterable[Feature]) -> "FeatureTile":
        """The tile of any features of it: snapped and sorted.

        Raises:
            CodecError: two have the same id and part, or there are too many.
        """
        return cls(tile_id, version, tuple(sorted(map(snapped, features), key=lambda feature: feature.key)))

    @property
    def sha(self) -> bytes:
        """32 bytes: SHA-256 of the tile id (8 bytes little-endian) and the encoded features, not of the version."""
        return hashlib.sha256(self.tile_id.morton.to_bytes(8, "little") + encode_features(self.features)).digest()


@dataclass(frozen=True, slots=True)
class FeatureDelta:
    """What turns the features of one version into those of another."""

    removed: tuple[tuple[int, int], ...]
    """(id, part) of what goes, sorted."""
    put: tuple[Feature, ...]
    """What comes or is replaced, sorted."""

    def __post_init__(self) -> None:
        if list(self.removed) != sorted(set(self.removed)):
            raise DeltaError(f"delta: the {len(self.removed)} removed features are not sorted, or one comes twice")
        check_features(self.put)
        both = set(self.removed) & {feature.key for feature in self.put}
        if both:
            raise DeltaError(f"delta: {len(both)} features are both removed and put")

    def __len__(self) -> int:
        return len(self.removed) + len(self.put)


def diff_features(old: Sequence[Feature], new: Sequence[Feature]) -> FeatureDelta:
    """The smallest delta with apply_features(old, delta) == new."""
    before = {feature.key: feature for feature in old}
    there = {feature.key for feature in new}
    return FeatureDelta(
        tuple(sorted(key for key in before if key not in there)),
        tuple(feature for feature in new if before.get(feature.key) != feature),
    )


def apply_features(old: Sequence[Feature], delta: FeatureDelta) -> tuple[Feature, ...]:
    """The features after the delta.

    Raises:
        DeltaError: a feature to remove is not there.
    """
    after = {feature.key: feature for feature in old}
    absent = [key for key in delta.removed if after.pop(key, None) is None]
    if absent:
        raise DeltaError(
            f"delta: {len(absent)} of {len(delta.removed)} features to remove are absent, first {absent[0]}"
        )
    after |= {feature.key: feature for feature in delta.put}
    return tuple(after[key] for key in sorted(after))


def encode_feature_delta(old: Sequence[Feature], new: Sequence[Feature]) -> bytes:
    """What turns `old` into `new` as bytes; both are features of published tiles."""
    delta = diff_features(old, new)
    out = bytearray([_DELTA_FORMAT])
    put_numbers(out, len(delta.removed), *(number for key in delta.removed for number in key))
    out += encode_features(delta.put)
    return bytes(out) + zlib.crc32(out).to_bytes(4, "little")


def decode_feature_delta(old: Sequence[Feature], body: bytes) -> tuple[Feature, ...]:
    """The features that the bytes of `encode_feature_delta` make of `old`; compare their tile's hash afterwards.

    Raises:
        CodecError: the bytes are no delta.
        DeltaError: they do not fit `old`.
    """
    return apply_features(old, read_feature_delta(body))


def read_feature_delta(body: bytes) -> FeatureDelta:
    """The delta in the bytes of `encode_feature_delta`; `CodecError` when they are none."""
    reader = Reader(checked(body, _DELTA_FORMAT))
    n = reader.at_most(MAX_FEATURES_OF_TILE, "removed features")
    removed = tuple((reader.at_most(MAX_ID, "as id"), reader.at_most(MAX_PART, "as part")) for _ in range(n))
    put = decode_features(reader.rest())
    try:
        return FeatureDelta(removed, put)
    except DeltaError as error:
        raise CodecError(f"encoded delta: {error}") from error
