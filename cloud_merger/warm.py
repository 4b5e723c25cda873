"""Compile or load the kernels of a shard before the first tile or report waits for them."""

import numpy as np

from gnd_map.classes import ChangeClass
from gnd_map.codec import (
    REPORT,
    Flags,
    decode_flags,
    decode_mask,
    decode_measured,
    encode_flags,
    encode_mask,
    encode_measured,
    snap,
)
from gnd_map.gaussian import Gaussians
from gnd_map.similarity import similarity_pairs
from gnd_map.tile_id import TileId
from gnd_map.track import STEPS, Piece, Track, View
from gnd_map.visibility import observed_along
from tile_store.warm import warm_up as warm_up_codecs

_TILE = TileId(497353963154)


def warm_up() -> None:
    """Write and read a tiny tile and a tiny report in short; starts no thread and opens nothing."""
    warm_up_codecs()
    base = _base()
    flags = [Flags(_TILE, base, base.voxel_id[:1], np.array([ChangeClass.MODIFIED], np.uint8))]
    (found,) = decode_flags([(_TILE, base)], encode_flags(flags))
    measured = encode_measured([(_TILE, base, base.take([0]))])
    decode_measured([(_TILE, base, found.voxel_id)], measured)
    decode_mask(encode_mask(np.array([True])), 1)
    observed_along(Track(_TILE.district, View((-8, -6, -4, -2, 0, 2, 4, 6, 8)), (_place(),)), [found])
    similarity_pairs(np.array([0]), np.array([1]), base.exists, base.mean_m, base.cov_m2)


def _place() -> Piece:
    """In the middle of the tile, 2 m up."""
    corner = TileId(_TILE.district.first_morton)
    east, north = _TILE.lon_index - corner.lon_index, _TILE.lat_index - corner.lat_index
    return Piece(np.array([[STEPS * east + STEPS // 2, STEPS * north + STEPS // 2, 4]], np.int32), 1)


def _base() -> Gaussians:
    """Two voxels of ground on the lattice on which reports travel."""
    cov = np.tile(np.array([0.08, 0.0, 0.0, 0.08, 0.0, 0.0004], np.float32), (2, 1))
    ids, count = np.array([0, 1], np.int32), np.array([40, 40], np.int32)
    return snap(Gaussians(ids, count, count // 2, np.zeros((2, 3), np.float32), cov), REPORT)
