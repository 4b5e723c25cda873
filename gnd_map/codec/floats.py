"""Codec 0, float32 columns: what a content hash is made of.

Little-endian, the number of voxels N as uint32, then the columns one after the other,
float32 as they are: voxel_id i4[N], count i4[N], cells i4[N], mean x f4[N], y, z, cov xx f4[N], xy, xz, yy, yz, zz. 4 +
48·N bytes; -0.0 is written as 0.0.
"""

import struct

import numpy as np

from gnd.gnd_map.errors import CodecError, ShapeError
from gnd.gnd_map.gaussian import Gaussians

CODEC_FLOAT32 = 0
MAX_VOXELS = 200_000  # of one tile: 1209 columns x 165 floors
_HEAD = struct.Struct("<I")
_VOXEL_BYTES = 48
MAX_BODY_BYTES = _HEAD.size + MAX_VOXELS * _VOXEL_BYTES


def encode_gaussians(gaussians: Gaussians) -> bytes:
    """Codec 0 bytes; equal Gaussians give equal bytes.

    Raises:
        CodecError: more than MAX_VOXELS voxels.
    """
    check_number(len(gaussians))
    ints = np.stack([gaussians.voxel_id, gaussians.count, gaussians.cells]).astype("<i4")
    floats = (np.hstack([gaussians.mean_m, gaussians.cov_m2]).T + np.float32(0.0)).astype(
        "<f4"
    )  # + 0.0 turns -0.0 into 0.0
    return _HEAD.pack(len(gaussians)) + ints.tobytes() + floats.tobytes()


def decode_gaussians(body: bytes) -> Gaussians:
    """The Gaussians of codec 0 bytes.

    Raises:
        CodecError: truncated, too long, too many voxels, or values that are no Gaussians (NaN, unsorted, ...).
    """
    if len(body) < _HEAD.size:
        raise CodecError(f"encoded Gaussians: {len(body)} bytes, fewer than the {_HEAD.size} of the head")
    (n,) = _HEAD.unpack_from(body)
    check_number(n)
    if len(body) != _HEAD.size + n * _VOXEL_BYTES:
        raise CodecError(
            f"encoded Gaussians: {len(body)} bytes, expected {_HEAD.size + n * _VOXEL_BYTES} for {n} voxels"
        )
    ints = np.frombuffer(body, "<i4", 3 * n, _HEAD.size).reshape(3, n).astype(np.int32)
    floats = np.frombuffer(body, "<f4", 9 * n, _HEAD.size + 12 * n).reshape(9, n).T.astype(np.float32)
    mean, cov = np.ascontiguousarray(floats[:, :3]), np.ascontiguousarray(floats[:, 3:])
    try:
        return Gaussians(ints[0].copy(), ints[1].copy(), ints[2].copy(), mean, cov)
    except ShapeError as error:
        raise CodecError(f"encoded Gaussians: {error}") from error


def check_number(n: int) -> None:
    """`CodecError` when a tile may not hold so many voxels."""
    if n > MAX_VOXELS:
        raise CodecError(f"{n} voxels are more than the {MAX_VOXELS} that a tile may hold")
