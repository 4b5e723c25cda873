"""Columns through Zstandard: the simple codecs, which any Zstandard library can undo.

A body is, little-endian: the number of voxels N (uint32), a CRC-32 (uint32) of codec id (1 byte), tile id (8 bytes), N
(4 bytes) and the frame, then one Zstandard frame of byte planes (none where N is 0). A column of k-byte values becomes
k planes of N bytes, least significant first, one after the other.

Codec 1 holds codec 0's columns: voxel id (differences), count, cells as int32, means and covariances as float32; -0.0
is written as 0.0. Codecs 5, 6, 7 hold the integers of a lattice (`gnd.gnd_map.codec.lattice`): voxel id (differences, 4
bytes), axis, levels (1), slopes, steps (2), count (1). The first voxel id and slopes and steps, which may be
negative, are zigzag numbers: 0, -1, 1, -2, 2 … as 0, 1, 2, 3, 4 …
"""

import struct
import zlib
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt
import zstandard

from gnd.gnd_map.arrays import I32
from gnd.gnd_map.codec.floats import check_number
from gnd.gnd_map.codec.lattice import Lattice, Quantised, dequantise, integers_of
from gnd.gnd_map.errors import CodecError, ShapeError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId

U8 = npt.NDArray[np.uint8]
_FLOAT32_ZSTD: Final = 1
LEVEL: Final = 9
"""Of compression: higher ones save 4 % for four times the time."""
MAX_WINDOW_BYTES: Final = 1 << 24
_HEAD: Final = struct.Struct("<II")
_FLOAT_WIDTHS: Final = (4,) * 12
_LATTICE_WIDTHS: Final = (4, 1, 1, 1, 1, 2, 2, 2, 2, 2, 2, 1)


def encode_float_columns(tile_id: TileId, gaussians: Gaussians) -> bytes:
    """Codec 1.

    Raises:
        CodecError: more voxels than a tile may hold.
    """
    floats = np.hstack([gaussians.mean_m, gaussians.cov_m2]) + np.float32(0.0)  # + 0.0 turns -0.0 into 0.0
    columns = [_steps_of(gaussians.voxel_id), gaussians.count, gaussians.cells, *floats.T]
    return _sealed(_FLOAT32_ZSTD, tile_id, len(gaussians), _planes(columns, _FLOAT_WIDTHS))


def decode_float_columns(tile_id: TileId, body: bytes) -> Gaussians:
    """The Gaussians of codec 1 bytes.

    Raises:
        CodecError: damaged, truncated, too long, of another tile or codec, or values that are no Gaussians.
    """
    columns = _columns(*_opened(_FLOAT32_ZSTD, tile_id, body, _FLOAT_WIDTHS), _FLOAT_WIDTHS)
    count, cells = (column.view(np.int32) for column in columns[1:3])
    floats = np.stack([column.view(np.float32) for column in columns[3:]], axis=1)
    mean_m, cov_m2 = np.ascontiguousarray(floats[:, :3]), np.ascontiguousarray(floats[:, 3:])
    try:
        return Gaussians(_ids_of(columns[0]), count, cells, mean_m, cov_m2)
    except ShapeError as error:
        raise CodecError(f"float columns of tile {tile_id}: {error}") from error


def encode_lattice_columns(codec_id: int, lattice: Lattice, tile_id: TileId, gaussians: Gaussians) -> bytes:
    """Codecs 5, 6, 7.

    Raises:
        CodecError: not on the lattice, or more voxels than a tile may hold.
    """
    q = integers_of(gaussians, lattice)
    signed = [_zigzag(column) for column in (*q.slope.T, *q.step.T)]
    columns = [_steps_of(q.voxel_id), q.axis, *q.level.T, *signed, q.count]
    return _sealed(codec_id, tile_id, len(q), _planes(columns, _LATTICE_WIDTHS))


def decode_lattice_columns(codec_id: int, lattice: Lattice, tile_id: TileId, body: bytes) -> Gaussians:
    """The Gaussians of the bytes of codecs 5, 6, 7.

    Raises:
        CodecError: damaged, truncated, too long, of another tile or codec, or not on the lattice.
    """
    columns = _columns(*_opened(codec_id, tile_id, body, _LATTICE_WIDTHS), _LATTICE_WIDTHS)
    axis, *level = (column.astype(np.int32) for column in columns[1:5])
    signed = [_unzigzag(column) for column in columns[5:11]]
    slope, step = np.stack(signed[:3], axis=1), np.stack(signed[3:], axis=1)
    quantised = Quantised(_ids_of(columns[0]), axis, np.stack(level, axis=1), slope, step, columns[11].astype(np.int32))
    return dequantise(quantised, lattice)


# --- the frame and its seal ------------------------------------------------------------------------------------------


