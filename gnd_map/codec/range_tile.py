"""A tile's Gaussians on a lattice, range coded: which voxels, then each Gaussian from its neighbours.

`encode_tile` starts from one frozen table (codecs 2 to 4). `encode_tile_by_set` mixes five contexts and starts from the
one of several tables that fits the tile best, whose number is the first byte (codecs 8 to 10).
"""

from typing import Final

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.codec import kernels as k
from gnd.gnd_map.codec.coding import Coder
from gnd.gnd_map.codec.floats import check_number
from gnd.gnd_map.codec.lattice import Lattice, Quantised, dequantise, integers_of
from gnd.gnd_map.codec.prior_sets import sets_of
from gnd.gnd_map.codec.priors import Priors, priors_of
from gnd.gnd_map.codec.volume import NOTHING_KNOWN, LaidOut, box_of, code_box, code_flags, code_voxels
from gnd.gnd_map.errors import CodecError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile_id import TileId

_NOTHING = np.empty(0, np.int32)
_TRIED: Final = 120
"""About so many voxels of a tile decide by which set it is written."""
_PATCH: Final = 4
"""They are taken in patches of so many columns either way, so that they have neighbours."""


def encode_tile(tile_id: TileId, gaussians: Gaussians, lattice: Lattice) -> bytes:
    """Bytes of a tile's Gaussians.

    Raises:
        CodecError: they do not lie on the lattice, are more than a tile may hold, or lie too far apart in height.
    """
    check_number(len(gaussians))
    quantised = integers_of(gaussians, lattice)
    return written(tile_id, quantised, lattice, priors_of(f"tile-{lattice.name}"), five=False).finish()


def encode_tile_by_set(tile_id: TileId, gaussians: Gaussians, lattice: Lattice, number: int | None = None) -> bytes:
    """Bytes of a tile's Gaussians, first the number of the set of tables: the given one, or the best for the tile.

    Raises:
        CodecError: they do not lie on the lattice, are more than a tile may hold, or lie too far apart in height; there
            is no set of that number.
    """
    check_number(len(gaussians))
    quantised = integers_of(gaussians, lattice)
    number = _best_set(tile_id, quantised, lattice) if number is None else number
    return written(tile_id, quantised, lattice, _set_of(lattice, number), five=True).finish(bytes([number]))


def spent_by_field(tile_id: TileId, gaussians: Gaussians, lattice: Lattice, number: int | None) -> dict[str, float]:
    """Bytes of a tile that say which voxels it has, and their covariances, means and counts.

    Args:
        tile_id: which tile.
        gaussians: of it, on the lattice.
        lattice: of the codec.
        number: of the set of tables; None: as codecs 2 to 4 write it.

    Raises:
        CodecError: as `encode_tile` and `encode_tile_by_set`.
    """
    quantised, five = integers_of(gaussians, lattice), number is not None
    priors = priors_of(f"tile-{lattice.name}") if number is None else _set_of(lattice, number)
    spent = written(tile_id, quantised, lattice, priors, five=five, counting=True).spent_bytes()
    return {name: sum(spent[i] for i in rows) for name, rows in _FIELDS.items()}


_FIELDS: Final = {"voxels": (0,), "covariances": (1, 2, 3, 4, 6, 7, 8), "means": (9, 10, 11), "counts": (5,)}


def _best_set(tile_id: TileId, quantised: Quantised, lattice: Lattice) -> int:
    """The set by which a part of the tile becomes shortest; the first of equals."""
    part = quantised.take(_spread(tile_id, quantised)) if len(quantised) > _TRIED + _TRIED // 2 else quantised
    sets = sets_of(lattice.name)
    if not len(part):
        return 0
    laid_out = _laid_out(tile_id, part, lattice)
    return int(np.argmin([len(_written(laid_out, one, five=True).finish()) for one in sets]))


def _spread(tile_id: TileId, quantised: Quantised) -> npt.NDArray[np.bool_]:
    """(N,) about _TRIED of the voxels: all of some columns, which lie in patches spread over the tile."""
    ix, iy, _ = VoxelGrid.of(tile_id).unravel(quantised.voxel_id)
    return np.asarray((ix // _PATCH + 3 * (iy // _PATCH)) % max(len(quantised) // _TRIED, 1) == 0)


def _set_of(lattice: Lattice, number: int) -> Priors:
    sets = sets_of(lattice.name)
    if not 0 <= number < len(sets):
        raise CodecError(f"set {number} of tables, the lattice {lattice.name} has {len(sets)}")
    return sets[number]


def written(
    tile_id: TileId, quantised: Quantised, lattice: Lattice, priors: Priors, *, five: bool, counting: bool = False
) -> Coder:
    """The stream of a tile, written by these tables; `counting`: what each field takes, too."""
    if len(quantised):
        return _written(_laid_out(tile_id, quantised, lattice), priors, five=five, counting=counting)
    coder = Coder.writing(priors, 4096, five=five)
    code_box(coder, tile_id, _NOTHING, quantised.voxel_id)
    return coder


def _laid_out(tile_id: TileId, quantised: Quantised, lattice: Lattice) -> LaidOut:
    """A tile's Gaussians, at least one, as they are written."""
    box = box_of(tile_id, quantised.voxel_id)
    return LaidOut.of(box, quantised.voxel_id, NOTHING_KNOWN, lattice, quantised)


def _written(laid_out: LaidOut, priors: Priors, *, five: bool, counting: bool = False) -> Coder:
    """`written` of what has been laid out."""
    coder = Coder.writing(priors, 4096 + 48 * len(laid_out.voxel_id), five=five)
    coder.state[0][k.MODE] = 2 if counting else 0
    box = laid_out.box
    code_box(coder, box.grid.tile, _NOTHING, laid_out.voxel_id)
    flag = np.asarray(box.empty(np.uint8, k.NONE), np.uint8)
    flag[laid_out.places] = k.PUT
    code_flags(coder, box, _NOTHING, flag)
    laid_out.code(coder)
    return coder


def decode_tile(tile_id: TileId, body: bytes, lattice: Lattice) -> Gaussians:
    """The Gaussians of `encode_tile`.

    Raises:
        CodecError: damaged, truncated, or values that are no Gaussians.
    """
    return _read(tile_id, Coder.reading(priors_of(f"tile-{lattice.name}"), body), lattice)


def decode_tile_by_set(tile_id: TileId, body: bytes, lattice: Lattice) -> Gaussians:
    """The Gaussians of `encode_tile_by_set`.

    Raises:
        CodecError: damaged, truncated, an unknown set, or values that are no Gaussians.
    """
    if not body:
        raise CodecError(f"tile {tile_id}: no bytes")
    return _read(tile_id, Coder.reading(_set_of(lattice, body[0]), body, 1, five=True), lattice)


def _read(tile_id: TileId, coder: Coder, lattice: Lattice) -> Gaussians:
    """The Gaussians of a stream."""
    box = code_box(coder, tile_id, _NOTHING, None)
    if box is None:
        coder.end()
        return Gaussians.empty()
    flag = np.asarray(box.empty(np.uint8, k.NONE), np.uint8)
    check_number(code_flags(coder, box, _NOTHING, flag))
    voxel_id = box.voxel_ids(*np.unravel_index(np.flatnonzero(flag != k.NONE), flag.shape))
    if len(voxel_id) == 0:
        raise CodecError("a tile that claims Gaussians and holds none")
    found = code_voxels(coder, box, voxel_id, NOTHING_KNOWN, lattice, None)
    coder.end()
    return dequantise(found, lattice)
