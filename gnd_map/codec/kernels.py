"""The entropy stage: an adaptive binary range coder with mixed contexts, and the models of voxels that it codes by.

Integers only. One routine both writes and reads: `coder[MODE]` says which; where it writes, the columns hold what is to
be written, where it reads, they are filled. So writer and reader cannot differ.

Contexts learn: a probability of 16 bits and a count each, starting from frozen tables (`priors`). A decision's
probability is a mix of three contexts in the logistic domain, whose weights learn too (as in the PAQ family of
compressors; Mahoney, Adaptive weighing of context models for lossless data compression, 2005).
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import I64
from gnd.gnd_map.jit import bare, bare_inlined

U8 = NDArray[np.uint8]
Three = tuple[int, int, int]
Five = tuple[int, int, int, int, int]
Ends = tuple[int, int, int]  # a decision, and the ends of the interval after it
State = Any  # (coder, buffer, places, weight): arrays, see `coding.Coder`; a place is probability << 8 | times seen

# Slots of `coder` (int64).
LOW: Final = 0
HIGH: Final = 1
CODE: Final = 2
AT: Final = 3
MODE: Final = 4  # 0 writes, 1 reads, 2 writes and counts
OVERRUN: Final = 5
TROUBLE: Final = 6
FIELD: Final = 7  # which field is coded: 0 voxels, 1 axis, 2 … the numbers
SPENT: Final = 8  # bits of each field, 2^-16; only where they are counted
FIELDS: Final = 12
SLOTS: Final = SPENT + FIELDS
FULL: Final = 1
TOO_SHORT: Final = 2
TOO_LARGE: Final = 3
MOST_OVERRUN: Final = 4

_TOP: Final = 0xFFFFFFFF
_ONE: Final = 65536

# 65536 / (1 + exp(-d / 256)) at d = -2048, -1984 ... 2048.
_KNOTS: Final = (
    24, 28, 36, 47, 60, 77, 98, 126, 162, 208, 267, 342, 439, 562, 720, 922, 1179, 1506, 1921, 2446, 3108, 3938, 4971,
    6249, 7812, 9702, 11955, 14595, 17625, 21025, 24743, 28693, 32768, 36843, 40793, 44511, 47911, 50941, 53581, 55834,
    57724, 59287, 60565, 61598, 62428, 63090, 63615, 64030, 64357, 64614, 64816, 64974, 65097, 65194, 65269, 65328,
    65374, 65410, 65438, 65459, 65476, 65489, 65500, 65508, 65512,
)  # fmt: skip


def _squash_table() -> I64:
    """(4097,) probability of 16 bits by d = -2048 .. 2048."""
    d = np.arange(4097)
    knots = np.array([*_KNOTS, _KNOTS[-1]], np.int64)
    at, part = d >> 6, d & 63
    return np.asarray((knots[at] * (64 - part) + knots[at + 1] * part + 32) >> 6, np.int64)


def _stretch_table() -> I64:
    """(4096,) the inverse: d by probability of 12 bits."""
    return np.asarray(np.minimum(np.searchsorted(_squash_table(), (np.arange(4096) << 4) + 8), 4096) - 2048, np.int64)


_SQUASH: Final = _squash_table().astype(np.uint16)
_STRETCH: Final = _stretch_table().astype(np.int16)
_STEP: Final = np.array([2 * _ONE // (2 * n + 3) for n in range(256)], np.int32)
_LIMIT: Final = 250
_MIX_RATE: Final = 6
_U0, _U1, _U2, _U3, _U4 = (np.uint64(i) for i in range(5))
_COST: Final = np.round(-_ONE * np.log2(np.maximum(np.arange(4097), 0.5) / 4096)).astype(np.int64)
"""Bits of a decision, 2^-16, by its probability of 12 bits: for measures only, no byte depends on it."""


@bare
def _shift_out(coder: I64, buffer: U8) -> None:
    """Move the bytes on which both ends of the interval agree."""
    while ((coder[LOW] ^ coder[HIGH]) & 0xFF000000) == 0:
        if coder[MODE] != 1:
            if coder[AT] >= len(buffer):
                coder[TROUBLE] = FULL
                coder[AT] = 0
            buffer[coder[AT]] = (coder[HIGH] >> 24) & 0xFF
            coder[AT] += 1
        else:
            byte = 0
            if coder[AT] < len(buffer):
                byte = buffer[coder[AT]]
            else:
                coder[OVERRUN] += 1
                if coder[OVERRUN] > MOST_OVERRUN:
                    coder[TROUBLE] = TOO_SHORT
            coder[AT] += 1
            coder[CODE] = ((coder[CODE] << 8) & _TOP) | byte
        coder[LOW] = (coder[LOW] << 8) & _TOP
        coder[HIGH] = ((coder[HIGH] << 8) & _TOP) | 0xFF


@bare_inlined
def _code(coder: I64, buffer: U8, low: int, high: int, p: int, bit: int) -> Ends:
    """Write `bit`, or read one, in the interval from `low` to `high`; `p` of 65536 is the probability of a 1.

    The interval is the caller's, which keeps it in registers from decision to decision; it lies in `coder` whenever
    bytes are moved.
    """
    span = high - low
    middle = low + (span >> 16) * p + (((span & 0xFFFF) * p) >> 16)
    if coder[MODE] != 0:
        if coder[MODE] == 1:
            bit = 1 if coder[CODE] <= middle else 0
        else:
            coder[np.uint64(SPENT + coder[FIELD])] += _COST[np.uint64((p if bit == 1 else _ONE - p) >> 4)]
    low, high = (low, middle) if bit == 1 else (middle + 1, high)
    if ((low ^ high) & 0xFF000000) == 0:
        coder[LOW], coder[HIGH] = low, high
        _shift_out(coder, buffer)
        low, high = coder[LOW], coder[HIGH]
    return bit, low, high


@bare_inlined
def _learnt(place: int, bit: int) -> int:
    """A context after a decision: its probability moves towards what came, the less the more it has seen."""
    n = place & 0xFF  # at most _LIMIT
    moved: int = ((bit << 16) - bit - (place >> 8)) * _STEP[np.uint64(n)] >> 16
    return place + (moved << 8) + (1 if n < _LIMIT else 0)


@bare_inlined
def _stretch(place: int) -> int:
    """The probability of a context in the logistic domain."""
    return np.int64(_STRETCH[np.uint64(place >> 12)])  # type: ignore[return-value]  # an int64 to numba


@bare_inlined
def _squash(dot: int) -> int:
    """Probability of 16 bits by a weighted sum of `_stretch`."""
    return np.int64(_SQUASH[np.uint64(min(max(dot >> 16, -2047), 2047) + 2048)])  # type: ignore[return-value]


@bare_inlined
def _moved(s: int, error: int) -> int:
    """By how much the weight of a context with this `_stretch` moves."""
    return (s * error + 0x80000) >> 20


@bare
def code_bit(state: State, at: int, bit: int) -> int:
    """One decision in one context."""
    coder, buffer, places, _ = state
    place = places[at]
    bit, coder[LOW], coder[HIGH] = _code(coder, buffer, coder[LOW], coder[HIGH], min(max(place >> 8, 6), _ONE - 6), bit)
    places[at] = _learnt(place, bit)
    return bit


@bare_inlined
def _mixed(state: State, low: int, high: int, at: Three, w: int, bit: int) -> Ends:
    """One decision in three contexts, mixed by the weights at `w`, in the interval from `low` to `high`."""
    coder, buffer, places, weight = state
    # Indices are never negative: without a sign nothing is spent on those that would be.
    a, b, c, row = np.uint64(at[0]), np.uint64(at[1]), np.uint64(at[2]), np.uint64(w)
    pa, pb, pc = int(places[a]), int(places[b]), int(places[c])
    sa, sb, sc = _stretch(pa), _stretch(pb), _stretch(pc)
    wa, wb, wc = weight[row, _U0], weight[row, _U1], weight[row, _U2]
    p = _squash(wa * sa + wb * sb + wc * sc)
    bit, low, high = _code(coder, buffer, low, high, p, bit)
    error = ((bit << 16) - p) * _MIX_RATE
    weight[row, _U0], weight[row, _U1] = wa + _moved(sa, error), wb + _moved(sb, error)
    weight[row, _U2] = wc + _moved(sc, error)
    places[a], places[b], places[c] = _learnt(pa, bit), _learnt(pb, bit), _learnt(pc, bit)
    return bit, low, high


@bare_inlined
def _mixed_5(state: State, low: int, high: int, at: Five, w: int, bit: int) -> Ends:
    """`_mixed` in five contexts."""
    coder, buffer, places, weight = state
    a, b, c, d, e = np.uint64(at[0]), np.uint64(at[1]), np.uint64(at[2]), np.uint64(at[3]), np.uint64(at[4])
    row = np.uint64(w)
    pa, pb, pc = int(places[a]), int(places[b]), int(places[c])
    pd, pe = int(places[d]), int(places[e])
    sa, sb, sc, sd, se = _stretch(pa), _stretch(pb), _stretch(pc), _stretch(pd), _stretch(pe)
    wa, wb, wc, wd, we = weight[row, _U0], weight[row, _U1], weight[row, _U2], weight[row, _U3], weight[row, _U4]
    p = _squash(wa * sa + wb * sb + wc * sc + wd * sd + we * se)
    bit, low, high = _code(coder, buffer, low, high, p, bit)
    error = ((bit << 16) - p) * _MIX_RATE
    weight[row, _U0], weight[row, _U1] = wa + _moved(sa, error), wb + _moved(sb, error)
    weight[row, _U2], weight[row, _U3] = wc + _moved(sc, error), wd + _moved(sd, error)
    weight[row, _U4] = we + _moved(se, error)
    places[a], places[b], places[c] = _learnt(pa, bit), _learnt(pb, bit), _learnt(pc, bit)
    places[d], places[e] = _learnt(pd, bit), _learnt(pe, bit)
    return bit, low, high


@bare
def code_mixed(state: State, a: int, b: int, c: int, w: int, bit: int) -> int:
    """One decision in three contexts, mixed by the weights at `w`."""
    coder = state[0]
    bit, coder[LOW], coder[HIGH] = _mixed(state, coder[LOW], coder[HIGH], (a, b, c), w, bit)
    return bit


WIDTH: Final = 25
"""Contexts of one number: 14 for its length in bits, one for its sign, the rest for its leading digits."""
_SIGN: Final = 14
_LEAD: Final = 15
_LONGEST: Final = 14


@bare
def code_signed(state: State, at: Three, w: int, value: int) -> int:
    """A signed number below 2^14 in three contexts of WIDTH places each; mixing weights from `w` on."""
    coder = state[0]
    low, high = coder[LOW], coder[HIGH]
    a, b, c = at
    size = abs(value)
    k = 0
    while k < _LONGEST:
        bit, low, high = _mixed(state, low, high, (a + k, b + k, c + k), w + k, 1 if size >> k > 0 else 0)
        if bit == 0:
            break
        k += 1
    found = 0
    if k > 0:
        i = _SIGN
        sign, low, high = _mixed(state, low, high, (a + i, b + i, c + i), w + i, 1 if value < 0 else 0)
        found = 1
        for j in range(k - 2, -1, -1):
            i = _LEAD + (min(k, 6) - 2 if j == k - 2 else (min(k, 6) + 2 if j == k - 3 else 9))
            bit, low, high = _mixed(state, low, high, (a + i, b + i, c + i), w + i, (size >> j) & 1)
            found = found << 1 | bit
        found = -found if sign == 1 else found
    coder[LOW], coder[HIGH] = low, high
    return found


@bare
def code_signed_5(state: State, at: Five, w: int, value: int) -> int:
    """`code_signed` in five contexts."""
    coder = state[0]
    low, high = coder[LOW], coder[HIGH]
    a, b, c, d, e = at
    size = abs(value)
    k = 0
    while k < _LONGEST:
        places = (a + k, b + k, c + k, d + k, e + k)
        bit, low, high = _mixed_5(state, low, high, places, w + k, 1 if size >> k > 0 else 0)
        if bit == 0:
            break
        k += 1
    found = 0
    if k > 0:
        i = _SIGN
        places = (a + i, b + i, c + i, d + i, e + i)
        sign, low, high = _mixed_5(state, low, high, places, w + i, 1 if value < 0 else 0)
        found = 1
        for j in range(k - 2, -1, -1):
            i = _LEAD + (min(k, 6) - 2 if j == k - 2 else (min(k, 6) + 2 if j == k - 3 else 9))
            places = (a + i, b + i, c + i, d + i, e + i)
            bit, low, high = _mixed_5(state, low, high, places, w + i, (size >> j) & 1)
            found = found << 1 | bit
        found = -found if sign == 1 else found
    coder[LOW], coder[HIGH] = low, high
    return found


@bare
def code_plain(state: State, at: int, value: int) -> int:
    """A signed number below 2^31 in one context of 2 · 34 places."""
    coder = state[0]
    size = abs(value)
    length = 0
    while (size >> length) > 0:
        length += 1
    k = 0
    while code_bit(state, at + k, 1 if length > k else 0) == 1:
        k += 1
        if k > 31:
            coder[TROUBLE] = TOO_LARGE
            return 0
    if k == 0:
        return 0
    found = 1
    for i in range(k - 2, -1, -1):
        found = found << 1 | code_bit(state, at + 34 + min(k, 32), (size >> i) & 1)
    return -found if code_bit(state, at + 33, 1 if value < 0 else 0) == 1 else found


@bare
def code_bits(state: State, at: int, bits: U8) -> None:
    """Decisions (N,) one after the other, each in the context of the three before."""
    before = 0
    for i in range(len(bits)):
        bits[i] = code_bit(state, at + before, bits[i])
        before = (before << 1 | bits[i]) & 7
        if state[0][TROUBLE] != 0:
            return


# Flags: what becomes of each voxel of a volume, against the voxels that both sides hold.
NONE: Final = 0
PUT: Final = 1  # where nothing was
REPLACED: Final = 2
GONE: Final = 3
EDGE: Final = 2  # voxels of padding around a volume
BLOCK: Final = 4

BLOCK_CONTEXTS: Final = 5 * 4 * 2
CELL_A: Final = 2048
CELL_B: Final = 512
CELL_C: Final = 256
CELL_CONTEXTS: Final = CELL_A + CELL_B + CELL_C
KIND_CONTEXTS: Final = 16


@bare
def code_flags(state: State, held: U8, flag: U8, mark: U8, size: Three, at: int, w: int) -> int:
    """What becomes of each voxel; blocks of 4 x 4 x 4 without a flag cost one decision.

    Args:
        state: coder and contexts.
        held: ((nz + 4) · (ny + 4) · (nx + 4),) 1 where both sides hold a Gaussian; padded by EDGE.
        flag: as `held`, the flags to write, or zeros to read into.
        mark: (nz', ny', nx') blocks, padded by 1; room to work in.
        size: nz, ny, nx.
        at: first context: BLOCK_CONTEXTS, CELL_CONTEXTS, KIND_CONTEXTS follow.
        w: first mixing weights: 8.

    Returns:
        How many voxels are flagged.
    """
    some = 0
    for i in range(len(held)):
        some |= held[i]
    _code_blocks(state, held, flag, mark, size, at, some)
    return _code_cells(state, held, flag, mark, size, at + BLOCK_CONTEXTS, w, some)


@bare_inlined
def _code_blocks(state: State, held: U8, flag: U8, mark: U8, size: Three, at: int, some: int) -> None:
    """Which blocks hold a flag."""
    for bz in range(1, mark.shape[0] - 1):
        for by in range(1, mark.shape[1] - 1):
            for bx in range(1, mark.shape[2] - 1):
                known, any_flag = _in_block(held, flag, size, (bz - 1) * BLOCK, (by - 1) * BLOCK, (bx - 1) * BLOCK)
                near = mark[bz, by, bx - 1] + mark[bz, by - 1, bx] + mark[bz - 1, by, bx] + mark[bz, by - 1, bx + 1]
                level = 0 if known == 0 else (1 if known < 4 else (2 if known < 12 else 3))
                mark[bz, by, bx] = code_bit(state, at + (near * 4 + level) * 2 + some, any_flag)
        if state[0][TROUBLE] != 0:
            return


@bare_inlined
def _in_block(held: U8, flag: U8, size: Three, z0: int, y0: int, x0: int) -> tuple[int, int]:
    """How many voxels of a block are held, and whether one is flagged, 1 or 0."""
    line, floor = _steps(size)
    known = flags = 0
    for z in range(z0, min(z0 + BLOCK, size[0])):
        for y in range(y0, min(y0 + BLOCK, size[1])):
            start = (z + EDGE) * floor + (y + EDGE) * line + EDGE
            for i in range(start + x0, start + min(x0 + BLOCK, size[2])):
                known += held[np.uint64(i)]
                flags |= flag[np.uint64(i)]
    return known, 1 if flags != NONE else 0


@bare_inlined
def _steps(size: Three) -> tuple[int, int]:
    """From a voxel to the next one along y, and to the one above it."""
    line = size[2] + 2 * EDGE
    return line, line * (size[1] + 2 * EDGE)


@bare_inlined
def _code_cells(state: State, held: U8, flag: U8, mark: U8, size: Three, at: int, w: int, some: int) -> int:
    """The voxels of marked blocks in raster order."""
    count = 0
    line, floor = _steps(size)
    for z in range(size[0]):
        for y in range(size[1]):
            for bx in range(1, mark.shape[2] - 1):
                if mark[np.uint64(1 + z // BLOCK), np.uint64(1 + y // BLOCK), np.uint64(bx)] == 0:
                    continue
                for x in range((bx - 1) * BLOCK, min(bx * BLOCK, size[2])):
                    i = (z + EDGE) * floor + (y + EDGE) * line + x + EDGE
                    c = _block_context(mark, z, y, x) << 1 | some
                    count += _code_cell(state, held, flag, i, (line, floor), at, w, c)
        if state[0][TROUBLE] != 0:
            return count
    return count


@bare_inlined
def _block_context(mark: U8, z: int, y: int, x: int) -> int:
    """Whether the blocks are marked in which the next voxel along x lies, and the one above: two bits."""
    bz, by, bx = np.uint64(1 + z // BLOCK), np.uint64(1 + y // BLOCK), np.uint64(1 + x // BLOCK)
    beside = mark[bz, by, np.uint64(1 + (x + 1) // BLOCK)]
    found: int = beside + 2 * mark[np.uint64(1 + (z + 1) // BLOCK), by, bx]
    return found


@bare_inlined
def _code_cell(state: State, held: U8, flag: U8, i: int, steps: tuple[int, int], at: int, w: int, around: int) -> int:
    """One voxel, the one at `i`; 1 where it is flagged. `around` is `_block_context` and whether anything is held."""
    some = around & 1
    a, b, c = _cell_contexts(held, flag, i, steps, some)
    own: Any = np.int64(held[np.uint64(i)])
    now = flag[np.uint64(i)]
    a, b, c = at + a, at + CELL_A + b, at + CELL_A + CELL_B + (c << 3 | around)
    if code_mixed(state, a, b, c, w + some * 4 + own, 1 if now != NONE else 0) == 0:
        return 0
    if own == 0:
        flag[np.uint64(i)] = PUT
        return 1
    line, floor = steps
    x, y, z = flag[np.uint64(i - 1)], flag[np.uint64(i - line)], flag[np.uint64(i - floor)]
    gone, other = (x == GONE) + (y == GONE) + (z == GONE), (x == REPLACED) + (y == REPLACED) + (z == REPLACED)
    is_gone = code_bit(state, at + CELL_CONTEXTS + gone * 4 + other, 1 if now == GONE else 0)
    flag[np.uint64(i)] = GONE if is_gone == 1 else REPLACED
    return 1


@bare_inlined
def _cell_contexts(held: U8, flag: U8, i: int, steps: tuple[int, int], some: int) -> tuple[int, int, int]:
    """Three contexts of a voxel: flags that are known already, what is held around it, how many of both."""
    line, floor = steps
    here, below = _line_bits(flag, i), _line_bits(flag, i - floor)
    before, under = _line_bits(flag, i - line), _line_bits(flag, i - floor - line)
    past = _line_bits(flag, i - floor + line)
    near = (here & 1) + _ones(before) + _ones(below) + _ones(under) + _ones(past)
    if some == 0:
        far = (
            _is_flag(flag, i - 2) | _is_flag(flag, i - 2 * line) << 1 | _is_flag(flag, i - 2 * floor) << 2
        )  # fmt: skip
        nearest = here & 1 | before & 2 | (below & 2) << 1
        a = nearest | (before & 1) << 3 | (before & 4) << 2 | (below & 1) << 5 | (below & 4) << 4
        a |= (under & 2) << 6 | (past & 2) << 7 | (far & 1) << 9
        b = nearest | far << 3 | (past & 4) << 4 | (under & 1) << 7
        return a, b, min(near, 7) * 4
    own: Any = np.int64(held[np.uint64(i)])
    x, y, z = flag[np.uint64(i - 1)], flag[np.uint64(i - line)], flag[np.uint64(i - floor)]
    seen: Any = np.int64(x) << 4 | np.int64(y) << 2 | np.int64(z)
    a = seen << 3 | before & 4 | (below & 4) >> 1 | own
    b = 256 | _held_pattern(held, i, steps) << 2 | own << 1 | (1 if x != NONE or y != NONE or z != NONE else 0)
    up: Any = 0
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            up += np.int64(held[np.uint64(i + dy * line + dx)]) + held[np.uint64(i + floor + dy * line + dx)]
    return 1024 + a, b, min(near, 7) * 4 + (0 if up == 0 else (1 if up < 4 else (2 if up < 9 else 3)))


@bare_inlined
def _is_flag(flag: U8, i: int) -> int:
    return 1 if flag[np.uint64(i)] != NONE else 0


@bare_inlined
def _line_bits(flag: U8, i: int) -> int:
    """Of a voxel and the two beside it along x, whether they are flagged: one bit each."""
    return _is_flag(flag, i - 1) | _is_flag(flag, i) << 1 | _is_flag(flag, i + 1) << 2


@bare_inlined
def _ones(bits: int) -> int:
    """How many of three bits are set."""
    return (bits & 1) + (bits >> 1 & 1) + (bits >> 2)


@bare_inlined
def _held_pattern(held: U8, i: int, steps: tuple[int, int]) -> int:
    """The six neighbours across faces: one bit each."""
    line, floor = steps
    found: int = (
        held[np.uint64(i - 1)]
        | held[np.uint64(i + 1)] << 1
        | held[np.uint64(i - line)] << 2
        | held[np.uint64(i + line)] << 3
        | held[np.uint64(i - floor)] << 4
        | held[np.uint64(i + floor)] << 5
    )
    return found
