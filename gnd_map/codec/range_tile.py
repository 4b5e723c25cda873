"""A tile's Gaussians on a lattice, range coded: which voxels, then each Gaussian from its neighbours."""

import numpy as np

from gnd.gnd_map.codec import kernels as k
from gnd.gnd_map.codec.coding import Coder
from gnd.gnd_map.codec.floats import check_number
from gnd.gnd_map.codec.lattice import Lattice, dequantise, integers_of
from gnd.gnd_map.codec.priors import priors_of
from gnd.gnd_map.codec.volume import NOTHING_KNOWN, code_box, code_flags, code_voxels
from gnd.gnd_map.errors import CodecError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId

_NOTHING = np.empty(0, np.int32)


def encode_tile(tile_id: TileId, gaussians: Gaussians, lattice: Lattice) -> bytes:
    """Bytes of a tile's Gaussians.

    Raises:
        CodecError: they do not lie on the lattice, are more than a tile may hold, or lie too far apart in height.
    """
    check_number(len(gaussians))
    quantised = integers_of(gaussians, lattice)
    coder = Coder.writing(priors_of(f"tile-{lattice.name}"), 4096 + 48 * len(gaussians))
    box = code_box(coder, tile_id, _NOTHING, gaussians.voxel_id)
    if box is not None:
        flag = np.asarray(box.empty(np.uint8, k.NONE), np.uint8)
        flag[box.places(gaussians.voxel_id)] = k.PUT
        code_flags(coder, box, _NOTHING, flag)
        code_voxels(coder, box, gaussians.voxel_id, NOTHING_KNOWN, lattice, quantised)
    return coder.finish()


def decode_tile(tile_id: TileId, body: bytes, lattice: Lattice) -> Gaussians:
    """The Gaussians of `encode_tile`.

    Raises:
        CodecError: damaged, truncated, or values that are no Gaussians.
    """
    coder = Coder.reading(priors_of(f"tile-{lattice.name}"), body)
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
