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

from gnd.gnd_map.arrays import I32, I64
from gnd.gnd_map.jit import bare, bare_inlined

U8 = NDArray[np.uint8]
State = Any  # (coder, buffer, places, weight): arrays, see `coding.Coder`; a place is probability << 8 | times seen

# Slots of `coder` (int64).
LOW: Final = 0
HIGH: Final = 1
CODE: Final = 2
AT: Final = 3
MODE: Final = 4  # 0 writes, 1 reads
OVERRUN: Final = 5
TROUBLE: Final = 6
SLOTS: Final = 7
FULL: Final = 1
TOO_SHORT: Final = 2
TOO_LARGE: Final = 3
MOST_OVERRUN: Final = 4

_TOP: Final = 0xFFFFFFFF
_ONE: Final = 65536
_LEAST: Final = 24

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


_SQUASH: Final = _squash_table().astype(np.int32)
_STRETCH: Final = _stretch_table().astype(np.int16)
_STEP: Final = np.array([2 * _ONE // (2 * n + 3) for n in range(256)], np.int64)
_LIMIT: Final = 250
_MIX_RATE: Final = 6


@bare
def _shift_out(coder: I64, buffer: U8) -> None:
    """Move the bytes on which both ends of the interval agree."""
    while ((coder[LOW] ^ coder[HIGH]) & 0xFF000000) == 0:
        if coder[MODE] == 0:
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
def _code(coder: I64, buffer: U8, p: int, bit: int) -> int:
    """Write `bit`, or read one; `p` of 65536 is the probability of a 1."""
    span = coder[HIGH] - coder[LOW]
    middle = coder[LOW] + (span >> 16) * p + (((span & 0xFFFF) * p) >> 16)
    if coder[MODE] == 1:
        bit = 1 if coder[CODE] <= middle else 0
    if bit == 1:
        coder[HIGH] = middle
    else:
        coder[LOW] = middle + 1
    if ((coder[LOW] ^ coder[HIGH]) & 0xFF000000) == 0:
        _shift_out(coder, buffer)
    return bit


@bare_inlined
def _learnt(place: int, bit: int) -> int:
    """A context after a decision: its probability moves towards what came, the less the more it has seen."""
    p, n = place >> 8, place & 0xFF
    p += ((bit << 16) - bit - p) * _STEP[n] >> 16
    learnt: int = p << 8 | min(n + 1, _LIMIT)
    return learnt


@bare
def code_bit(state: State, at: int, bit: int) -> int:
    """One decision in one context."""
    coder, buffer, places, _ = state
    place = places[at]
    bit = _code(coder, buffer, min(max(place >> 8, 6), _ONE - 6), bit)
    places[at] = _learnt(place, bit)
    return bit


@bare
def code_mixed(state: State, a: int, b: int, c: int, w: int, bit: int) -> int:
    """One decision in three contexts, mixed by the weights at `w`."""
    coder, buffer, places, weight = state
    pa, pb, pc = places[a], places[b], places[c]
    sa, sb, sc = np.int64(_STRETCH[pa >> 12]), np.int64(_STRETCH[pb >> 12]), np.int64(_STRETCH[pc >> 12])
    d = (weight[w, 0] * sa + weight[w, 1] * sb + weight[w, 2] * sc) >> 16
    p = np.int64(_SQUASH[min(max(d, -2047), 2047) + 2048])
    bit = _code(coder, buffer, p, bit)  # type: ignore[arg-type]  # an int64 to numba
    error = ((bit << 16) - p) * _MIX_RATE
    weight[w, 0] += (sa * error + 0x80000) >> 20
    weight[w, 1] += (sb * error + 0x80000) >> 20
    weight[w, 2] += (sc * error + 0x80000) >> 20
    places[a], places[b], places[c] = _learnt(pa, bit), _learnt(pb, bit), _learnt(pc, bit)
    return bit


WIDTH: Final = 25
"""Contexts of one number: 14 for its length in bits, one for its sign, the rest for its leading digits."""
_SIGN: Final = 14
_LEAD: Final = 15
_LONGEST: Final = 14


@bare
def code_signed(state: State, a: int, b: int, c: int, w: int, value: int) -> int:
    """A signed number below 2^14 in three contexts of WIDTH places each; mixing weights from `w` on."""
    size = abs(value)
    length = 0
    while (size >> length) > 0:
        length += 1
    k = 0
    while k < _LONGEST and code_mixed(state, a + k, b + k, c + k, w + k, 1 if length > k else 0) == 1:
        k += 1
    if k == 0:
        return 0
    sign = code_mixed(state, a + _SIGN, b + _SIGN, c + _SIGN, w + _SIGN, 1 if value < 0 else 0)
    found = 1
    for i in range(k - 2, -1, -1):
        lead = _LEAD + (min(k, 6) - 2 if i == k - 2 else (min(k, 6) + 2 if i == k - 3 else 9))
        found = found << 1 | code_mixed(state, a + lead, b + lead, c + lead, w + lead, (size >> i) & 1)
    return -found if sign == 1 else found


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
def code_flags(state: State, held: U8, flag: U8, mark: U8, at: int, w: int) -> int:
    """What becomes of each voxel; blocks of 4 x 4 x 4 without a flag cost one decision.

    Args:
        state: coder and contexts.
        held: (nz + 4, ny + 4, nx + 4) 1 where both sides hold a Gaussian; padded by EDGE.
        flag: as `held`, the flags to write, or zeros to read into.
        mark: (nz', ny', nx') blocks, padded by 1; room to work in.
        at: first context: BLOCK_CONTEXTS, CELL_CONTEXTS, KIND_CONTEXTS follow.
        w: first mixing weights: 8.

    Returns:
        How many voxels are flagged.
    """
    some = 0
    for z in range(EDGE, held.shape[0] - EDGE):
        for y in range(EDGE, held.shape[1] - EDGE):
            for x in range(EDGE, held.shape[2] - EDGE):
                some |= held[z, y, x]
    _code_blocks(state, held, flag, mark, at, some)
    return _code_cells(state, held, flag, mark, at + BLOCK_CONTEXTS, w, some)


@bare
def _code_blocks(state: State, held: U8, flag: U8, mark: U8, at: int, some: int) -> None:
    """Which blocks hold a flag."""
    for bz in range(1, mark.shape[0] - 1):
        for by in range(1, mark.shape[1] - 1):
            for bx in range(1, mark.shape[2] - 1):
                known = any_flag = 0
                z0, y0, x0 = EDGE + (bz - 1) * BLOCK, EDGE + (by - 1) * BLOCK, EDGE + (bx - 1) * BLOCK
                for z in range(z0, min(z0 + BLOCK, held.shape[0] - EDGE)):
                    for y in range(y0, min(y0 + BLOCK, held.shape[1] - EDGE)):
                        for x in range(x0, min(x0 + BLOCK, held.shape[2] - EDGE)):
                            known += held[z, y, x]
                            if flag[z, y, x] != NONE:
                                any_flag = 1
                near = mark[bz, by, bx - 1] + mark[bz, by - 1, bx] + mark[bz - 1, by, bx] + mark[bz, by - 1, bx + 1]
                level = 0 if known == 0 else (1 if known < 4 else (2 if known < 12 else 3))
                mark[bz, by, bx] = code_bit(state, at + (near * 4 + level) * 2 + some, any_flag)
        if state[0][TROUBLE] != 0:
            return


@bare
def _code_cells(state: State, held: U8, flag: U8, mark: U8, at: int, w: int, some: int) -> int:
    """The voxels of marked blocks in raster order."""
    count = 0
    kinds = at + CELL_CONTEXTS
    for z in range(EDGE, held.shape[0] - EDGE):
        for y in range(EDGE, held.shape[1] - EDGE):
            for x in range(EDGE, held.shape[2] - EDGE):
                if mark[1 + (z - EDGE) // BLOCK, 1 + (y - EDGE) // BLOCK, 1 + (x - EDGE) // BLOCK] == 0:
                    continue
                own = held[z, y, x]
                a, b, c = _cell_contexts(held, flag, mark, z, y, x, some)
                is_flag = code_mixed(
                    state, at + a, at + CELL_A + b, at + CELL_A + CELL_B + c, w + some * 4 + own,
                    1 if flag[z, y, x] != NONE else 0,
                )  # fmt: skip
                if is_flag == 0:
                    continue
                count += 1
                if own == 0:
                    flag[z, y, x] = PUT
                    continue
                gone = (flag[z, y, x - 1] == GONE) + (flag[z, y - 1, x] == GONE) + (flag[z - 1, y, x] == GONE)
                other = (
                    (flag[z, y, x - 1] == REPLACED) + (flag[z, y - 1, x] == REPLACED) + (flag[z - 1, y, x] == REPLACED)
                )
                is_gone = code_bit(state, kinds + gone * 4 + other, 1 if flag[z, y, x] == GONE else 0)
                flag[z, y, x] = GONE if is_gone == 1 else REPLACED
        if state[0][TROUBLE] != 0:
            return count
    return count


@bare
def _cell_contexts(held: U8, flag: U8, mark: U8, z: int, y: int, x: int, some: int) -> tuple[int, int, int]:
    """Three contexts of a voxel: flags that are known already, what is held around it, how many of both."""
    a = b = 0
    near = 0
    if some == 0:
        a = _pattern(flag, z, y, x)
        b = _far_pattern(flag, z, y, x)
    else:
        a = (flag[z, y, x - 1] << 4) | (flag[z, y - 1, x] << 2) | flag[z - 1, y, x]
        a = 1024 + (
            (a << 3) | ((flag[z, y - 1, x + 1] != NONE) << 2) | ((flag[z - 1, y, x + 1] != NONE) << 1) | held[z, y, x]
        )
        b = 256 | (_held_pattern(held, z, y, x) << 2) | (held[z, y, x] << 1)
        b |= flag[z, y, x - 1] != NONE or flag[z, y - 1, x] != NONE or flag[z - 1, y, x] != NONE
    for dz in range(-1, 1):
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                if dz < 0 or dy < 0 or (dy == 0 and dx < 0):
                    near += flag[z + dz, y + dy, x + dx] != NONE
    up = 0
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            up += held[z + 1, y + dy, x + dx] + held[z, y + dy, x + dx]
    blocks = (
        mark[1 + (z - EDGE) // BLOCK, 1 + (y - EDGE) // BLOCK, 1 + (x - EDGE + 1) // BLOCK]
        + 2 * mark[1 + (z - EDGE + 1) // BLOCK, 1 + (y - EDGE) // BLOCK, 1 + (x - EDGE) // BLOCK]
    )
    c = ((min(near, 7) * 4 + (0 if up == 0 else (1 if up < 4 else (2 if up < 9 else 3)))) << 3) | (blocks << 1) | some
    return a, b, c


@bare
def _pattern(flag: U8, z: int, y: int, x: int) -> int:
    """Ten neighbours that come before: one bit each."""
    found: int = (
        (flag[z, y, x - 1] != NONE)
        | (flag[z, y - 1, x] != NONE) << 1
        | (flag[z - 1, y, x] != NONE) << 2
        | (flag[z, y - 1, x - 1] != NONE) << 3
        | (flag[z, y - 1, x + 1] != NONE) << 4
        | (flag[z - 1, y, x - 1] != NONE) << 5
        | (flag[z - 1, y, x + 1] != NONE) << 6
        | (flag[z - 1, y - 1, x] != NONE) << 7
        | (flag[z - 1, y + 1, x] != NONE) << 8
        | (flag[z, y, x - 2] != NONE) << 9
    )
    return found


@bare
def _far_pattern(flag: U8, z: int, y: int, x: int) -> int:
    """Six neighbours in line, two deep, and two across the floor below."""
    found: int = (
        (flag[z, y, x - 1] != NONE)
        | (flag[z, y - 1, x] != NONE) << 1
        | (flag[z - 1, y, x] != NONE) << 2
        | (flag[z, y, x - 2] != NONE) << 3
        | (flag[z, y - 2, x] != NONE) << 4
        | (flag[z - 2, y, x] != NONE) << 5
        | (flag[z - 1, y + 1, x + 1] != NONE) << 6
        | (flag[z - 1, y - 1, x - 1] != NONE) << 7
    )
    return found


@bare
def _held_pattern(held: U8, z: int, y: int, x: int) -> int:
    """The six neighbours across faces: one bit each."""
    found: int = (
        held[z, y, x - 1]
        | held[z, y, x + 1] << 1
        | held[z, y - 1, x] << 2
        | held[z, y + 1, x] << 3
        | held[z - 1, y, x] << 4
        | held[z + 1, y, x] << 5
    )
    return found


# Gaussians: columns of a table of int32, one row a voxel.
Z: Final = 0
Y: Final = 1
X: Final = 2
AXIS: Final = 3
LEVEL: Final = 4  # a, b, c
SLOPE: Final = 7  # ba, ca, cb
STEP: Final = 10  # a, b, c
COUNT: Final = 13
SELF: Final = 14  # row that this one replaces, or -1
TILT: Final = 15  # of the surface along a and b, 2^-16: follows from the others, found once for all that ask
COLUMNS: Final = 17

# Families of contexts of each number, three each.
_FAMILIES: Final = (
    (12, 24, 18),  # level c
    (16, 36, 16),  # level a
    (16, 36, 16),  # level b
    (12, 24, 24),  # count
    (15, 16, 16),  # shear
    (24, 24, 36),  # slope cb
    (24, 24, 36),  # slope ca
    (36, 16, 18),  # step a
    (36, 16, 18),  # step b
    (24, 24, 48),  # step c
)


def _starts() -> I64:
    sizes = [n * WIDTH for family in _FAMILIES for n in family]
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)


_START: Final = _starts()
AXIS_CONTEXTS: Final = 2 * (16 + 64 + 12)
NUMBER_CONTEXTS: Final = int(_START[-1])
VOXEL_CONTEXTS: Final = AXIS_CONTEXTS + NUMBER_CONTEXTS
VOXEL_WEIGHTS: Final = 2 + WIDTH * len(_FAMILIES)

MOST_REFS: Final = 4
_BITS: Final = 16


@bare
def code_voxels(
    state: State, table: I32, first: int, where: I32, sd: I64, shape: I64, pitch: I64, at: int, w: int, refs: I64
) -> None:
    """The Gaussians of the rows `first` … of a table, in order, each from its neighbours that are known already.

    Args:
        state: coder and contexts.
        table: (N, COLUMNS); row 0 holds typical values; rows before `first` are known to both sides, of the others
            Z, Y, X and SELF are.
        first: first row to code.
        where: (nz, ny, nx) row of each voxel known so far, -1 elsewhere, -2 where one will come; padded.
        sd: standard deviations of the lattice.
        shape: plane_step, slope_bits, shear_bits, thin_bits, plane_bits, length_bits, mean_bits of the lattice, and
            1 where there is a base, else 0.
        pitch: (3,) size of a voxel along x, y, z, 2^-mean_bits m.
        at: first context.
        w: first mixing weights.
        refs: (MOST_REFS,) int64, room to work in.
    """
    for row in range(1, first):
        _keep_tilts(table, row, sd, shape)
    for row in range(first, len(table)):
        _code_voxel(state, table, row, where, sd, shape, pitch, at, w, refs)
        where[table[row, Z], table[row, Y], table[row, X]] = row
        if state[0][TROUBLE] != 0:
            return


def _around() -> I64:
    """(26, 3) steps to the neighbours across faces, then edges, then corners."""
    steps = [(z, y, x) for z in (-1, 0, 1) for y in (-1, 0, 1) for x in (-1, 0, 1) if (z, y, x) != (0, 0, 0)]
    return np.array(sorted(steps, key=lambda step: sum(map(abs, step))), np.int64)


_AROUND: Final = _around()
_ANY_AXIS: Final = -1


@bare
def _neighbours(table: I32, row: int, where: I32, axis: int, most: int, refs: I64) -> int:
    """Rows of up to `most` known neighbours of one thin axis (or any), the replaced one first; how many."""
    n = 0
    own = table[row, SELF]
    if own >= 0 and (axis == _ANY_AXIS or table[own, AXIS] == axis):
        refs[0] = own
        n = 1
    z, y, x = table[row, Z], table[row, Y], table[row, X]
    for i in range(26):
        other = where[z + _AROUND[i, 0], y + _AROUND[i, 1], x + _AROUND[i, 2]]
        if other >= 0 and (axis == _ANY_AXIS or table[other, AXIS] == axis):
            refs[n] = other
            n += 1
            if n >= most:
                break
    return n


@bare
def _occupied(where: I32, z: int, y: int, x: int) -> int:
    """The six neighbours across faces that hold, or will hold, a Gaussian: one bit each."""
    found: int = (
        (where[z, y, x - 1] != -1)
        | (where[z, y, x + 1] != -1) << 1
        | (where[z, y - 1, x] != -1) << 2
        | (where[z, y + 1, x] != -1) << 3
        | (where[z - 1, y, x] != -1) << 4
        | (where[z + 1, y, x] != -1) << 5
    )
    return found


@bare
def _bucket(value: int) -> int:
    """0, 1, 2-3, 4-7, 8-15, more: 0 … 5."""
    size = abs(value)
    k = 0
    while size > 0 and k < 5:
        size >>= 1
        k += 1
    return k


@bare
def _ratio(numerator: int, denominator: int) -> int:
    """Nearest integer of a quotient, denominator > 0."""
    return (2 * numerator + denominator) // (2 * denominator)


@bare
def _clip(value: int, low: int, high: int) -> int:
    return min(max(value, low), high)


@bare
def _code_axis(
    state: State, table: I32, row: int, where: I32, refs: I64, occupied: int, kind: int, at: int, w: int
) -> int:
    """The axis along which the Gaussian is thinnest."""
    n = _neighbours(table, row, where, _ANY_AXIS, 2, refs)
    first = table[refs[0], AXIS] if n > 0 else 3
    second = table[refs[1], AXIS] if n > 1 else 3
    own = table[table[row, SELF], AXIS] if kind == 2 else 3
    a, b, c = at + 2 * (first * 4 + second), at + 32 + 2 * occupied, at + 160 + 2 * (kind * 4 + own)
    axis = table[row, AXIS]
    if code_mixed(state, a, b, c, w, 1 if axis == 2 else 0) == 1:
        return 2
    return code_mixed(state, a + 1, b + 1, c + 1, w + 1, 1 if axis == 1 else 0)


@bare_inlined
def _number(state: State, which: int, a: int, b: int, c: int, at: int, w: int, value: int) -> int:
    """A number of family `which` in its contexts a, b, c."""
    at += AXIS_CONTEXTS
    return code_signed(
        state,
        at + _START[3 * which] + a * WIDTH,
        at + _START[3 * which + 1] + b * WIDTH,
        at + _START[3 * which + 2] + c * WIDTH,
        w + 2 + which * WIDTH,
        value,
    )


@bare
def _code_voxel(
    state: State, table: I32, row: int, where: I32, sd: I64, shape: I64, pitch: I64, at: int, w: int, refs: I64
) -> None:
    plane_step, slope_bits, shear_bits = shape[0], shape[1], shape[2]
    thin_bits, plane_bits, length_bits, mean_bits = shape[3], shape[4], shape[5], shape[6]
    up, fine = length_bits - 20, mean_bits - length_bits
    occupied = _occupied(where, table[row, Z], table[row, Y], table[row, X])
    kind = 2 if table[row, SELF] >= 0 else shape[7]
    axis = _code_axis(state, table, row, where, refs, occupied, kind, at, w)
    table[row, AXIS] = axis
    n = _neighbours(table, row, where, axis, MOST_REFS, refs)
    top = len(sd) - 1
    first = refs[0] if n > 0 else 0  # row 0 stands for nothing: typical values
    mean_c = mean_count = 0
    low_c, high_c = 99, 0
    for i in range(n):
        mean_c += table[refs[i], LEVEL + 2]
        mean_count += table[refs[i], COUNT]
        low_c, high_c = min(low_c, table[refs[i], LEVEL + 2]), max(high_c, table[refs[i], LEVEL + 2])
    mean_c = _ratio(mean_c, n) if n > 0 else table[0, LEVEL + 2]
    mean_count = _ratio(mean_count, n) if n > 0 else table[0, COUNT]
    known = min(n, 3) * 3 + kind
    spread = min(high_c - low_c, 5) if n > 1 else 0

    level_c = mean_c + _number(
        state, 0, known, _clip(mean_c // 2, 0, 23), spread * 3 + axis, at, w, table[row, LEVEL + 2] - mean_c
    )
    level_c = table[row, LEVEL + 2] = _clip(level_c, 0, top)
    along_a, along_b = (0 if axis != 0 else 1), (2 if axis != 2 else 1)
    around_a, around_b = occupied >> (2 * along_a) & 3, occupied >> (2 * along_b) & 3
    level_a = _code_level(
        state, table, row, 0, 1, first, kind, around_a, axis, min(level_c // 2, 15), plane_step, top, at, w
    )
    level_b = _code_level(
        state, table, row, 1, 2, first, kind, around_b, axis, min(level_a, 15), plane_step, top, at, w
    )
    count = mean_count + _number(
        state, 3, known, _clip(mean_count, 0, 23), min(level_a + level_b, 23), at, w, table[row, COUNT] - mean_count
    )
    table[row, COUNT] = count = _clip(count, 0, 30)

    near_shear = _bucket(table[first, SLOPE]) if n > 0 else 0
    s_ba = _number(
        state, 4, min(near_shear, 4) * 3 + kind, min(level_a, 15), min(level_b, 15), at, w, table[row, SLOPE]
    )
    table[row, SLOPE] = s_ba
    D1, D2, D3 = sd[level_a * plane_step] << up, sd[level_b * plane_step] << up, sd[level_c] << up
    L21 = s_ba * D2 >> shear_bits

    # The neighbours' tilt, c = tilt_a · a + tilt_b · b, on average.
    tilt_a = tilt_b = 0
    low_a = low_b = 1 << 40
    high_a = high_b = -(1 << 40)
    for i in range(n):
        ta, tb = int(table[refs[i], TILT]), int(table[refs[i], TILT + 1])
        tilt_a, tilt_b = tilt_a + ta, tilt_b + tb
        low_a, high_a, low_b, high_b = min(low_a, ta), max(high_a, ta), min(low_b, tb), max(high_b, tb)
    if n > 0:
        tilt_a, tilt_b = _ratio(tilt_a, n), _ratio(tilt_b, n)
    doubt_a = _bucket(_ratio((high_a - low_a) * D1 >> _BITS << slope_bits, D3)) if n > 1 else 0
    doubt_b = _bucket(_ratio((high_b - low_b) * D2 >> _BITS << slope_bits, D3)) if n > 1 else 0
    thin = _clip(level_c, 0, 23)
    want = _clip(_ratio((tilt_b * D2 >> _BITS) << slope_bits, D3), -2000, 2000)
    odd_b = _number(
        state, 5, min(n, 3) * 6 + doubt_b, thin, (kind * 3 + axis) * 4 + min(_bucket(s_ba), 3), at, w,
        table[row, SLOPE + 2] - want,
    )  # fmt: skip
    s_cb = table[row, SLOPE + 2] = want + odd_b
    want = _clip(_ratio((tilt_a * D1 + tilt_b * L21 >> _BITS) << slope_bits, D3), -2000, 2000)
    odd_a = _number(
        state, 6, min(n, 3) * 6 + doubt_a, thin, (kind * 3 + axis) * 4 + min(_bucket(odd_b), 3), at, w,
        table[row, SLOPE + 1] - want,
    )  # fmt: skip
    s_ca = table[row, SLOPE + 1] = want + odd_a

    own = kind == 2 and n > 0 and first == table[row, SELF]
    want_a = table[first, STEP] if own else 0
    want_b = table[first, STEP + 1] if own else 0
    turn_a = _clip(table[first, STEP], -1, 1) + 1 if n > 0 else 0
    turn_b = _clip(table[first, STEP + 1], -1, 1) + 1 if n > 0 else 0
    m_a = want_a + _number(
        state, 7, (around_a * 3 + kind) * 3 + axis, min(level_a, 15), turn_a * 6 + min(_bucket(s_ba), 5), at, w,
        table[row, STEP] - want_a,
    )  # fmt: skip
    table[row, STEP] = m_a
    m_b = want_b + _number(
        state, 8, (around_b * 3 + kind) * 3 + axis, min(level_b, 15), turn_b * 6 + min(_bucket(m_a), 5), at, w,
        table[row, STEP + 1] - want_b,
    )  # fmt: skip
    table[row, STEP + 1] = m_b

    # Where the neighbours' planes pass this voxel's mean.
    L31, L32 = s_ca * D3 >> slope_bits, s_cb * D3 >> slope_bits
    ya, yb = m_a << (fine - plane_bits), m_b << (fine - plane_bits)
    mu_a, mu_b = D1 * ya, L21 * ya + D2 * yb
    height = 0
    low, high = 1 << 60, -(1 << 60)
    for i in range(n):
        h = _height(table, row, refs[i], sd, shape, pitch, axis, mu_a, mu_b)
        height += h
        low, high = min(low, h), max(high, h)
    quantum = D3 << (fine - thin_bits)
    want = 0
    if n > 0:
        want = _clip(_ratio(_ratio(height, n) - (L31 * ya + L32 * yb), quantum), -4000, 4000)
    doubt = _bucket(_ratio(high - low, quantum)) if n > 1 else 0
    surprise = min(_bucket(odd_a), 3) * 4 + min(_bucket(odd_b), 3)
    m_c = want + _number(state, 9, min(n, 3) * 6 + doubt, thin, surprise * 3 + kind, at, w, table[row, STEP + 2] - want)
    table[row, STEP + 2] = m_c
    _keep_tilts(table, row, sd, shape)


@bare
def _code_level(
    state: State, table: I32, row: int, which: int, family: int, first: int, kind: int, around: int, axis: int,
    other: int, plane_step: int, top: int, at: int, w: int,
) -> int:  # fmt: skip
    """A standard deviation along the surface."""
    want = table[first, LEVEL + which]
    found = want + _number(
        state, family, min(want, 15), (around * 3 + axis) * 3 + kind, other, at, w, table[row, LEVEL + which] - want
    )
    found = _clip(found, 0, top // plane_step)
    table[row, LEVEL + which] = found
    return found


@bare
def _keep_tilts(table: I32, row: int, sd: I64, shape: I64) -> None:
    """Tilt of a known voxel's surface along a and b, 2^-16, at most 4 either way."""
    plane_step, slope_bits, shear_bits, up = shape[0], shape[1], shape[2], shape[5] - 20
    D1, D2 = sd[table[row, LEVEL] * plane_step] << up, sd[table[row, LEVEL + 1] * plane_step] << up
    D3 = sd[table[row, LEVEL + 2]] << up
    L21 = table[row, SLOPE] * D2 >> shear_bits
    L31, L32 = table[row, SLOPE + 1] * D3 >> slope_bits, table[row, SLOPE + 2] * D3 >> slope_bits
    tilt_b = _clip((L32 << _BITS) // D2, -(4 << _BITS), 4 << _BITS)
    table[row, TILT] = _clip(((L31 << _BITS) - tilt_b * L21) // D1, -(4 << _BITS), 4 << _BITS)
    table[row, TILT + 1] = tilt_b


@bare
def _height(table: I32, row: int, other: int, sd: I64, shape: I64, pitch: I64, axis: int, mu_a: int, mu_b: int) -> int:
    """Height along the thin axis at which another voxel's plane passes (mu_a, mu_b) of this one, 2^-mean_bits m."""
    plane_step, slope_bits, shear_bits = shape[0], shape[1], shape[2]
    thin_bits, plane_bits, up, fine = shape[3], shape[4], shape[5] - 20, shape[6] - shape[5]
    D1, D2 = sd[table[other, LEVEL] * plane_step] << up, sd[table[other, LEVEL + 1] * plane_step] << up
    D3 = sd[table[other, LEVEL + 2]] << up
    L21 = table[other, SLOPE] * D2 >> shear_bits
    L31, L32 = table[other, SLOPE + 1] * D3 >> slope_bits, table[other, SLOPE + 2] * D3 >> slope_bits
    ya, yb = table[other, STEP] << (fine - plane_bits), table[other, STEP + 1] << (fine - plane_bits)
    yc = table[other, STEP + 2] << (fine - thin_bits)
    step_x = (table[other, X] - table[row, X]) * pitch[0]
    step_y = (table[other, Y] - table[row, Y]) * pitch[1]
    step_z = (table[other, Z] - table[row, Z]) * pitch[2]
    to_a = step_y if axis == 0 else step_x
    to_b = step_y if axis == 2 else step_z
    to_c = step_x if axis == 0 else (step_y if axis == 1 else step_z)
    tilt_a, tilt_b = int(table[other, TILT]), int(table[other, TILT + 1])
    off_a = mu_a - (D1 * ya + to_a)
    off_b = mu_b - (L21 * ya + D2 * yb + to_b)
    height: int = L31 * ya + L32 * yb + D3 * yc + to_c + (tilt_a * off_a + tilt_b * off_b >> _BITS)
    return height
