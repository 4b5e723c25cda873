"""The codecs by their ids. A codec id never changes its meaning; clients say which ids they read."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from gnd.gnd_map.codec.floats import CODEC_FLOAT32, decode_gaussians, encode_gaussians
from gnd.gnd_map.codec.lattice import ARCHIVE, COMPACT, STANDARD, Lattice, is_on
from gnd.gnd_map.codec.range_tile import decode_tile, decode_tile_by_set, encode_tile, encode_tile_by_set
from gnd.gnd_map.codec.rans_tile import decode_tile_by_sums, encode_tile_by_sums
from gnd.gnd_map.codec.zstd_columns import (
    decode_float_columns,
    decode_lattice_columns,
    encode_float_columns,
    encode_lattice_columns,
)
from gnd.gnd_map.errors import CodecError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId

CODEC_FLOAT32_ZSTD = 1
CODEC_ARCHIVE, CODEC_STANDARD, CODEC_COMPACT = 2, 3, 4
CODEC_ARCHIVE_ZSTD, CODEC_STANDARD_ZSTD, CODEC_COMPACT_ZSTD = 5, 6, 7
CODEC_ARCHIVE_SETS, CODEC_STANDARD_SETS, CODEC_COMPACT_SETS = 8, 9, 10
CODEC_ARCHIVE_SUMS, CODEC_STANDARD_SUMS, CODEC_COMPACT_SUMS = 11, 12, 13

Encode = Callable[[TileId, Gaussians], bytes]
Decode = Callable[[TileId, bytes], Gaussians]


@dataclass(frozen=True, slots=True)
class Codec:
    """One way to write the Gaussians of a tile as bytes, without loss of what it can express."""

    codec_id: int
    """Number on the wire, never reused."""
    name: str
    """For messages and tables."""
    encode: Encode
    """Gaussians of a tile to bytes; raises CodecError where it cannot express them."""
    decode: Decode
    """Bytes to Gaussians; raises CodecError."""
    lattice: Lattice | None = None
    """Where its Gaussians lie; None = anywhere."""


def _range_codec(codec_id: int, lattice: Lattice) -> Codec:
    def encode(tile_id: TileId, gaussians: Gaussians) -> bytes:
        return encode_tile(tile_id, gaussians, lattice)

    def decode(tile_id: TileId, body: bytes) -> Gaussians:
        return decode_tile(tile_id, body, lattice)

    return Codec(codec_id, f"{lattice.name}, range coded", encode, decode, lattice)


def _sets_codec(codec_id: int, lattice: Lattice) -> Codec:
    def encode(tile_id: TileId, gaussians: Gaussians) -> bytes:
        return encode_tile_by_set(tile_id, gaussians, lattice)

    def decode(tile_id: TileId, body: bytes) -> Gaussians:
        return decode_tile_by_set(tile_id, body, lattice)

    return Codec(codec_id, f"{lattice.name}, range coded by sets", encode, decode, lattice)


def _sums_codec(codec_id: int, lattice: Lattice) -> Codec:
    def encode(tile_id: TileId, gaussians: Gaussians) -> bytes:
        return encode_tile_by_sums(tile_id, gaussians, lattice)

    def decode(tile_id: TileId, body: bytes) -> Gaussians:
        return decode_tile_by_sums(tile_id, body, lattice)

    return Codec(codec_id, f"{lattice.name}, by sums", encode, decode, lattice)


def _zstd_codec(codec_id: int, lattice: Lattice) -> Codec:
    def encode(tile_id: TileId, gaussians: Gaussians) -> bytes:
        return encode_lattice_columns(codec_id, lattice, tile_id, gaussians)

    def decode(tile_id: TileId, body: bytes) -> Gaussians:
        return decode_lattice_columns(codec_id, lattice, tile_id, body)

    return Codec(codec_id, f"{lattice.name}, columns, Zstandard", encode, decode, lattice)


_ALL = (
    Codec(CODEC_FLOAT32, "float32 columns", lambda _, g: encode_gaussians(g), lambda _, body: decode_gaussians(body)),
    Codec(CODEC_FLOAT32_ZSTD, "float32 columns, Zstandard", encode_float_columns, decode_float_columns),
    _range_codec(CODEC_ARCHIVE, ARCHIVE),
    _range_codec(CODEC_STANDARD, STANDARD),
    _range_codec(CODEC_COMPACT, COMPACT),
    _zstd_codec(CODEC_ARCHIVE_ZSTD, ARCHIVE),
    _zstd_codec(CODEC_STANDARD_ZSTD, STANDARD),
    _zstd_codec(CODEC_COMPACT_ZSTD, COMPACT),
    _sets_codec(CODEC_ARCHIVE_SETS, ARCHIVE),
    _sets_codec(CODEC_STANDARD_SETS, STANDARD),
    _sets_codec(CODEC_COMPACT_SETS, COMPACT),
    _sums_codec(CODEC_ARCHIVE_SUMS, ARCHIVE),
    _sums_codec(CODEC_STANDARD_SUMS, STANDARD),
    _sums_codec(CODEC_COMPACT_SUMS, COMPACT),
)
CODECS: Mapping[int, Codec] = MappingProxyType({codec.codec_id: codec for codec in _ALL})
_ZSTD = (CODEC_COMPACT_ZSTD, CODEC_STANDARD_ZSTD, CODEC_ARCHIVE_ZSTD, CODEC_FLOAT32_ZSTD)
_SUMS = (CODEC_COMPACT_SUMS, CODEC_STANDARD_SUMS, CODEC_ARCHIVE_SUMS)
PREFERRED = tuple(sorted(set(CODECS) - set(_SUMS), key=lambda i: (i == CODEC_FLOAT32 or i in _ZSTD, -i)))
"""The ids by which tiles are stored and asked for, smallest bodies first."""
QUICK = (*_SUMS, *PREFERRED)
"""All ids that this program reads, those first that need less time and more bytes: for who asks with time to save."""
RANGE_CODECS = (
    CODEC_ARCHIVE, CODEC_STANDARD, CODEC_COMPACT, CODEC_ARCHIVE_SETS, CODEC_STANDARD_SETS, CODEC_COMPACT_SETS
)  # fmt: skip
"""Written decision by decision, each in its contexts."""
DELTA_CODECS = (*RANGE_CODECS, *_SUMS)
"""Who reads one of these reads the deltas of its lattice, which are coded as in `RANGE_CODECS`."""


def codec_of(codec_id: int) -> Codec:
    """The codec with this id.

    Raises:
        CodecError: there is none; the message lists those there are.
    """
    if codec_id not in CODECS:
        raise CodecError(f"codec {codec_id} is unknown; known: {', '.join(map(str, CODECS))}")
    return CODECS[codec_id]


def lattice_of(codec_id: int) -> Lattice | None:
    """The lattice on which the Gaussians of this codec lie; None = anywhere. CodecError for an unknown id."""
    return codec_of(codec_id).lattice


def best_codec(gaussians: Gaussians, known: Sequence[int] = PREFERRED) -> int:
    """The first id of `known` that can express the Gaussians.

    Raises:
        CodecError: none of them can.
    """
    for codec_id in known:
        codec = CODECS.get(codec_id)
        if codec is not None and (codec.lattice is None or is_on(gaussians, codec.lattice)):
            return codec_id
    raise CodecError(f"none of the codecs {', '.join(map(str, known))} can express these {len(gaussians)} Gaussians")
