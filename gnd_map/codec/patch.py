"""Deltas and reports, range coded against Gaussians that both sides hold."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import I32, are_in, check_array, unique
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.codec import kernels as k
from gnd.gnd_map.codec.coding import Coder
from gnd.gnd_map.codec.floats import check_number, decode_gaussians, encode_gaussians
from gnd.gnd_map.codec.lattice import LATTICES, REPORT, Lattice, dequantise, integers_of, is_on, lattice_with
from gnd.gnd_map.codec.priors import mask_at, number_at, priors_of
from gnd.gnd_map.codec.volume import Box, KnownVolume, box_of, code_box, code_flags, code_voxels, known_of
from gnd.gnd_map.delta import TileDelta, apply, diff
from gnd.gnd_map.errors import CodecError, ShapeError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId

U8 = npt.NDArray[np.uint8]
MAX_TILES: Final = 1024
"""Of a district."""
_FLOATS: Final = 255
_CLASS_OF: Final = np.array([ChangeClass.NORMAL, ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED], np.uint8)
"""By flag: k.NONE, k.PUT, k.REPLACED, k.GONE."""
_NEW, _DELETED = int(ChangeClass.NEW), int(ChangeClass.DELETED)  # numpy takes long over members of an enum
_FLAG_OF: Final = np.array([k.NONE, k.PUT, k.REPLACED, k.GONE, k.NONE, k.NONE], np.uint8)


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
        flagged = (self.change_class >= _NEW) & (self.change_class <= _DELETED)
        if not (self.voxel_id[1:] > self.voxel_id[:-1]).all() or not flagged.all():
            raise ShapeError(f"tile {self.tile_id}: flagged voxels must increase and be new, modified or deleted")
        held = are_in(self.voxel_id, self.base.voxel_id)
        wrong = held == (self.change_class == _NEW)
        if wrong.any():
            raise ShapeError(
                f"tile {self.tile_id}: {int(wrong.sum())} voxels are new but held, or changed but not held"
            )


def encode_delta(tile_id: TileId, base: Gaussians, new: Gaussians) -> bytes:
    """What turns `base` into `new`; the first byte names the lattice (255: `new` lies on none, all of it follows).

    Raises:
        CodecError: too many voxels, or too far apart in height.
    """
    check_number(len(new))
    lattice = next((lattice for lattice in LATTICES.values() if is_on(new, lattice)), None)
    if lattice is None:
        return bytes([_FLOATS]) + encode_gaussians(new)
    changes = diff(base, new)
    put, gone = changes.put, changes.removed
    coder = Coder.writing(priors_of(f"delta-{lattice.name}"), 4096 + 48 * (len(put) + len(gone)))
    flagged = unique(np.concatenate([put.voxel_id, gone]))
    box = code_box(coder, tile_id, base.voxel_id, flagged)
    if box is not None:
        flag = np.asarray(box.empty(np.uint8, k.NONE), np.uint8)
        flag[box.places(put.voxel_id)] = np.where(are_in(put.voxel_id, base.voxel_id), k.REPLACED, k.PUT)
        flag[box.places(gone)] = k.GONE
        code_flags(coder, box, base.voxel_id, flag)
        known = _known(base, put.voxel_id, gone, lattice)
        code_voxels(coder, box, put.voxel_id, known, lattice, integers_of(put, lattice))
    return bytes([lattice.code]) + coder.finish()


def decode_delta(tile_id: TileId, base: Gaussians, body: bytes) -> Gaussians:
    """The new Gaussians. Verify their hash: against another base the bytes mean something else.

    Raises:
        CodecError: damaged, truncated, of another base, or values that are no Gaussians.
    """
    if not body:
        raise CodecError(f"delta of tile {tile_id}: no bytes")
    if body[0] == _FLOATS:
        return decode_gaussians(body[1:])
    lattice = lattice_with(body[0])
    coder = Coder.reading(priors_of(f"delta-{lattice.name}"), body[1:])
    box = code_box(coder, tile_id, base.voxel_id, None)
    if box is None:
        coder.end()
        return base
    flag = np.asarray(box.empty(np.uint8, k.NONE), np.uint8)
    check_number(code_flags(coder, box, base.voxel_id, flag))
    put = box.voxel_ids(*np.nonzero((flag == k.PUT) | (flag == k.REPLACED)))
    gone = box.voxel_ids(*np.nonzero(flag == k.GONE))
    found = code_voxels(coder, box, put, _known(base, put, gone, lattice), lattice, None)
    coder.end()
    return apply(base, TileDelta(gone, dequantise(found, lattice)))


def _known(base: Gaussians, put: I32, gone: npt.NDArray[np.integer], lattice: Lattice) -> KnownVolume:
    return known_of(base, are_in(base.voxel_id, put), are_in(base.voxel_id, gone), lattice)


def encode_flags(tiles: Sequence[Flags]) -> bytes:
    """Flags of several tiles, of which both sides hold the bases, in one stream.

    Raises:
        CodecError: voxels too far apart in height.
    """
    coder = Coder.writing(priors_of("flags"), 4096 + 16 * sum(len(t.voxel_id) for t in tiles) + 64 * len(tiles))
    for tile in tiles:
        box = code_box(coder, tile.tile_id, tile.base.voxel_id, tile.voxel_id)
        if box is not None:
            flag = np.asarray(box.empty(np.uint8, k.NONE), np.uint8)
            flag[box.places(tile.voxel_id)] = _FLAG_OF[tile.change_class]
            code_flags(coder, box, tile.base.voxel_id, flag)
    return coder.finish()


def decode_flags(bases: Sequence[tuple[TileId, Gaussians]], body: bytes) -> list[Flags]:
    """The flags of `encode_flags`, given the same tiles and bases in the same order.

    Raises:
        CodecError: damaged, truncated, or of other bases.
    """
    coder = Coder.reading(priors_of("flags"), body)
    found = [_read_flags(coder, tile_id, base) for tile_id, base in bases]
    coder.end()
    return found


def _read_flags(coder: Coder, tile_id: TileId, base: Gaussians) -> Flags:
    box = code_box(coder, tile_id, base.voxel_id, None)
    if box is None:
        return Flags(tile_id, base, np.empty(0, np.int32), np.empty(0, np.uint8))
    flag = np.asarray(box.empty(np.uint8, k.NONE), np.uint8)
    check_number(code_flags(coder, box, base.voxel_id, flag))
    places = np.unravel_index(np.flatnonzero(flag != k.NONE), flag.shape)
    try:
        return Flags(tile_id, base, box.voxel_ids(places[0], places[1], places[2]), _CLASS_OF[flag[places]])
    except ShapeError as error:
        raise CodecError(f"flags of another base: {error}") from error


def encode_measured(tiles: Sequence[tuple[TileId, Gaussians, Gaussians]]) -> bytes:
    """Measured Gaussians of several tiles, each (tile, base, measured), in one stream.

    Raises:
        CodecError: some do not lie on the lattice `report`, or lie too far apart in height.
    """
    coder = Coder.writing(priors_of("measured"), 4096 + 48 * sum(len(m) for _, _, m in tiles))
    for tile_id, base, measured in tiles:
        if len(measured):
            integers = integers_of(measured, REPORT)
            code_voxels(coder, *_around(tile_id, base, measured.voxel_id), REPORT, integers)
    return coder.finish()


def decode_measured(tiles: Sequence[tuple[TileId, Gaussians, I32]], body: bytes) -> list[Gaussians]:
    """The measured Gaussians of these voxels, each (tile, base, voxel ids), in the order of `encode_measured`.

    Raises:
        CodecError: damaged, truncated, of other voxels or bases, or values that are no Gaussians.
    """
    coder = Coder.reading(priors_of("measured"), body)
    found = [_read_measured(coder, *tile) for tile in tiles]
    coder.end()
    return found


def _read_measured(coder: Coder, tile_id: TileId, base: Gaussians, voxel_id: I32) -> Gaussians:
    if len(voxel_id) == 0:
        return Gaussians.empty()
    found = code_voxels(coder, *_around(tile_id, base, voxel_id), REPORT, None)
    return dequantise(found, REPORT)


def _around(tile_id: TileId, base: Gaussians, voxel_id: I32) -> tuple[Box, I32, KnownVolume]:
    """Box, voxels and what is known around them."""
    both = unique(np.concatenate([base.voxel_id, voxel_id]))
    return box_of(tile_id, both), voxel_id, _known(base, voxel_id, np.empty(0, np.int32), REPORT)


def encode_tiles(entries: Sequence[tuple[int, int]]) -> bytes:
    """Tiles of one district, each (lowest 10 bits of its Morton code, version), ascending.

    Raises:
        CodecError: not ascending, or beyond their ranges.
    """
    _check_tiles(entries)
    coder = Coder.writing(priors_of("tiles"), 64 + 16 * len(entries))
    _code_tiles(coder, list(entries), len(entries))
    return coder.finish()


def decode_tiles(body: bytes) -> list[tuple[int, int]]:
    """The entries of `encode_tiles`.

    Raises:
        CodecError: damaged, or no tiles of a district.
    """
    coder = Coder.reading(priors_of("tiles"), body)
    entries = _code_tiles(coder, [], 0)
    coder.end()
    _check_tiles(entries)
    return entries


def _code_tiles(coder: Coder, entries: list[tuple[int, int]], n: int) -> list[tuple[int, int]]:
    count = coder.number(number_at(0), n)
    if not 0 <= count <= MAX_TILES:
        raise CodecError(f"{count} tiles of a district, the limit is {MAX_TILES}")
    found: list[tuple[int, int]] = []
    before, version = -1, 1
    for i in range(count):
        index, now = entries[i] if entries else (0, 0)
        before += 1 + coder.number(number_at(1), index - before - 1)
        version += coder.number(number_at(2), now - version)
        found.append((before, version))
    return found


def _check_tiles(entries: Sequence[tuple[int, int]]) -> None:
    before = -1
    for index, version in entries:
        if not (before < index < MAX_TILES and 0 <= version < 1 << 31):
            raise CodecError(f"tile {index} after {before}, version {version}: ascending below {MAX_TILES}, below 2^31")
        before = index


def encode_mask(mask: npt.NDArray[np.bool_]) -> bytes:
    """Bytes of a mask (N,); its length is known to the reader."""
    coder = Coder.writing(priors_of("mask"), 64 + 2 * len(mask))
    k.code_bits(coder.state, mask_at(0), mask.astype(np.uint8))
    return coder.finish()


def decode_mask(body: bytes, n: int) -> npt.NDArray[np.bool_]:
    """The mask (n,) of `encode_mask`.

    Raises:
        CodecError: damaged, or of another length.
    """
    coder = Coder.reading(priors_of("mask"), body)
    bits = np.zeros(n, np.uint8)
    k.code_bits(coder.state, mask_at(0), bits)
    coder.end()
    return bits.astype(np.bool_)
