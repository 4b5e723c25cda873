"""Makes `gnd_map/codec/prior_sets.bin`, the sets of tables by which the contexts of a tile's stream start.

    python -m studies.codec_study.learn RECORDINGS --out gnd_map/codec/prior_sets.bin

Tiles of simulated places and of real recordings (`studies.codec_study.scenes`: only those marked for training) are
sorted by thickness into as many heaps as there will be sets; each set learns from its heap, each tile goes to the set
that writes it shortest, and again. The last set learns from all tiles, with every number of points: what no other fits.
The file is part of what codecs 8 to 10 mean. Another one makes other bytes, so it was made once and is not made again.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import I64
from gnd.gnd_map.codec import LATTICES, Lattice, snap
from gnd.gnd_map.codec.lattice import Quantised, dequantise, integers_of
from gnd.gnd_map.codec.prior_sets import pack
from gnd.gnd_map.codec.priors import Learning, Priors
from gnd.gnd_map.codec.range_tile import written
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId
from studies.codec_study.scenes import training_maps

SETS: Final = {"archive": 2, "standard": 4, "compact": 3}
"""That learn from a part of the tiles each; one more learns from all."""
ROUNDS: Final = 4
TRUST: Final = 20
"""How many decisions what was learnt counts as: 30 and 40 make longer tiles."""
_FEWEST_TILES: Final = 8
_FIRST_TRUST: Final = 10
_SEEN_EVERY: Final = 12
_DIGITS: Final = 6

Sample = tuple[TileId, Quantised]


def main() -> None:
    """Learn and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, help="folder with the recordings")
    parser.add_argument("--out", type=Path, required=True, help="file to write")
    chosen = parser.parse_args()
    maps = list(training_maps(chosen.recordings))
    sets = {name: learnt_sets(maps, LATTICES[name], n) for name, n in SETS.items()}
    chosen.out.write_bytes(pack(sets))
    print(f"{chosen.out}: {chosen.out.stat().st_size} bytes, of {len(maps)} tiles")


def learnt_sets(maps: Sequence[tuple[TileId, Gaussians]], lattice: Lattice, n: int) -> list[Priors]:
    """The sets of a lattice; the one of all tiles is the first."""
    samples = [(tile_id, integers_of(snap(g, lattice, new_map=True), lattice)) for tile_id, g in maps]
    every = learnt([*samples, *with_other_counts(samples, lattice)], lattice, None)
    heaps = np.array_split(np.argsort([np.median(q.level[:, 2]) for _, q in samples], kind="stable"), n)
    sets: list[Priors] = []
    for _ in range(ROUNDS):
        sets = [learnt([samples[i] for i in heap], lattice, every) for heap in heaps]
        best = np.array([np.argmin([_size(one, sample, lattice) for one in sets]) for sample in samples])
        heaps = [np.flatnonzero(best == number) for number in range(n)]
        print(f"{lattice.name}: {', '.join(str(len(heap)) for heap in heaps)} tiles", flush=True)
    return [every, *sets]


def learnt(samples: Sequence[Sample], lattice: Lattice, start: Priors | None) -> Priors:
    """What the contexts know, in the mean of the second time that all tiles come, in a fixed, mixed order: where they
    stand in the end is what the last tiles were like.
    """
    if len(samples) < _FEWEST_TILES and start is not None:
        return start
    state = Learning(*(start.frozen(_FIRST_TRUST) if start else Priors.flat_5()).copies())
    order = np.random.default_rng(len(samples)).permutation(len(samples))
    for i in order:
        _size(state, samples[i], lattice)
    places, weights, n = np.zeros(len(state.places)), np.zeros(state.weight.shape), 0
    for j, i in enumerate(order):
        _size(state, samples[i], lattice)
        if j % _SEEN_EVERY == 0:
            places, weights, n = places + (state.places >> 8), weights + state.weight, n + 1
    probability = _rounded(np.rint(places / n).astype(np.int64))
    seen = (probability << 8 | (state.places & 0xFF)).astype(np.int32)
    return Priors(seen, np.rint(weights / n / 16).astype(np.int64) * 16).frozen(TRUST)


def _rounded(probability: I64) -> I64:
    """To so many binary digits of the rarer of the two outcomes: what more there is only makes the file longer."""
    rarer = np.maximum(np.minimum(probability, 65536 - probability), 1)
    unit = 1 << np.maximum(np.floor(np.log2(rarer)).astype(np.int64) - _DIGITS + 1, 0)
    rarer = (rarer + unit // 2) // unit * unit
    return np.asarray(np.where(probability < 32768, rarer, np.minimum(65536 - rarer, 65535)), np.int64)


def _size(priors: Priors, sample: Sample, lattice: Lattice) -> int:
    tile_id, quantised = sample
    return len(written(tile_id, quantised, lattice, priors, five=True).finish())


def with_other_counts(samples: Sequence[Sample], lattice: Lattice) -> list[Sample]:
    """Tiles as they were rounded before numbers of points became coarser: up to one step of the lattice off."""
    if not lattice.map_counts:
        return []
    rng = np.random.default_rng(3)
    found = []
    for tile_id, q in samples[::3]:
        other = q.take(np.arange(len(q)))
        many = other.count > 4  # beyond 20 points
        other.count[many] += rng.integers(-1, 2, int(many.sum())).astype(np.int32)
        dequantise(other, lattice)
        found.append((tile_id, other))
    return found


if __name__ == "__main__":
    main()
