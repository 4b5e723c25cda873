"""Messages whose bytes must never change, made of integers only; `python tests/gnd_map/golden_codecs.py` writes them.

New codecs and lattices add lines to `golden/codecs.json`; a line that is there already changes its meaning for all who
hold such bytes, and is never written again.
"""

import json
from pathlib import Path

import numpy as np

from gnd.gnd_map.codec import (
    CODECS,
    LATTICES,
    REPORT,
    Flags,
    Lattice,
    encode_delta,
    encode_flags,
    encode_mask,
    encode_measured,
    encode_tiles,
)
from gnd.gnd_map.codec.lattice import Quantised, dequantise
from gnd.gnd_map.codec.prior_sets import sets_of
from gnd.gnd_map.codec.range_tile import encode_tile_by_set
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import content_sha
from gnd.gnd_map.tile_id import TileId

FILE = Path(__file__).with_name("golden") / "codecs.json"
TILE, OTHER = TileId(497353963154), TileId(497353963155)
ENTRIES = [(0, 1), (1, 1), (2, 3), (700, 2**31 - 1), (1023, 1)]
MASK = np.array([i * i % 7 < 3 for i in range(50)])
ROWS = 24


def state(lattice: Lattice, number: int) -> Gaussians:
    """State 0 or 1 of a tile: a patch of road, a wall and a few odd ones, by plain integer rules."""
    i = np.arange(ROWS, dtype=np.int64)
    ix, iy, floor = i % 6 + 3 + number, i // 6 + 10, np.where(i % 6 == 5, i // 6 % 3, -1)
    order = np.argsort(VoxelGrid.of(TILE).voxel_id(ix, iy, floor))
    i = i[order]
    axis = np.where(i % 6 == 5, 0, 2)
    wide = sum(sd < 0.28 * 2**20 for sd in lattice.sd) // lattice.plane_step
    level = np.stack([(i * 7 + 9) % 3 + wide - 1, (i * 5) % 2 + wide - 1, i % 9], axis=1)
    slope = np.stack([(i * 11) % 3 - 1, (i * 13) % 5 - 2, (i * 17) % 7 - 3], axis=1)
    step = np.stack([(i * 19) % 5 - 2, (i * 23) % 5 - 2, (i * 29 + number) % 41 - 20], axis=1)
    ids = VoxelGrid.of(TILE).voxel_id(ix, iy, floor)[order].astype(np.int32)
    columns = (axis, level, slope, step, np.minimum(i % 12 + 4, len(lattice.counts) - 1))
    return dequantise(Quantised(ids, *(column.astype(np.int32) for column in columns)), lattice)


def flags_of(base: Gaussians) -> Flags:
    """Every fourth voxel modified, every fifth deleted, two new."""
    at = np.arange(len(base))
    old = base.voxel_id[(at % 4 == 0) | (at % 5 == 0)]
    ids = np.concatenate([old, base.voxel_id[-1:] + 1, base.voxel_id[-1:] + 40]).astype(np.int32)
    classes = np.where(np.isin(ids, base.voxel_id[::4]), 2, np.where(np.isin(ids, base.voxel_id), 3, 1))
    return Flags(TILE, base, ids, classes.astype(np.uint8))


def messages() -> dict[str, bytes]:
    """Every golden message by its name."""
    standard, found = LATTICES["standard"], dict[str, bytes]()
    for codec in CODECS.values():
        g = state(codec.lattice or standard, 0)
        found[f"tile, codec {codec.codec_id}"] = codec.encode(TILE, g)
        found[f"nothing, codec {codec.codec_id}"] = codec.encode(TILE, Gaussians.empty())
    for name, lattice in LATTICES.items():
        for number in range(len(sets_of(name))):
            found[f"tile, {name}, set {number}"] = encode_tile_by_set(TILE, state(lattice, 0), lattice, number)
        found[f"delta, {name}"] = encode_delta(TILE, state(lattice, 0), state(lattice, 1))
    base, empty = state(standard, 0), Gaussians.empty()
    found["flags"] = encode_flags([flags_of(base), Flags(OTHER, empty, np.array([7], np.int32), np.ones(1, np.uint8))])
    found["measured"] = encode_measured([(TILE, base, state(REPORT, 1)), (OTHER, empty, state(REPORT, 0))])
    found["tiles"], found["mask"] = encode_tiles(ENTRIES), encode_mask(MASK)
    return found


def hashes() -> dict[str, str]:
    """Content hashes of the states, which are the identity of published tiles."""
    return {
        f"{lattice.name}, state {number}": content_sha(TILE, state(lattice, number)).hex()
        for lattice in (*LATTICES.values(), REPORT)
        for number in (0, 1)
    }


def tables() -> dict[str, list[int]]:
    """What lattices are made of: standard deviations, then steps."""
    return {
        lattice.name: [
            *lattice.sd, lattice.code, lattice.plane_step, lattice.slope_bits, lattice.shear_bits, lattice.thin_bits,
            lattice.plane_bits,
        ]
        for lattice in (*LATTICES.values(), REPORT)
    }  # fmt: skip


def main() -> None:
    """Write what is not there yet."""
    old = {"messages": {}, "hashes": {}, "tables": {}} | (json.loads(FILE.read_text()) if FILE.exists() else {})
    new = {
        "messages": {name: body.hex() for name, body in messages().items()} | old["messages"],
        "hashes": hashes() | old["hashes"],
        "tables": tables() | old["tables"],
    }
    FILE.parent.mkdir(exist_ok=True)
    FILE.write_text(json.dumps(new, indent=1) + "\n")


if __name__ == "__main__":
    main()
