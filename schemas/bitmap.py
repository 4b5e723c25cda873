"""Which voxels a drive has observed, as a zlib-compressed bitmap from the first voxel id on."""

import zlib

import numpy as np

from gnd.gnd_map.arrays import I32
from gnd.schemas import limits
from gnd.schemas.errors import BadValue, Malformed, TooLarge

_LEVEL = 9
_SEARCHED_BYTES = 4096
"""zlib looks for repetitions in bitmaps up to so large, some 3 times that of a usual tile's; in larger ones for runs
only: in sparse ones of 128 KiB it would look for 0.15 s, and a report may hold many."""


def encode_observed(observed: I32) -> tuple[int, bytes]:
    """First voxel id and compressed bitmap of sorted unique voxel ids (K,) int32; none: (0, b"").

    Raises:
        TooLarge: the ids span more than a bitmap may.
    """
    if len(observed) == 0:
        return 0, b""
    first = int(observed[0])
    span = int(observed[-1]) - first + 1
    if span > 8 * limits.MAX_OBSERVED_BITMAP_BYTES:
        raise TooLarge(f"observed voxels span {span} ids, the limit is {8 * limits.MAX_OBSERVED_BITMAP_BYTES}")
    bits = np.zeros(span, np.uint8)
    bits[observed.astype(np.int64) - first] = 1
    data = np.packbits(bits, bitorder="little").tobytes()
    strategy = zlib.Z_DEFAULT_STRATEGY if len(data) <= _SEARCHED_BYTES else zlib.Z_RLE
    packer = zlib.compressobj(_LEVEL, strategy=strategy)
    return first, packer.compress(data) + packer.flush()


def decode_observed(first: int, compressed: bytes) -> I32:
    """The sorted voxel ids (K,) int32 of `encode_observed`, unpacking no more than the limit.

    Raises:
        SchemaError: not zlib, truncated, more bytes than a bitmap may have, ids beyond 32 bits.
    """
    if not compressed:
        return np.empty(0, np.int32)
    bitmap = np.frombuffer(_decompress(compressed), np.uint8)
    ids = np.flatnonzero(np.unpackbits(bitmap, bitorder="little")) + first
    if len(ids) and not -(2**31) <= int(ids[0]) <= int(ids[-1]) < 2**31:
        raise BadValue(f"observed voxels {ids[0]} .. {ids[-1]} do not fit 32 bits")
    return ids.astype(np.int32)


def _decompress(compressed: bytes) -> bytes:
    unpacker = zlib.decompressobj()
    try:
        data = unpacker.decompress(compressed, limits.MAX_OBSERVED_BITMAP_BYTES + 1)
    except zlib.error as error:
        raise Malformed(f"observed bitmap of {len(compressed)} bytes is not zlib data: {error}") from error
    if len(data) > limits.MAX_OBSERVED_BITMAP_BYTES:
        raise TooLarge(f"observed bitmap unpacks to more than {limits.MAX_OBSERVED_BITMAP_BYTES} bytes")
    if not unpacker.eof or unpacker.unused_data:
        raise Malformed(f"observed bitmap of {len(compressed)} bytes is truncated or has bytes behind its end")
    return data
