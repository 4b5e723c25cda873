"""Deltas and reports against Gaussians that both sides hold. First form: plain packing; the range coder follows."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gnd_map.arrays import I32, check_array
from gnd_map.classes import ChangeClass
from gnd_map.codec.floats import decode_gaussians, encode_gaussians
from gnd_map.codec.lattice import COMPACT, LATTICES, dequantise, integers_of, is_on, lattice_with
from gnd_map.codec.range_tile import pack, unpack
from gnd_map.errors import CodecError, ShapeError
from gnd_map.gaussian import Gaussians, concat
from gnd_map.tile_id import TileId

U8 = npt.NDArray[np.uint8]
_FLOATS = 255
FLAGGED = (ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED)


@dataclass(frozen=True, slots=True, eq=False)
class Flags:
    """Which voxels of a tile a drive has found changed, against the Gaussians that it compared with."""

    tile_id: TileId
    base: Gaussians
    voxel_id: I32
    """(N,) strictly increasing."""
    change_class: U8
    """(N,) NEW where the base holds none; MODIFIED or DELETED where it does."""

    def __post_init__(self) -> None:
        check_array("voxel_id", self.voxel_id, np.int32, (None,))
        check_array("change_class", self.change_class, np.uint8, (len(self.voxel_id),))
        if (np.diff(self.voxel_id.astype(np.int64)) <= 0).any() or not np.isin(self.change_class, FLAGGED).all():
            raise ShapeError(
                f"tile {self.tile_id}: flagged voxels must increase, their classes be new, modified or deleted"
            )
        held = np.isin(self.voxel_id, self.base.voxel_id)
        if (held == (self.change_class == ChangeClass.NEW)).any():
            raise ShapeError(
                f"tile {self.tile_id}: new is what the base does not hold, modified and deleted what it does"
            )


def encode_delta(tile_id: TileId, base: Gaussians, new: Gaussians) -> bytes:
    """What turns `base` into `new`; the first byte names the lattice (255: floats)."""
    gone = np.setdiff1d(base.voxel_id, new.voxel_id)
    from gnd_map.tile import diff

    put = diff(base, new).put
    head = np.array([len(gone), *gone], "<i4").tobytes()
    for lattice in (LATTICES["compact"], LATTICES["standard"], LATTICES["archive"]):
        if is_on(new, lattice):
            return bytes([lattice.code]) + zlib.compress(head, 9) + pack(integers_of(put, lattice))
    return bytes([_FLOATS]) + zlib.compress(head, 9) + encode_gaussians(put)


def decode_delta(tile_id: TileId, base: Gaussians, body: bytes) -> Gaussians:
    """The new Gaussians; verify their hash: another base gives CodecError or another hash."""
    if not body:
        raise CodecError("an empty delta")
    head, rest = _inflated(body[1:])
    try:
        gone = np.frombuffer(head, "<i4")
        if len(gone) == 0 or len(gone) != gone[0] + 1:
            raise CodecError("a delta with a wrong number of removed voxels")
        put = decode_gaussians(rest) if body[0] == _FLOATS else dequantise(unpack(rest), lattice_with(body[0]))
        kept = base.take(~(np.isin(base.voxel_id, gone[1:]) | np.isin(base.voxel_id, put.voxel_id)))
        return concat([kept, put])
    except (ShapeError, ValueError) as error:
        raise CodecError(f"delta of tile {tile_id}: {error}") from error


def _inflated(body: bytes) -> tuple[bytes, bytes]:
    unpacker = zlib.decompressobj()
    try:
        raw = unpacker.decompress(body, 1 << 20)
    except zlib.error as error:
        raise CodecError(f"{len(body)} bytes are not packed: {error}") from error
    if not unpacker.eof:
        raise CodecError(f"{len(body)} bytes are truncated")
    return raw, unpacker.unused_data


def encode_flags(tiles: Sequence[Flags]) -> bytes:
    """Bytes of the flags of several tiles; both sides hold the bases."""
    parts = [np.concatenate([[len(t.voxel_id)], t.voxel_id, t.change_class]) for t in tiles]
    return zlib.compress(np.concatenate([[0], *parts]).astype("<i4").tobytes(), 9)


def decode_flags(bases: Sequence[tuple[TileId, Gaussians]], body: bytes) -> list[Flags]:
    """The flags of `encode_flags`, given the same tiles and bases."""
    raw, rest = _inflated(body)
    numbers, at, found = np.frombuffer(raw, "<i4") if len(raw) % 4 == 0 else np.zeros(0, "<i4"), 1, []
    for tile_id, base in bases:
        n = int(numbers[at]) if at < len(numbers) else -1
        ids, classes = numbers[at + 1 : at + 1 + n], numbers[at + 1 + n : at + 1 + 2 * n]
        if not 0 <= n <= len(numbers) or len(classes) != n:
            raise CodecError(f"flags end within tile {tile_id}")
        try:
            found.append(Flags(tile_id, base, ids.astype(np.int32), classes.astype(np.uint8)))
        except ShapeError as error:
            raise CodecError(str(error)) from error
        at += 1 + 2 * n
    if at != len(numbers) or rest:
        raise CodecError("flags of more tiles than asked for")
    return found


def encode_measured(tiles: Sequence[tuple[TileId, Gaussians, Gaussians]]) -> bytes:
    """Measured Gaussians (lattice compact) of several tiles, each (tile, base, measured)."""
    return b"".join(len(b).to_bytes(4, "little") + b for b in (pack(integers_of(m, COMPACT)) for _, _, m in tiles))


def decode_measured(tiles: Sequence[tuple[TileId, Gaussians, I32]], body: bytes) -> list[Gaussians]:
    """The measured Gaussians of these voxels, each (tile, base, voxel ids)."""
    found, at = [], 0
    for tile_id, _, voxel_id in tiles:
        n = int.from_bytes(body[at : at + 4], "little")
        found.append(dequantise(unpack(body[at + 4 : at + 4 + n]), COMPACT))
        at += 4 + n
        if not np.array_equal(found[-1].voxel_id, voxel_id):
            raise CodecError(f"tile {tile_id}: Gaussians of other voxels than asked for")
    if at != len(body):
        raise CodecError(f"{len(body) - at} bytes behind the last Gaussian")
    return found


def encode_tiles(entries: Sequence[tuple[int, int]]) -> bytes:
    """Tiles of one district, each (lowest 10 bits of its Morton code, version), ascending."""
    return zlib.compress(np.array(entries, "<i8").reshape(-1, 2).tobytes(), 9)


def decode_tiles(body: bytes) -> list[tuple[int, int]]:
    """The entries of `encode_tiles`."""
    raw, rest = _inflated(body)
    if len(raw) % 16 or rest:
        raise CodecError(f"{len(body)} bytes are no list of tiles")
    return [(int(i), int(v)) for i, v in np.frombuffer(raw, "<i8").reshape(-1, 2)]


def encode_mask(mask: npt.NDArray[np.bool_]) -> bytes:
    """Bytes of a mask; its length is known to the reader."""
    return zlib.compress(np.packbits(mask).tobytes(), 9)


def decode_mask(body: bytes, n: int) -> npt.NDArray[np.bool_]:
    """The mask (n,) of `encode_mask`."""
    raw, rest = _inflated(body)
    if len(raw) != (n + 7) // 8 or rest:
        raise CodecError(f"a mask of {len(raw)} bytes for {n} items")
    return np.unpackbits(np.frombuffer(raw, np.uint8), count=n).astype(np.bool_)
