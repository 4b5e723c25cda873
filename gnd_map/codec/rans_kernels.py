"""Numbers of a tile's Gaussians in few symbols: rANS with frozen distributions, chosen by sums that learn.

What is expected of a number and its five contexts are those of `voxel_kernels`. Each context says three things: how
likely the number is what was expected (log-odds), and where and how wide the others lie. What the five say is added. So
a number is one decision, and where it differs one of sixteen symbols of a frozen distribution; what a wide distribution
leaves open are plain bits. After each number the five contexts move along the gradient of its likelihood (logistic
regression, and a logistic distribution of place and width: Salimans et al., PixelCNN++, 2017).

Integers only. One routine writes and reads, as in `kernels`. rANS (Duda, Asymmetric numeral systems, 2013) codes last
in, first out: what is written is kept, and `shift_out` goes through it from the end.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import I32, I64
from gnd.gnd_map.codec import voxel_kernels as v
from gnd.gnd_map.jit import bare, bare_inlined

U16 = NDArray[np.uint16]
U32 = NDArray[np.uint32]

BITS: Final = 15
"""Of a probability."""
ONE: Final = 1 << BITS
LEAST: Final = 1 << 16
"""The coder's state lies between this and 2^32, and moves by words of 16 bits."""
WORD_BITS: Final = 16

WRITE: Final = 0
READ: Final = 1
COUNT: Final = 2
"""Write, and count what comes."""
_Rows = tuple[np.uint64, np.uint64, np.uint64, np.uint64, np.uint64]  # of `says`, of the five contexts of a number
Coded = tuple[int, int, int]  # what came, the coder's state after it, and how many words were read or symbols kept

FRACTION: Final = 12
"""Bits of a sum's fraction."""
ZERO: Final = 0  # columns of `says`: log-odds that a number is what was expected,
PLACE: Final = 1  # where the others lie,
SCALE: Final = 2  # and the logarithm of how widely
SAYS: Final = 4

SCALES: Final = 20
"""Widths, each e^0.5 of the one before, from e^-3 on."""
FIRST_SCALE: Final = -3.0
SCALE_STEP: Final = 0.5
SYMBOLS: Final = 16
_MIDDLE: Final = 7
_ESCAPE: Final = 15
_LENGTH_BITS: Final = 4
LARGEST: Final = (1 << 14) - 1
"""By so much a number may differ from what is expected."""
OFFS: Final = 64
"""Entries of a table of gradients: by how far a number lies off its place, in quarters of the width."""
ODDS: Final = 4096
"""Entries of the table of probabilities by log-odds, from -8 to 8."""

FAMILIES: Final = tuple((*few, *more) for few, more in zip(v._FAMILIES, v._MORE, strict=True))
"""By family the values of its five contexts."""
SHAPES: Final = (24, 4, 4, 96, 4, 27, 27, 52, 52, 36)
"""By family how many contexts choose among distributions of one width: see `_shape`."""
AXIS_CONTEXTS: Final = 16 * 64
MOST_SYMBOLS: Final = 1 + 6 * v.NUMBERS
"""Of one voxel."""


def _starts(sizes: tuple[int, ...]) -> I64:
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)


_SAYS_AT: Final = _starts(tuple(n for family in FAMILIES for n in family))
CONTEXTS: Final = int(_SAYS_AT[-1])
_SHAPES_AT: Final = _starts(SHAPES)
DISTRIBUTIONS: Final = int(_SHAPES_AT[-1]) * SCALES


