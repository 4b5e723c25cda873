"""A tile's Gaussians on a lattice as bytes. First form: integer columns, deflated; the range coder follows."""

import zlib

import numpy as np

from gnd_map.codec.lattice import Lattice, Quantised, dequantise, integers_of
from gnd_map.errors import CodecError
from gnd_map.gaussian import Gaussians
from gnd_map.tile_id import TileId


def encode_tile(tile_id: TileId, gaussians: Gaussians, lattice: Lattice) -> bytes:
    """Bytes of the Gaussians; CodecError where they do not lie on the lattice."""
    return pack(integers_of(gaussians, lattice))


def decode_tile(tile_id: TileId, body: bytes, lattice: Lattice) -> Gaussians:
    """The Gaussians of the bytes; CodecError where they are none."""
    return dequantise(unpack(body), lattice)


def pack(q: Quantised) -> bytes:
    """Integer columns, deflated."""
    columns = np.column_stack([q.voxel_id, q.axis, q.level, q.slope, q.step, q.count]).astype("<i4")
    return zlib.compress(columns.T.tobytes(), 9)


def unpack(body: bytes) -> Quantised:
    """The integer columns of `pack`."""
    unpacker = zlib.decompressobj()
    try:
        raw = unpacker.decompress(body, 200_000 * 48)
    except zlib.error as error:
        raise CodecError(f"{len(body)} bytes are no packed Gaussians: {error}") from error
    if not unpacker.eof or len(raw) % 48:
        raise CodecError(f"{len(body)} bytes are truncated or unpack to {len(raw)} bytes")
    c = np.frombuffer(raw, "<i4").reshape(12, -1).astype(np.int32).T
    parts = (c[:, 0], c[:, 1], c[:, 2:5], c[:, 5:8], c[:, 8:11], c[:, 11])
    return Quantised(*(np.ascontiguousarray(part) for part in parts))
