"""Makes `gnd_map/codec/rans_tables.bin`: where the sums of a tile start, and the distributions that they choose among.

    python -m studies.codec_study.learn_rans RECORDINGS --out gnd_map/codec/rans_tables.bin

From the same tiles as `studies.codec_study.learn`. First what each context says is learnt in floats, by stochastic
gradients of the likelihood (logistic regression for whether a number is what was expected; a logistic distribution for
the others). Then all tiles are written with these sums, and how often each symbol came makes the distributions. The
file is part of what codecs 11 to 13 mean. Another one makes other bytes, so it was made once and is not made again.
"""

import argparse
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, I32, I64
from gnd.gnd_map.codec import LATTICES, Lattice, snap
from gnd.gnd_map.codec import rans_kernels as rk
from gnd.gnd_map.codec import voxel_kernels as v
from gnd.gnd_map.codec.coding import Coder
from gnd.gnd_map.codec.lattice import integers_of
from gnd.gnd_map.codec.priors import priors_of
from gnd.gnd_map.codec.rans_tables import LATTICES_WITH_SUMS, Moves, Sums, pack
from gnd.gnd_map.codec.rans_tile import SymbolCounts, numbers_written
from gnd.gnd_map.codec.volume import NOTHING_KNOWN, LaidOut, box_of, voxel_coding
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.jit import kernel
from gnd.gnd_map.tile_id import TileId
from studies.codec_study.learn import Sample, with_other_counts
from studies.codec_study.scenes import training_maps

RATES: Final = (0.7, 0.6, 0.4, 0.3, 0.15, 0.1)
"""Of the times that all tiles come."""
TILE_RATE: Final = 0.01
"""How fast places and scales learn within a tile."""
MOST_PLAIN_WIDTH: Final = 1.3
"""Widths beyond it have plain bits."""
_TRUST: Final = 16
"""A distribution counts the mean of its width like so many symbols."""
_AXES_TRUST: Final = 8
_LEAST: Final = 0.02
_CLIPPED: Final = 3.0


def main() -> None:
    """Learn and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, help="folder with the recordings")
    parser.add_argument("--out", type=Path, required=True, help="file to write")
    chosen = parser.parse_args()
    write(list(training_maps(chosen.recordings)), chosen.out)


def write(maps: Sequence[tuple[TileId, Gaussians]], out: Path) -> None:
    """The file of these tiles."""
    common = first_moves()
    out.write_bytes(pack(common, {name: learnt_sums(maps, LATTICES[name], common) for name in LATTICES_WITH_SUMS}))
    print(f"{out}: {out.stat().st_size} bytes, of {len(maps)} tiles")


def learnt_sums(maps: Sequence[tuple[TileId, Gaussians]], lattice: Lattice, common: Moves) -> Sums:
    """The tables of a lattice."""
    samples = [(tile_id, integers_of(snap(g, lattice, new_map=True), lattice)) for tile_id, g in maps]
    laid_out = [_laid_out(sample, lattice) for sample in [*samples, *with_other_counts(samples, lattice)]]
    says = _learnt_says(np.concatenate([_contexts(one) for one in laid_out], axis=1))
    sums, seen = Sums(says, _even(rk.DISTRIBUTIONS, rk.SYMBOLS), _even(rk.AXIS_CONTEXTS, 3)), SymbolCounts.none()
    for one in laid_out:
        numbers_written(_coder(one), one, sums, seen, common)
        one.where[:] = -1
    pooled = seen.symbols.reshape(-1, rk.SCALES, rk.SYMBOLS)
    shapes = np.cumsum((0, *rk.SHAPES))
    mean = np.concatenate([_mean(pooled[a:b], axis=0) for a, b in pairwise(shapes)])
    shares = _shares(pooled + _TRUST * mean + _LEAST).reshape(rk.DISTRIBUTIONS, -1)
    axes = seen.axes.reshape(16, 64, 3)
    return Sums(says, shares, _shares(axes + _AXES_TRUST * _mean(axes, axis=1) + _LEAST).reshape(rk.AXIS_CONTEXTS, -1))


def first_moves() -> Moves:
    """The tables of all lattices, by their formulas."""
    odds = 1 / (1 + np.exp(-(np.arange(rk.ODDS) - rk.ODDS / 2 + 0.5) / 256))
    width = np.exp(rk.FIRST_SCALE + rk.SCALE_STEP * np.arange(rk.SCALES))
    off = (np.arange(rk.OFFS) - rk.OFFS / 2) / 4 * width[:, None]
    place, scale = _gradients(off, width[:, None])
    unit = TILE_RATE * (1 << rk.FRACTION)
    return Moves(
        np.clip(np.rint(odds * rk.ONE), 32, rk.ONE - 32).astype(np.uint16),
        np.rint(4 / width * (1 << 20 - rk.FRACTION)).astype(np.int64),
        np.rint(unit * place * width[:, None]).astype(np.int32),
        np.rint(unit * scale).astype(np.int32),
        np.maximum(np.ceil(np.log2(width / MOST_PLAIN_WIDTH)), 0).astype(np.int64),
    )


def _gradients(off: F64, width: F64) -> tuple[F64, F64]:
    """Of the logarithm of a logistic distribution's share of a number, by its place (in widths) and by log width."""
    high, low = (off + 0.5) / width, (off - 0.5) / width
    at_high, at_low = (1 / (1 + np.exp(-np.clip(x, -500, 500))) for x in (high, low))
    share = np.maximum(at_high - at_low, 1e-9)
    rise, fall = at_high * (1 - at_high), at_low * (1 - at_low)
    place, scale = -(rise - fall) / share, -(rise * high - fall * low) / share
    return np.clip(place, -_CLIPPED, _CLIPPED), np.clip(scale, -_CLIPPED, _CLIPPED)