class SumCoding(NamedTuple):
    """What the numbers of a tile are coded with.

    Attributes:
        mode: WRITE, READ or COUNT.
        words: (W,) uint16 to be read.
        kept: uint32 what is to be written, start << 16 | frequency; room for MOST_SYMBOLS a voxel.
        says: (CONTEXTS, SAYS) int32, learns.
        shares: (DISTRIBUTIONS, SYMBOLS + 1) uint16 where the symbols of a distribution begin, of ONE.
        axes: (AXIS_CONTEXTS, 4) uint16 likewise of the axes.
        odds: (ODDS,) uint16 probability by log-odds.
        inverse: (SCALES,) int64 quarters of a width in 2^-20 of a number's fraction.
        place_moves: (SCALES, OFFS) int32 by how much a context's place moves.
        scale_moves: (SCALES, OFFS) int32 the same of its scale.
        plain_bits: (SCALES,) int64 how many low bits are plain.
        zero_rate: how fast log-odds learn, of 2^10.
        seen: (DISTRIBUTIONS, SYMBOLS) int64 how often each came, where that is counted.
        axes_seen: (AXIS_CONTEXTS, 3) int64 likewise.
    """

    mode: int
    words: U16
    kept: U32
    says: I32
    shares: U16
    axes: U16
    odds: U16
    inverse: I64
    place_moves: I32
    scale_moves: I32
    plain_bits: I64
    zero_rate: int
    seen: I64
    axes_seen: I64


@bare
def code_numbers(c: SumCoding, m: v.VoxelCoding, first: int, state: int, at: int) -> tuple[int, int]:
    """The Gaussians of the rows `first` … of the table, in order; no other is known. `m.five` is 1.

    Args:
        c: what the numbers are coded with.
        m: what their contexts are found with.
        first: row.
        state: of the coder, where it reads.
        at: of the words, how many have been read.

    Returns:
        The state, and how many words were read, more than there are where some were missing, or symbols kept.
    """
    table = m.table
    for row in range(first, len(table)):
        place = table[row, v.Z] * m.floor_step + table[row, v.Y] * m.line_step + table[row, v.X]
        voxel, state, at = _code_axis(c, m, row, place, state, at)
        for family in range(v.NUMBERS):
            state, at = _code_number(c, m, voxel, family, state, at)
        m.where[np.uint64(place)] = row
        if c.mode == READ and at > len(c.words):
            break
    return state, at


@bare_inlined
def _code_axis(c: SumCoding, m: v.VoxelCoding, row: int, place: int, state: int, at: int) -> tuple[v._Voxel, int, int]:
    """The thin axis by those of the first two neighbours and the six across faces."""
    occupied = v._occupied(m, place)
    n = v._known_around(m, place, -1)
    first = m.table[m.known[0], v.AXIS] if n > 0 else v._NO_AXIS
    second = m.table[m.known[1], v.AXIS] if n > 1 else v._NO_AXIS
    context = np.uint64((first * 4 + second) * 64 + occupied)
    axis = m.table[row, v.AXIS]
    if c.mode == READ:
        slot = state & (ONE - 1)
        axis = (1 if slot >= c.axes[context, 1] else 0) + (1 if slot >= c.axes[context, 2] else 0)
        m.table[row, v.AXIS] = axis
    elif c.mode == COUNT:
        c.axes_seen[context, axis] += 1
    start = int(c.axes[context, np.uint64(axis)])
    state, at = _take(c, start, c.axes[context, np.uint64(axis + 1)] - start, state, at)
    return v._voxel_at(m, row, 0, axis, n, occupied), state, at


@bare_inlined
def _take(c: SumCoding, start: int, share: int, state: int, at: int) -> tuple[int, int]:
    """Keep a symbol to be written, or move on past the one that was read."""
    if c.mode != READ:
        c.kept[np.uint64(at)] = start << WORD_BITS | share
        return state, at + 1
    state = share * (state >> BITS) + (state & (ONE - 1)) - start
    if state < LEAST:
        word = int(c.words[np.uint64(at)]) if at < len(c.words) else 0
        return state << WORD_BITS | word, at + 1
    return state, at


@bare_inlined
def _plain(c: SumCoding, bits: int, n: int, state: int, at: int) -> Coded:
    """Write or read `n` plain bits."""
    if c.mode == READ:
        bits = (state & (ONE - 1)) >> (BITS - n)
    state, at = _take(c, bits << (BITS - n), 1 << (BITS - n), state, at)
    return bits, state, at