def seal(codec_id: int, tile_id: TileId, n: int, frame: bytes) -> bytes:
    """A body: head with checksum, then the frame."""
    return _HEAD.pack(n, _checksum(codec_id, tile_id, n, frame)) + frame


def _checksum(codec_id: int, tile_id: TileId, n: int, frame: bytes) -> int:
    return zlib.crc32(frame, zlib.crc32(struct.pack("<BQI", codec_id, tile_id.morton, n)))


def _sealed(codec_id: int, tile_id: TileId, n: int, planes: bytes) -> bytes:
    check_number(n)
    compressor = zstandard.ZstdCompressor(level=LEVEL, write_content_size=False, write_checksum=False)
    return seal(codec_id, tile_id, n, compressor.compress(planes) if n else b"")


def _opened(codec_id: int, tile_id: TileId, body: bytes, widths: Sequence[int]) -> tuple[int, bytes]:
    """Number of voxels and their planes, no more bytes than that number allows."""
    if len(body) < _HEAD.size:
        raise CodecError(f"codec {codec_id}: {len(body)} bytes, fewer than the {_HEAD.size} of the head")
    n, checksum = _HEAD.unpack_from(body)
    check_number(n)
    frame = body[_HEAD.size :]
    found = _checksum(codec_id, tile_id, n, frame)
    if found != checksum:
        raise CodecError(
            f"codec {codec_id}: checksum {found:08x}, expected {checksum:08x}: damaged, or not of tile {tile_id}"
        )
    return n, _decompressed(frame, n * sum(widths))


def _decompressed(frame: bytes, size: int) -> bytes:
    """The content of a frame, which must be `size` bytes; a frame that says otherwise is not even opened."""
    if not size:
        if frame:
            raise CodecError(f"{len(frame)} bytes follow a head of 0 voxels")
        return b""
    try:
        said = zstandard.get_frame_parameters(frame)
        if said.content_size not in (zstandard.CONTENTSIZE_UNKNOWN, size):
            raise CodecError(f"Zstandard frame of {said.content_size} bytes, expected {size}")
        if said.window_size > MAX_WINDOW_BYTES:
            raise CodecError(f"Zstandard window of {said.window_size} bytes, at most {MAX_WINDOW_BYTES}")
        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES)
        content = decompressor.decompress(frame, max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise CodecError(f"Zstandard frame of {len(frame)} bytes: {error}") from error
    if len(content) != size:
        raise CodecError(f"Zstandard frame of {len(content)} bytes, expected {size}")
    return content


# --- columns and planes ----------------------------------------------------------------------------------------------


def _planes(columns: Sequence[npt.NDArray[np.generic]], widths: Sequence[int]) -> bytes:
    """Byte planes of columns (N,) of integers that fit their widths, or of float32."""
    pairs = zip(columns, widths, strict=True)
    narrow = (np.ascontiguousarray(c if c.dtype == np.float32 else c.astype(f"<i{w}")) for c, w in pairs)
    return b"".join(c.view(np.uint8).reshape(len(c), c.itemsize).T.tobytes() for c in narrow)


def _columns(n: int, planes: bytes, widths: Sequence[int]) -> list[npt.NDArray[np.unsignedinteger]]:
    """The columns (N,) of planes, unsigned of their widths."""
    rows = np.frombuffer(planes, np.uint8).reshape(sum(widths), n)
    stops = np.cumsum(widths).tolist()
    return [rows[s - w : s].T.copy(order="C").view(f"<u{w}").ravel() for s, w in zip(stops, widths, strict=True)]


def _steps_of(voxel_id: I32) -> npt.NDArray[np.uint32]:
    """(N,) the first id as zigzag number, then differences, modulo 2^32."""
    ids = voxel_id.astype(np.int64)
    steps = np.diff(ids, prepend=0)
    if len(steps):
        steps[0] = 2 * ids[0] if ids[0] >= 0 else -2 * ids[0] - 1
    return steps.astype(np.uint32)


def _ids_of(steps: npt.NDArray[np.unsignedinteger]) -> I32:
    """The inverse of `_steps_of`.

    Raises:
        CodecError: ids that do not increase, or beyond 32 bits.
    """
    wide = steps.astype(np.int64)
    if len(wide):
        wide[0] = _unzigzag(steps[:1])[0]
    ids = np.cumsum(wide)
    if len(ids) and (int(wide[1:].min(initial=1)) < 1 or int(ids[-1]) > np.iinfo(np.int32).max):
        raise CodecError(f"voxel ids up to {ids[-1]} do not increase within 32 bits")
    return ids.astype(np.int32)


def _zigzag(column: I32) -> I32:
    return (column << 1) ^ (column >> 31)


def _unzigzag(column: npt.NDArray[np.unsignedinteger]) -> I32:
    wide = column.astype(np.int64)
    return ((wide >> 1) ^ -(wide & 1)).astype(np.int32)