def _laid_out(sample: Sample, lattice: Lattice) -> LaidOut:
    tile_id, quantised = sample
    return LaidOut.of(box_of(tile_id, quantised.voxel_id), quantised.voxel_id, NOTHING_KNOWN, lattice, quantised)


def _coder(one: LaidOut) -> Coder:
    return Coder.writing(priors_of(f"tile-{one.lattice.name}"), 0, five=True)


def _even(n: int, symbols: int) -> rk.U16:
    return np.tile((np.arange(symbols + 1) * rk.ONE // symbols).astype(np.uint16), (n, 1))


def _mean(counts: I64, axis: int) -> F64:
    """Shares of the symbols of all contexts together, for each of them."""
    total = counts.sum(axis=axis, keepdims=True) + 0.1
    return np.broadcast_to(total / total.sum(axis=-1, keepdims=True), counts.shape)


def _shares(weights: F64) -> rk.U16:
    """(…, S) weights as (…, S + 1) where the symbols begin; none is without a share."""
    part = weights / weights.sum(axis=-1, keepdims=True)
    share = 1 + np.floor(part * (rk.ONE - weights.shape[-1])).astype(np.int64)
    np.put_along_axis(
        share, largest := part.argmax(axis=-1)[..., None],
        np.take_along_axis(share, largest, -1) + rk.ONE - share.sum(axis=-1, keepdims=True), -1,
    )  # fmt: skip
    return np.concatenate([np.zeros_like(share[..., :1]), share.cumsum(axis=-1)], axis=-1).astype(np.uint16)


# --- what contexts say -----------------------------------------------------------------------------------------------


def _contexts(one: LaidOut) -> I32:
    """(NUMBERS, N, 6) the five contexts of each number, as rows of `says`, and its difference from what is expected."""
    found = np.zeros((v.NUMBERS, len(one.voxel_id), 6), np.int32)
    one.expect()
    _contexts_into(voxel_coding(_coder(one), one), found)
    one.where[:] = -1
    return found


@kernel
def _contexts_into(m: v.VoxelCoding, found: I32) -> None:
    for row in range(1, len(m.table)):
        place = m.table[row, v.Z] * m.floor_step + m.table[row, v.Y] * m.line_step + m.table[row, v.X]
        n, occupied = v._known_around(m, place, -1), v._occupied(m, place)
        voxel = v._voxel_at(m, row, 0, m.table[row, v.AXIS], n, occupied)
        for family in range(v.NUMBERS):
            a, b, c, d, e, want = v._expected(m, voxel, family)
            odd = m.table[row, v._COLUMN[family]] - want
            m.memo[v._ODD + family] = odd
            at, one = rk._SAYS_AT[5 * family : 5 * family + 5], found[family, row - 1]
            one[0], one[1], one[2], one[3], one[4] = at[0] + a, at[1] + b, at[2] + c, at[3] + d, at[4] + e
            one[5] = odd
        m.where[place] = row


def _learnt_says(contexts: I32) -> I32:
    """(CONTEXTS, SAYS) what each says, of FRACTION bits."""
    says, rng = np.zeros((rk.CONTEXTS, rk.SAYS)), np.random.default_rng(0)
    firsts = np.concatenate([np.arange(rk._SAYS_AT[5 * f], rk._SAYS_AT[5 * f + 1]) for f in range(v.NUMBERS)])
    says[firsts, rk.PLACE], says[firsts, rk.SCALE] = -0.5, 1.0
    for rate in RATES:
        steepness = np.full((rk.CONTEXTS, rk.SAYS), 20.0)
        steepness[:, rk.ZERO] = 5.0
        cost = [_learn(family, rng.permutation(len(family)), says, steepness, rate) for family in contexts]
        print(f"  {sum(cost) / contexts.shape[1] / 8:.3f} bytes a voxel before distributions", flush=True)
    return np.rint(says * (1 << rk.FRACTION)).astype(np.int32)


@kernel
def _learn(family: I32, order: I64, says: F64, steepness: F64, rate: float) -> float:
    """One time all numbers of a family: AdaGrad (Duchi et al., 2011); bits that they cost."""
    bits = 0.0
    for i in order:
        odd = family[i, 5]
        zero = place = scale = 0.0
        for j in range(5):
            row = family[i, j]
            zero, place, scale = zero + says[row, 0], place + says[row, 1], scale + says[row, 2]
        p = 1 / (1 + np.exp(-min(max(zero, -9.0), 9.0)))
        bits -= np.log2(p if odd == 0 else 1 - p)
        slope = (1.0 if odd == 0 else 0.0) - p
        for j in range(5):
            row = family[i, j]
            steepness[row, 0] += slope * slope + 1e-3
            says[row, 0] += rate * slope / np.sqrt(steepness[row, 0])
        if odd == 0:
            continue
        width = np.exp(min(max(scale, -3.0), 6.75))
        off = (odd - 1.0 if odd > 0 else float(odd)) - place
        sign = -1.0 if off > 0 else 1.0
        high, low = (sign * off + 0.5) / width, (sign * off - 0.5) / width
        at_high = 1 / (1 + np.exp(-high)) if high > -500 else 0.0
        at_low = 1 / (1 + np.exp(-low)) if low > -500 else 0.0
        share = max(at_high - at_low, 1e-9)
        bits -= np.log2(share)
        rise, fall = at_high * (1 - at_high), at_low * (1 - at_low)
        by_place = min(max(-sign * (rise - fall) / share, -3.0), 3.0)
        by_scale = min(max(-(rise * high - fall * low) / share, -3.0), 3.0)
        for j in range(5):
            row = family[i, j]
            steepness[row, 1] += by_place * by_place + 1e-3
            steepness[row, 2] += by_scale * by_scale + 1e-3
            says[row, 1] += rate * by_place * width / np.sqrt(steepness[row, 1])
            says[row, 2] += rate * by_scale / np.sqrt(steepness[row, 2])
    return bits


if __name__ == "__main__":
    main()