@bare_inlined
def _code_number(c: SumCoding, m: v.VoxelCoding, voxel: v._Voxel, family: int, state: int, at: int) -> tuple[int, int]:
    """A number of a family: whether it is what is expected, else where it lies by what the contexts say."""
    ca, cb, cc, cd, ce, want = v._expected(m, voxel, family)
    says, first = c.says, 5 * family
    a, b, d = np.uint64(_SAYS_AT[first] + ca), np.uint64(_SAYS_AT[first + 1] + cb), np.uint64(_SAYS_AT[first + 2] + cc)
    e, f = np.uint64(_SAYS_AT[first + 3] + cd), np.uint64(_SAYS_AT[first + 4] + ce)
    row, column = np.uint64(voxel.row), np.uint64(v._COLUMN[family])
    odd = m.table[row, column] - want
    log_odds = _sum(says, (a, b, d, e, f), _ZERO)
    share = int(c.odds[np.uint64(min(max((log_odds >> 4) + ODDS // 2, 0), ODDS - 1))])
    bit = 1 if odd == 0 else 0
    if c.mode == READ:
        bit = 1 if (state & (ONE - 1)) < share else 0
    move = ((bit << BITS) - share) * c.zero_rate >> 10
    _add(says, (a, b, d, e, f), _ZERO, move)
    if bit == 1:
        state, at = _take(c, 0, share, state, at)
        odd = 0
    else:
        state, at = _take(c, share, ONE - share, state, at)
        place = _sum(says, (a, b, d, e, f), _PLACE)
        scale = _sum(says, (a, b, d, e, f), _SCALE)
        width = np.uint64(min(max((scale + _FIRST_STEP) >> _STEP_BITS, 0), SCALES - 1))
        quarter = (place + (1 << (FRACTION - 3))) >> (FRACTION - 2)
        which = np.uint64((_SHAPES_AT[family] + _shape(family, cb, ce, (quarter + 2) & 3)) * SCALES) + width
        odd, state, at = _off_place(c, which, width, (quarter + 2) >> 2, odd, state, at)
        # The numbers on both sides of the one that did not come lie side by side.
        off = ((odd - (1 if odd > 0 else 0)) << FRACTION) - place
        entry = np.uint64(min(max(off * c.inverse[width] >> 20, -31), 31) + 32)
        _add(says, (a, b, d, e, f), _PLACE, c.place_moves[width, entry])
        _add(says, (a, b, d, e, f), _SCALE, c.scale_moves[width, entry])
    m.memo[v._ODD + family] = odd
    found = want + odd
    m.table[row, column] = v._clip(found, 0, m.tops[family]) if family < v.TOPS else found
    return state, at


_STEP_BITS: Final = FRACTION - 1  # of SCALE_STEP
_FIRST_STEP: Final = int(-FIRST_SCALE * (1 << FRACTION)) + (1 << (_STEP_BITS - 1))
_ZERO, _PLACE, _SCALE = (np.uint64(i) for i in (ZERO, PLACE, SCALE))


@bare_inlined
def _sum(says: I32, at: _Rows, column: np.uint64) -> int:
    """What five contexts say."""
    a, b, c, d, e = at
    found: int = says[a, column] + says[b, column] + says[c, column] + says[d, column] + says[e, column]
    return found


@bare_inlined
def _add(says: I32, at: _Rows, column: np.uint64, move: int) -> None:
    """Move what they say."""
    a, b, c, d, e = at
    says[a, column] += move
    says[b, column] += move
    says[c, column] += move
    says[d, column] += move
    says[e, column] += move


@bare_inlined
def _shape(family: int, b: int, e: int, quarter: int) -> int:
    """What chooses among the distributions of one width: the second or fifth context, or a fraction of the place."""
    if family == v._LEVEL_C:
        return b
    if family == v._COUNT:
        return b * 4 + quarter
    if family == v._SLOPE_CB or family == v._SLOPE_CA:
        return e >> 2
    if family == v._STEP_A or family == v._STEP_B:
        return e
    if family == v._STEP_C:
        return e // 9
    return quarter


@bare_inlined
def _off_place(c: SumCoding, which: np.uint64, width: np.uint64, place: int, odd: int, state: int, at: int) -> Coded:
    """Write or read a number other than 0, which is expected near `place`."""
    plain = c.plain_bits[width]
    off = odd - (1 if odd > 0 else 0) - place
    coarse = off >> plain
    symbol = coarse + _MIDDLE if -_MIDDLE <= coarse <= _MIDDLE else _ESCAPE
    symbol, state, at = _symbol(c, which, symbol, state, at)
    if symbol == _ESCAPE:
        coarse, state, at = _escaped(c, coarse, state, at)
    else:
        coarse = symbol - _MIDDLE
    if plain > 0:
        low, state, at = _plain(c, off & ((1 << plain) - 1), plain, state, at)
        coarse = coarse << plain | low
    off = coarse + place
    return v._clip(off + (1 if off >= 0 else 0), -LARGEST, LARGEST), state, at


@bare_inlined
def _symbol(c: SumCoding, which: np.uint64, symbol: int, state: int, at: int) -> Coded:
    """Write or read a symbol of a distribution."""
    shares = c.shares
    if c.mode == READ:
        slot = np.uint16(state & (ONE - 1))
        symbol = _begun(shares, which, 4, slot) + _begun(shares, which, 8, slot) + _begun(shares, which, 12, slot)
        symbol *= 4  # two steps of three looks each, none of them a branch
        symbol += (
            _begun(shares, which, symbol + 1, slot)
            + _begun(shares, which, symbol + 2, slot)
            + _begun(shares, which, symbol + 3, slot)
        )
    elif c.mode == COUNT:
        c.seen[which, np.uint64(symbol)] += 1
    start = int(shares[which, np.uint64(symbol)])
    state, at = _take(c, start, shares[which, np.uint64(symbol + 1)] - start, state, at)
    return symbol, state, at


@bare_inlined
def _begun(shares: U16, which: np.uint64, symbol: int, slot: np.uint16) -> int:
    """1 where a symbol begins at or before `slot`."""
    return 1 if shares[which, np.uint64(symbol)] <= slot else 0


@bare_inlined
def _escaped(c: SumCoding, coarse: int, state: int, at: int) -> Coded:
    """A number beyond the symbols: its sign and length, then its digits after the first."""
    is_below = 1 if coarse < 0 else 0
    beyond = abs(coarse) - _MIDDLE
    length = 0
    while beyond >> (length + 1) > 0:
        length += 1
    head, state, at = _plain(c, is_below << _LENGTH_BITS | length, 1 + _LENGTH_BITS, state, at)
    is_below, length = head >> _LENGTH_BITS, head & ((1 << _LENGTH_BITS) - 1)
    if length > 0:
        beyond, state, at = _plain(c, beyond & ((1 << length) - 1), length, state, at)
        beyond |= 1 << length
    else:
        beyond = 1
    return (-(beyond + _MIDDLE) if is_below == 1 else beyond + _MIDDLE), state, at


@bare
def shift_out(kept: U32, n: int, words: U16) -> int:
    """Write the first `n` symbols that were kept into the end of `words`; where they begin."""
    state, at = np.uint64(LEAST), len(words)
    for i in range(n - 1, -1, -1):
        symbol = np.uint64(kept[i])
        start, share = symbol >> np.uint64(WORD_BITS), symbol & np.uint64(0xFFFF)
        if state >= share << np.uint64(2 * WORD_BITS - BITS):
            at -= 1
            words[at] = state & np.uint64(0xFFFF)
            state >>= np.uint64(WORD_BITS)
        whole = state // share
        state = (whole << np.uint64(BITS)) + (state - whole * share) + start
    words[at - 1], words[at - 2] = state & np.uint64(0xFFFF), state >> np.uint64(WORD_BITS)
    return at - 2
