"""Codec 32: the features of a tile as bytes, equal features in equal bytes.

A byte with the format's number, then variable-length integers (seven bits a byte, lowest first; signed ones zigzag):
the words in use (kinds, keys and values of attributes), sorted, each its length and UTF-8; the features, sorted by id
and part, each: id, 4 · part + cuts, kind, hits, vehicles, masses (∃, ∄, conflict in 1/10000), levels of the covariance,
attributes, points in millimetres, each relative to the one before. A CRC-32 ends it.
"""

import zlib
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Final

import numpy as np

from gnd.gnd_map.errors import CodecError, GndError
from gnd.gnd_map.features.covariance import MAX_RATIO_STEPS, TOP_LEVEL, covariance_of, levels_of
from gnd.gnd_map.features.feature import (
    M_PER_STEP,
    MASS_STEPS,
    MAX_ATTRIBUTES,
    MAX_COUNT,
    MAX_ID,
    MAX_PART,
    MAX_POINTS_OF_FEATURE,
    MAX_REACH_M,
    MAX_VALUE_CHARACTERS,
    Feature,
    existence_of_steps,
)

CODEC_FEATURES: Final = 32
MAX_FEATURES_OF_TILE: Final = 4096
MAX_POINTS_OF_TILE: Final = 65_536
_MAX_WORDS: Final = 65_536
_MAX_WORD_BYTES: Final = 4 * MAX_VALUE_CHARACTERS
_FORMAT: Final = 1
_CRC_BYTES: Final = 4
_MAX_STEPS: Final = 2 * round(MAX_REACH_M / M_PER_STEP)


def encode_features(features: Sequence[Feature]) -> bytes:
    """The bytes of features that are snapped and sorted by (id, part).

    Raises:
        CodecError: unsorted, one twice, or more than a tile may hold.
    """
    check_features(features)
    words = sorted({word for feature in features for word in _words_of(feature)})
    number = {word: i for i, word in enumerate(words)}
    out = bytearray([_FORMAT])
    _put_words(out, words)
    put_numbers(out, len(features))
    for feature in features:
        _put_feature(out, feature, number)
    return bytes(out) + zlib.crc32(out).to_bytes(_CRC_BYTES, "little")


def decode_features(body: bytes) -> tuple[Feature, ...]:
    """The features of `encode_features`.

    Raises:
        CodecError: truncated, too long, of another format, damaged, or values that are no features.
    """
    reader = Reader(checked(body, _FORMAT))
    try:
        words = _words(reader)
        features = tuple(_feature(reader, words) for _ in range(reader.at_most(MAX_FEATURES_OF_TILE, "features")))
        reader.finish()
        check_features(features)
    except CodecError:
        raise
    except GndError as error:
        raise CodecError(f"encoded features: {error}") from error
    return features


def check_features(features: Sequence[Feature]) -> None:
    """`CodecError` unless the features are sorted by (id, part), none twice, and no more than a tile may hold."""
    keys = [feature.key for feature in features]
    if any(before >= after for before, after in pairwise(keys)):
        raise CodecError(f"{len(keys)} features are not sorted by id and part, or one comes twice")
    n_points = sum(len(feature.points_m) for feature in features)
    if len(keys) > MAX_FEATURES_OF_TILE or n_points > MAX_POINTS_OF_TILE:
        raise CodecError(
            f"{len(keys)} features with {n_points} points; a tile holds at most {MAX_FEATURES_OF_TILE} with "
            f"{MAX_POINTS_OF_TILE}"
        )


def checked(body: bytes, form: int) -> bytes:
    """The payload between the format's byte and the checksum; `CodecError` where one of them is wrong."""
    if len(body) < 1 + _CRC_BYTES:
        raise CodecError(f"encoded features: {len(body)} bytes, fewer than {1 + _CRC_BYTES}")
    payload, crc = body[:-_CRC_BYTES], int.from_bytes(body[-_CRC_BYTES:], "little")
    if payload[0] != form:
        raise CodecError(f"encoded features of format {payload[0]}, expected {form}")
    if zlib.crc32(payload) != crc:
        raise CodecError(
            f"encoded features: {len(body)} bytes with checksum {zlib.crc32(payload):08x}, said is {crc:08x}"
        )
    return payload[1:]


def _words_of(feature: Feature) -> Iterable[str]:
    yield feature.kind
    for pair in feature.attributes:
        yield from pair


def _put_words(out: bytearray, words: Sequence[str]) -> None:
    put_numbers(out, len(words))
    for word in words:
        said = word.encode()
        put_numbers(out, len(said))
        out += said


def _words(reader: "Reader") -> list[str]:
    return [reader.word() for _ in range(reader.at_most(_MAX_WORDS, "words"))]


