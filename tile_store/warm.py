"""Compile or load the kernels of the codecs before the first request waits for them."""

import numpy as np

from gnd.gnd_map.codec import (
    LATTICES,
    PREFERRED,
    QUICK,
    best_codec,
    codec_of,
    decode_delta,
    decode_tiles,
    encode_delta,
    encode_tiles,
    snap,
)
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId


def warm_up() -> None:
    """Write and read a small tile, a delta and a list of tiles; after that an answer takes milliseconds.

    The first time on a machine this compiles for some ten seconds; the machine code is kept beside the modules.
    """
    tile = TileId.from_geodetic(0.6555, 2.2173)
    ids = np.arange(3, dtype=np.int32)
    cov_m2 = np.tile(np.array([0.07, 0, 0, 0.07, 0, 0.0004], np.float32), (3, 1))
    plain = Gaussians(ids, np.full(3, 90, np.int32), np.full(3, 40, np.int32), np.zeros((3, 3), np.float32), cov_m2)
    for lattice in LATTICES.values():
        gaussians = snap(plain, lattice)
        for codec in (codec_of(best_codec(gaussians, known)) for known in (PREFERRED, QUICK)):
            codec.decode(tile, codec.encode(tile, gaussians))
        base = gaussians.take([0, 1])
        decode_delta(tile, base, encode_delta(tile, base, gaussians))
    decode_tiles(encode_tiles([(0, 1), (3, 0)]))