def _put_feature(out: bytearray, feature: Feature, number: dict[str, int]) -> None:
    masses = (
        round(m * MASS_STEPS) for m in (feature.existence.exist, feature.existence.absent, feature.existence.conflict)
    )
    put_numbers(
        out, feature.feature_id, 4 * feature.part + feature.cuts, number[feature.kind], feature.hits, feature.vehicles
    )
    put_numbers(out, *masses)
    k0, k1, k2, *ratios = levels_of(feature.cov_m2)
    put_numbers(out, k0, k1, k2, *map(_zigzag, ratios))
    put_numbers(out, len(feature.attributes), *(number[word] for pair in feature.attributes for word in pair))
    steps = np.round(feature.points_m / M_PER_STEP).astype(np.int64)
    moves = np.diff(steps, axis=0, prepend=np.zeros((1, 3), np.int64)).ravel().tolist()
    put_numbers(out, len(steps), *map(_zigzag, moves))


def _feature(reader: "Reader", words: list[str]) -> Feature:
    feature_id = reader.at_most(MAX_ID, "as id")
    part, cuts = divmod(reader.at_most(4 * MAX_PART + 3, "as part"), 4)
    kind = reader.of(words)
    hits, vehicles = reader.at_most(MAX_COUNT, "hits"), reader.at_most(MAX_COUNT, "vehicles")
    exist, absent, conflict = (reader.at_most(MASS_STEPS, "as mass") for _ in range(3))
    k = [reader.at_most(TOP_LEVEL, "as level") for _ in range(3)]
    t = [reader.signed(MAX_RATIO_STEPS, "as ratio") for _ in range(3)]
    n_attributes = reader.at_most(MAX_ATTRIBUTES, "attributes")
    attributes = tuple((reader.of(words), reader.of(words)) for _ in range(n_attributes))
    n_points = reader.at_most(MAX_POINTS_OF_FEATURE, "points")
    moves = [reader.signed(_MAX_STEPS, "as coordinate") for _ in range(3 * n_points)]
    points_m = np.cumsum(np.array(moves, np.int64).reshape(n_points, 3), axis=0) / round(1 / M_PER_STEP)
    return Feature(
        feature_id=feature_id,
        kind=kind,
        points_m=points_m,
        cov_m2=covariance_of((k[0], k[1], k[2], t[0], t[1], t[2])),
        existence=existence_of_steps(exist, absent, conflict),
        attributes=attributes,
        part=part,
        cuts=cuts,
        hits=hits,
        vehicles=vehicles,
    )


def put_numbers(out: bytearray, *numbers: int) -> None:
    """Append numbers >= 0, each in as many bytes as it needs, seven bits a byte, lowest first."""
    for number in numbers:
        left = number
        while left >= 0x80:
            out.append(left & 0x7F | 0x80)
            left >>= 7
        out.append(left)


def _zigzag(number: int) -> int:
    return 2 * number if number >= 0 else -2 * number - 1


class Reader:
    """Reads what `_put` has written, never beyond the end."""

    def __init__(self, payload: bytes) -> None:
        self._payload, self._at = payload, 0

    def at_most(self, limit: int, what: str) -> int:
        """The next number; `CodecError` when it is larger than `limit` or the bytes end."""
        number = shift = 0
        while True:
            if self._at >= len(self._payload) or shift > 63:
                raise CodecError(f"encoded features end at byte {self._at}, or hold a number of more than 64 bits")
            byte = self._payload[self._at]
            self._at += 1
            number |= (byte & 0x7F) << shift
            shift += 7
            if byte < 0x80:
                break
        if number > limit:
            raise CodecError(f"encoded features: {number} {what}, the limit is {limit}")
        return number

    def signed(self, limit: int, what: str) -> int:
        """The next signed number, its magnitude at most `limit`."""
        number = self.at_most(2 * limit, what)
        return number >> 1 if number % 2 == 0 else -(number >> 1) - 1

    def of(self, words: list[str]) -> str:
        """The word that the next number means."""
        return words[self.at_most(len(words) - 1, "as word")]

    def word(self) -> str:
        """The next word: its length and UTF-8."""
        n = self.at_most(_MAX_WORD_BYTES, "bytes of a word")
        said = self._payload[self._at : self._at + n]
        self._at += n
        if len(said) < n:
            raise CodecError(f"encoded features end inside a word of {n} bytes")
        try:
            return said.decode()
        except UnicodeDecodeError as error:
            raise CodecError(f"encoded features: a word is no UTF-8: {error}") from error

    def rest(self) -> bytes:
        """The bytes that nobody has read yet."""
        return self._payload[self._at :]

    def finish(self) -> None:
        """`CodecError` when bytes are left."""
        if self._at != len(self._payload):
            raise CodecError(f"encoded features: {len(self._payload) - self._at} bytes too many")
