"""The Gaussians of a tile's voxels, each coded in the context of its neighbours that are known already.

A Gaussian is a row of integers on a lattice: the axis c along which it is thinnest, and over the axes a and b of its
surface the factor of its covariance, Σ = L Lᵀ with L = [[D1, 0, 0], [L21, D2, 0], [L31, L32, D3]] in the order a, b, c;
D by a level (a standard deviation of the lattice), the others by a slope each; its mean by steps along the columns of
L. Integers only, as in `kernels`: what is coded is the difference from what the neighbours let expect.
"""

from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np

from gnd.gnd_map.arrays import I32, I64
from gnd.gnd_map.codec.kernels import FIELD, TROUBLE, WIDTH, code_mixed, code_signed, code_signed_5
from gnd.gnd_map.jit import bare, bare_inlined

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

# The numbers of a Gaussian, each a family of contexts.
_LEVEL_C, _LEVEL_A, _LEVEL_B, _COUNT, _SHEAR, _SLOPE_CB, _SLOPE_CA, _STEP_A, _STEP_B, _STEP_C = range(10)
_FAMILIES: Final = (
    (12, 24, 18),  # level c: three contexts of so many values each
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


_MORE: Final = (
    (175, 128),  # level c: what two neighbours say; the six across faces
    (200, 64),  # level a: the second neighbour, who is beside it, how odd level a was; the six
    (200, 64),  # level b
    (175, 128),  # count: as level c
    (25, 64),  # shear: that of two neighbours; the six
    (117, 108),  # slope cb: what the nearest alone says; how steep it is expected to be
    (117, 108),  # slope ca
    (64, 52),  # step a: the six; that of the nearest
    (64, 52),  # step b
    (156, 324),  # step c: an evenly changing tilt, doubt, the nearest; where in the voxel it is expected
)
"""Two contexts more of each, in the codecs that mix five."""


def _starts(families: tuple[tuple[int, ...], ...]) -> I64:
    sizes = [n * WIDTH for family in families for n in family]
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)


_START: Final = _starts(_FAMILIES)
_MORE_START: Final = _starts(_MORE)
AXIS_CONTEXTS: Final = 2 * (16 + 64 + 12)
NUMBER_CONTEXTS: Final = int(_START[-1])
VOXEL_CONTEXTS: Final = AXIS_CONTEXTS + NUMBER_CONTEXTS
VOXEL_WEIGHTS: Final = 2 + WIDTH * len(_FAMILIES)
MORE_VOXEL_CONTEXTS: Final = int(_MORE_START[-1])
MORE_VOXEL_WEIGHTS: Final = 3 * WIDTH * len(_FAMILIES)

# By family: the column that it fills.
_COLUMN: Final = np.array(
    [LEVEL + 2, LEVEL, LEVEL + 1, COUNT, SLOPE, SLOPE + 2, SLOPE + 1, STEP, STEP + 1, STEP + 2], np.int64
)
NUMBERS: Final = len(_FAMILIES)
TOPS: Final = _COUNT + 1
"""Families whose numbers go from 0 to a largest one: the first of them."""

MOST_REFS: Final = 4
_BITS: Final = 16
"""Of a tilt's fraction."""
_NO_AXIS: Final = 3

# Slots of `memo` (int64): what the numbers of one voxel tell those after them.
_ODD: Final = 0  # by family: by how much the number differed from what was expected
_TILT_A: Final = NUMBERS  # the neighbours' mean
_TILT_B: Final = NUMBERS + 1
_DOUBT_A: Final = NUMBERS + 2
MEMO: Final = NUMBERS + 3

NEIGHBOURS: Final = 26
_Expected = tuple[int, int, int, int, int, int]  # five contexts of a number, and what it is expected to be


class VoxelCoding(NamedTuple):
    """What the voxels of one box are coded with.

    Attributes:
        state: coder and contexts.
        at: first context.
        w: first mixing weights.
        table: (N, COLUMNS); row 0 holds typical values, the rows before the first that is coded are known to both
            sides, of the others Z, Y, X and SELF are.
        where: (nz · ny · nx,) row of each voxel known so far, -1 elsewhere, -2 where one will come; padded.
        floor_step: from a voxel to the one above it in `where`.
        line_step: to the next one along y.
        around: (K,) int64 the same to the neighbours that can be known: across faces, then edges, then corners.
        known: (1 + NEIGHBOURS,) int64, room for the rows of neighbours,
        refs: (MOST_REFS + 1,) int64, and of those of the same thin axis.
        memo: (MEMO,) int64, room for what is remembered of a voxel.
        tops: (TOPS,) int64 largest level c, a, b and count.
        sd: standard deviations of the lattice, 2^-20 m.
        pitch: (3,) size of a voxel along x, y, z, 2^-mean_bits m.
        plane_step: a level along the surface is so many of `sd`.
        slope_bits: fraction of the slopes of c.
        shear_bits: fraction of the slope of b over a.
        thin_bits: fraction of a step along c.
        plane_bits: fraction of a step along a or b.
        length_bits: fraction of D, m.
        mean_bits: fraction of heights and of the mean, m.
        has_base: 1 where both sides hold Gaussians of the tile, else 0.
        five: 1 where numbers are coded in five contexts, 0 where in three.
    """

    state: Any
    at: int
    w: int
    table: I32
    where: I32
    floor_step: int
    line_step: int
    around: I64
    known: I64
    refs: I64
    memo: I64
    tops: I64
    sd: I64
    pitch: I64
    plane_step: int
    slope_bits: int
    shear_bits: int
    thin_bits: int
    plane_bits: int
    length_bits: int
    mean_bits: int
    has_base: int
    five: int


class _Voxel(NamedTuple):
    """The voxel that is coded, and what is known around it.

    Attributes:
        row: its row.
        kind: 2 where it replaces a Gaussian, else `has_base`.
        axis: along which it is thinnest: c.
        n: known neighbours of the same axis; their rows are in `refs`.
        first: row of the first of them; 0, the typical values, where there is none.
        around_a: which of the two neighbours along a hold a Gaussian, or will, two bits.
        around_b: likewise along b.
        around_c: likewise along c.
        occupied: all six of them.
        second: row of the second known neighbour of the same axis; that of the first where there is one, else 0.
    """

    row: int
    kind: int
    axis: int
    n: int
    first: int
    around_a: int
    around_b: int
    around_c: int
    occupied: int
    second: int


@lru_cache(maxsize=256)
def neighbours(floor_step: int, line_step: int, *, only_before: bool) -> I64:
    """(K,) steps in `where` to the neighbours of a voxel: across faces, then edges, then corners; or to those before it
    in order: where both sides hold nothing, no other can be known.
    """
    steps = [(z, y, x) for z in (-1, 0, 1) for y in (-1, 0, 1) for x in (-1, 0, 1) if (z, y, x) != (0, 0, 0)]
    steps = sorted(steps, key=lambda step: sum(map(abs, step)))
    kept = [step for step in steps if step < (0, 0, 0) or not only_before]
    return np.array([z * floor_step + y * line_step + x for z, y, x in kept], np.int64)


@bare
def code_voxels(m: VoxelCoding, first: int) -> None:
    """The Gaussians of the rows `first` … of the table, in order.

    The ten numbers of a voxel are coded in a loop, not one after the other: so there is one place where a number is
    coded, and all of it fits the processor's cache of instructions.
    """
    table = m.table
    for row in range(1, first):
        _keep_tilts(m, row)
    for row in range(first, len(table)):
        place = table[row, Z] * m.floor_step + table[row, Y] * m.line_step + table[row, X]
        v = _code_axis(m, row, place)
        for family in range(NUMBERS):
            _code_number(m, v, family)
        m.where[np.uint64(place)] = row
        if m.state[0][TROUBLE] != 0:
            return


@bare_inlined
def _code_axis(m: VoxelCoding, row: int, place: int) -> _Voxel:
    """The axis along which the Gaussian is thinnest, and what is known around it."""
    table, known = m.table, m.known
    m.state[0][FIELD] = 1
    own_row, occupied = table[row, SELF], _occupied(m, place)
    n = _known_around(m, place, own_row)
    first = table[known[0], AXIS] if n > 0 else _NO_AXIS
    second = table[known[1], AXIS] if n > 1 else _NO_AXIS
    kind = 2 if own_row >= 0 else m.has_base
    own = table[own_row, AXIS] if kind == 2 else _NO_AXIS
    at = m.at + 2 * (first * 4 + second), m.at + 32 + 2 * occupied, m.at + 160 + 2 * (kind * 4 + own)
    axis = _axis_in(m, at, table[row, AXIS])
    table[row, AXIS] = axis
    return _voxel_at(m, row, kind, axis, n, occupied)


@bare_inlined
def _voxel_at(m: VoxelCoding, row: int, kind: int, axis: int, n: int, occupied: int) -> _Voxel:
    """What is known around a voxel of this axis; rows of `n` neighbours lie in `known`."""
    table, known, refs = m.table, m.known, m.refs
    same = 0
    for i in range(n):
        refs[same] = known[i]
        same += 1 if table[known[i], AXIS] == axis else 0
        if same == MOST_REFS:
            break
    one = refs[0] if same > 0 else 0
    along_a, along_b = (0 if axis != 0 else 1), (2 if axis != 2 else 1)
    return _Voxel(
        row, kind, axis, same, one, occupied >> (2 * along_a) & 3, occupied >> (2 * along_b) & 3,
        occupied >> (2 * axis) & 3, occupied, refs[1] if same > 1 else one,
    )  # fmt: skip


@bare_inlined
def _axis_in(m: VoxelCoding, at: tuple[int, int, int], axis: int) -> int:
    """Write or read the axis."""
    a, b, c = at
    if code_mixed(m.state, a, b, c, m.w, 1 if axis == 2 else 0) == 1:
        return 2
    return code_mixed(m.state, a + 1, b + 1, c + 1, m.w + 1, 1 if axis == 1 else 0)


@bare_inlined
def _known_around(m: VoxelCoding, place: int, own_row: int) -> int:
    """Rows of the known neighbours in `known`, the replaced one first; how many."""
    known, n = m.known, 0
    if own_row >= 0:
        known[0] = own_row
        n = 1
    for i in range(len(m.around)):
        other = m.where[np.uint64(place + m.around[i])]
        known[np.uint64(n)] = other
        n += 1 if other >= 0 else 0
    return n


@bare_inlined
def _occupied(m: VoxelCoding, place: int) -> int:
    """The six neighbours across faces that hold, or will hold, a Gaussian: one bit each."""
    where, line, floor = m.where, m.line_step, m.floor_step
    found: int = (
        (where[np.uint64(place - 1)] != -1)
        | (where[np.uint64(place + 1)] != -1) << 1
        | (where[np.uint64(place - line)] != -1) << 2
        | (where[np.uint64(place + line)] != -1) << 3
        | (where[np.uint64(place - floor)] != -1) << 4
        | (where[np.uint64(place + floor)] != -1) << 5
    )
    return found


@bare_inlined
def _code_number(m: VoxelCoding, v: _Voxel, family: int) -> None:
    """A number of a family: how far it is from what is expected, in its first three contexts or in all five."""
    a, b, c, d, e, want = _expected(m, v, family)
    m.state[0][FIELD] = family + 2
    column, at = _COLUMN[family], m.at + AXIS_CONTEXTS
    value = m.table[v.row, column] - want
    at_a, at_b = at + _START[3 * family] + a * WIDTH, at + _START[3 * family + 1] + b * WIDTH
    at_c = at + _START[3 * family + 2] + c * WIDTH
    if m.five == 1:
        more = m.at + VOXEL_CONTEXTS
        at_d, at_e = more + _MORE_START[2 * family] + d * WIDTH, more + _MORE_START[2 * family + 1] + e * WIDTH
        w = m.w + 2 + (min(v.n, 2) * NUMBERS + family) * WIDTH
        odd = code_signed_5(m.state, (at_a, at_b, at_c, at_d, at_e), w, value)
    else:
        odd = code_signed(m.state, (at_a, at_b, at_c), m.w + 2 + family * WIDTH, value)
    m.memo[_ODD + family] = odd
    found = want + odd
    m.table[v.row, column] = _clip(found, 0, m.tops[family]) if family < TOPS else found


@bare_inlined
def _expected(m: VoxelCoding, v: _Voxel, family: int) -> _Expected:
    """The contexts of a number, and what the neighbours and the voxel's numbers so far let expect."""
    level = m.table[v.row, LEVEL + 2] // 2 if family == _LEVEL_A else m.table[v.row, LEVEL]
    if family == _LEVEL_C:
        return _level_c_expected(m, v)
    if family == _LEVEL_A:
        return _level_expected(m, v, 0, v.around_a, min(level, 15))
    if family == _LEVEL_B:
        return _level_expected(m, v, 1, v.around_b, min(level, 15))
    if family == _COUNT:
        return _count_expected(m, v)
    if family == _SHEAR:
        return _shear_expected(m, v)
    if family == _SLOPE_CB:
        return _slope_cb_expected(m, v)
    if family == _SLOPE_CA:
        return _slope_ca_expected(m, v)
    if family == _STEP_A:
        return _step_expected(m, v, 0, v.around_a, m.table[v.row, SLOPE])
    if family == _STEP_B:
        return _step_expected(m, v, 1, v.around_b, m.table[v.row, STEP])
    return _step_c_expected(m, v)


@bare_inlined
def _level_c_expected(m: VoxelCoding, v: _Voxel) -> _Expected:
    """Level c: the neighbours' mean."""
    table, mean = m.table, 0
    low, high = 99, 0
    for i in range(v.n):
        level = table[m.refs[i], LEVEL + 2]
        mean, low, high = mean + level, min(low, level), max(high, level)
    mean = _mean(mean, v.n) if v.n > 0 else table[0, LEVEL + 2]
    spread = min(high - low, 5) if v.n > 1 else 0
    d = _two_neighbours(v, table[v.first, LEVEL + 2] - mean, table[v.second, LEVEL + 2] - mean)
    return (
        min(v.n, 3) * 3 + v.kind, _clip(mean // 2, 0, 23), spread * 3 + v.axis, d, v.occupied * 2 + (v.n > 0), mean
    )  # fmt: skip


@bare_inlined
def _level_expected(m: VoxelCoding, v: _Voxel, which: int, around: int, other: int) -> _Expected:
    """A standard deviation along the surface: that of the first neighbour."""
    table = m.table
    want = table[v.first, LEVEL + which]
    odd_a = _clip(table[v.row, LEVEL] - table[v.first, LEVEL], -2, 2) + 2 if which == 1 else 2
    second = _clip(table[v.second, LEVEL + which] - want, -2, 2) + 2
    d = ((odd_a * 2 + (v.n > 0)) * 4 + around) * 5 + second
    return min(want, 15), (around * 3 + v.axis) * 3 + v.kind, other, d, v.occupied, want


@bare_inlined
def _count_expected(m: VoxelCoding, v: _Voxel) -> _Expected:
    """The count: the neighbours' mean."""
    table, mean = m.table, 0
    for i in range(v.n):
        mean += table[m.refs[i], COUNT]
    mean = _mean(mean, v.n) if v.n > 0 else table[0, COUNT]
    d = _two_neighbours(v, table[v.first, COUNT] - mean, table[v.second, COUNT] - mean)
    wide = min(table[v.row, LEVEL] + table[v.row, LEVEL + 1], 23)
    return min(v.n, 3) * 3 + v.kind, _clip(mean, 0, 23), wide, d, v.occupied * 2 + (v.n > 0), mean


@bare_inlined
def _shear_expected(m: VoxelCoding, v: _Voxel) -> _Expected:
    """The shear: none."""
    table = m.table
    one, two = table[v.first, SLOPE], table[v.second, SLOPE]
    near = min(_bucket(one), 4) if v.n > 0 else 0
    d = (_clip(one, -2, 2) + 2) * 5 + _clip(two, -2, 2) + 2 if v.n > 0 else 12
    return near * 3 + v.kind, min(table[v.row, LEVEL], 15), min(table[v.row, LEVEL + 1], 15), d, v.occupied, 0


@bare_inlined
def _slope_cb_expected(m: VoxelCoding, v: _Voxel) -> _Expected:
    """The slope of c over b: that of a surface with the neighbours' mean tilt, c = tilt_a a + tilt_b b."""
    table, row = m.table, v.row
    D1, D2, D3 = _diagonal(m, row)
    tilt_a = tilt_b = 0
    low_a = low_b = 1 << 40
    high_a = high_b = -(1 << 40)
    for i in range(v.n):
        ta, tb = int(table[m.refs[i], TILT]), int(table[m.refs[i], TILT + 1])
        tilt_a, tilt_b = tilt_a + ta, tilt_b + tb
        low_a, high_a, low_b, high_b = min(low_a, ta), max(high_a, ta), min(low_b, tb), max(high_b, tb)
    if v.n > 0:
        tilt_a, tilt_b = _mean(tilt_a, v.n), _mean(tilt_b, v.n)
    doubt_a = _bucket(_ratio((high_a - low_a) * D1 >> _BITS << m.slope_bits, D3)) if v.n > 1 else 0
    doubt_b = _bucket(_ratio((high_b - low_b) * D2 >> _BITS << m.slope_bits, D3)) if v.n > 1 else 0
    m.memo[_TILT_A], m.memo[_TILT_B], m.memo[_DOUBT_A] = tilt_a, tilt_b, doubt_a
    want = _clip(_ratio((tilt_b * D2 >> _BITS) << m.slope_bits, D3), -2000, 2000)
    return _slope_expected(m, v, want, D2, D3, doubt_b, v.around_b, table[row, SLOPE], TILT + 1)


@bare_inlined
def _slope_ca_expected(m: VoxelCoding, v: _Voxel) -> _Expected:
    """The slope of c over a, likewise."""
    D1, D2, D3 = _diagonal(m, v.row)
    L21 = m.table[v.row, SLOPE] * D2 >> m.shear_bits
    tilt_a, tilt_b = m.memo[_TILT_A], m.memo[_TILT_B]
    want = _clip(_ratio((tilt_a * D1 + tilt_b * L21 >> _BITS) << m.slope_bits, D3), -2000, 2000)
    return _slope_expected(m, v, want, D1, D3, m.memo[_DOUBT_A], v.around_a, m.memo[_ODD + _SLOPE_CB], TILT)


@bare_inlined
def _slope_expected(
    m: VoxelCoding, v: _Voxel, want: int, D: int, D3: int, doubt: int, around: int, before: int, tilt: int
) -> _Expected:
    """The contexts of a slope that is expected to be `want`; `before` is the number before it, `tilt` a column."""
    thin, turned = _clip(m.table[v.row, LEVEL + 2], 0, 23), (v.kind * 3 + v.axis) * 4
    d = e = 0
    if m.five == 1:
        first = _clip(_ratio((int(m.table[v.first, tilt]) * D >> _BITS) << m.slope_bits, D3), -2000, 2000) - want
        d, e = (_clip(first, -6, 6) + 6) * 9 + around * 2 + (v.n > 1), _sloped(v, want) * 4 + v.around_c
    return min(v.n, 3) * 6 + doubt, thin, turned + min(_bucket(before), 3), d, e, want


@bare_inlined
def _step_expected(m: VoxelCoding, v: _Voxel, which: int, around: int, before: int) -> _Expected:
    """A step of the mean along the surface: that of the Gaussian that is replaced; `before` is a number before it."""
    table, row = m.table, v.row
    step = table[v.first, STEP + which]
    want = step if v.kind == 2 and v.n > 0 and v.first == table[row, SELF] else 0
    turn = _clip(step, -1, 1) + 1 if v.n > 0 else 0
    e = (_clip(step, -6, 6) + 6) * 4 + around if v.n > 0 else 24 + around
    return (
        (around * 3 + v.kind) * 3 + v.axis, min(table[row, LEVEL + which], 15), turn * 6 + min(_bucket(before), 5),
        v.occupied, e, want,
    )  # fmt: skip


@bare_inlined
def _step_c_expected(m: VoxelCoding, v: _Voxel) -> _Expected:
    """The mean's step across the surface: the height at which the neighbours' planes pass there."""
    table, row = m.table, v.row
    tilt_a, tilt_b = _keep_tilts(m, row)
    D1, D2, D3 = _diagonal(m, row)
    L21, L31, L32 = _below_diagonal(m, row, D2, D3)
    fine = m.mean_bits - m.length_bits
    ya, yb = table[row, STEP] << (fine - m.plane_bits), table[row, STEP + 1] << (fine - m.plane_bits)
    quantum = D3 << (fine - m.thin_bits)
    mu_a, mu_b, mu_c = D1 * ya, L21 * ya + D2 * yb, L31 * ya + L32 * yb
    height = nearest = smooth = 0
    low, high = 1 << 60, -(1 << 60)
    for i in range(v.n):
        h, s = _height(m, v, m.refs[i], mu_a, mu_b, tilt_a, tilt_b)
        height, smooth = height + h, smooth + s
        if i == 0:
            nearest = h
        low, high = min(low, h), max(high, h)
    mean = _mean(height, v.n) if v.n > 0 else 0
    want = _clip(_ratio(mean - mu_c, quantum), -4000, 4000) if v.n > 0 else 0
    doubt = _bucket(_ratio(high - low, quantum)) if v.n > 1 else 0
    thin = _clip(table[row, LEVEL + 2], 0, 23)
    d = e = 0
    if m.five == 1:
        d = (_clip(_ratio(_mean(smooth, max(v.n, 1)) - mean, quantum), -6, 6) + 6) * 12
        d += min(doubt, 3) * 3 + min(_bucket(_ratio(nearest - mean, quantum)), 2)
        e = (_inside(m, v, want * quantum + mu_c) * 4 + v.around_c) * 9 + min(thin // 2, 8)
    odd_a, odd_b = min(_bucket(m.memo[_ODD + _SLOPE_CA]), 3), min(_bucket(m.memo[_ODD + _SLOPE_CB]), 3)
    return min(v.n, 3) * 6 + doubt, thin, (odd_a * 4 + odd_b) * 3 + v.kind, d, e, want


@bare_inlined
def _diagonal(m: VoxelCoding, row: int) -> tuple[int, int, int]:
    """D1, D2, D3 of a Gaussian, 2^-length_bits m."""
    table, sd, up = m.table, m.sd, m.length_bits - 20
    return (
        sd[table[row, LEVEL] * m.plane_step] << up,
        sd[table[row, LEVEL + 1] * m.plane_step] << up,
        sd[table[row, LEVEL + 2]] << up,
    )


@bare_inlined
def _below_diagonal(m: VoxelCoding, row: int, D2: int, D3: int) -> tuple[int, int, int]:
    """L21, L31, L32 of a Gaussian, 2^-length_bits m."""
    table = m.table
    return (
        table[row, SLOPE] * D2 >> m.shear_bits,
        table[row, SLOPE + 1] * D3 >> m.slope_bits,
        table[row, SLOPE + 2] * D3 >> m.slope_bits,
    )


@bare_inlined
def _keep_tilts(m: VoxelCoding, row: int) -> tuple[int, int]:
    """Tilt of a known voxel's surface along a and b, 2^-16, at most 4 either way."""
    D1, D2, D3 = _diagonal(m, row)
    L21, L31, L32 = _below_diagonal(m, row, D2, D3)
    tilt_b = _clip((L32 << _BITS) // D2, -(4 << _BITS), 4 << _BITS)
    tilt_a = _clip(((L31 << _BITS) - tilt_b * L21) // D1, -(4 << _BITS), 4 << _BITS)
    m.table[row, TILT], m.table[row, TILT + 1] = tilt_a, tilt_b
    return tilt_a, tilt_b


@bare_inlined
def _height(
    m: VoxelCoding, v: _Voxel, other: int, mu_a: int, mu_b: int, own_tilt_a: int, own_tilt_b: int
) -> tuple[int, int]:
    """Height along the thin axis at which another voxel's plane passes (mu_a, mu_b) of this one, 2^-mean_bits m; the
    same of a surface whose tilt changes evenly on its way from there to the own tilt.
    """
    table, row, axis, fine = m.table, v.row, v.axis, m.mean_bits - m.length_bits
    D1, D2, D3 = _diagonal(m, other)
    L21, L31, L32 = _below_diagonal(m, other, D2, D3)
    ya, yb = table[other, STEP] << (fine - m.plane_bits), table[other, STEP + 1] << (fine - m.plane_bits)
    yc = table[other, STEP + 2] << (fine - m.thin_bits)
    step_x = (table[other, X] - table[row, X]) * m.pitch[0]
    step_y = (table[other, Y] - table[row, Y]) * m.pitch[1]
    step_z = (table[other, Z] - table[row, Z]) * m.pitch[2]
    to_a = step_y if axis == 0 else step_x
    to_b = step_y if axis == 2 else step_z
    to_c = step_x if axis == 0 else (step_y if axis == 1 else step_z)
    tilt_a, tilt_b = int(table[other, TILT]), int(table[other, TILT + 1])
    off_a = mu_a - (D1 * ya + to_a)
    off_b = mu_b - (L21 * ya + D2 * yb + to_b)
    flat = L31 * ya + L32 * yb + D3 * yc + to_c
    height: int = flat + (tilt_a * off_a + tilt_b * off_b >> _BITS)
    smooth: int = flat + ((tilt_a + own_tilt_a) * off_a + (tilt_b + own_tilt_b) * off_b >> _BITS + 1)
    return height, smooth


@bare_inlined
def _two_neighbours(v: _Voxel, one: int, two: int) -> int:
    """By how much the first and the second neighbour differ from the mean, and who is above and below: 175 values."""
    return (_clip(one, -3, 3) + 3) * 25 + (_clip(two, -2, 2) + 2) * 5 + v.around_c


@bare_inlined
def _inside(m: VoxelCoding, v: _Voxel, height: int) -> int:
    """Where a height along the thin axis lies in the voxel: 0 below it … 8 above it, 4 in the middle."""
    pitch = int(m.pitch[v.axis])
    return _clip((height * 7 + (pitch * 9 >> 1)) // pitch, 0, 8)


@bare_inlined
def _sloped(v: _Voxel, want: int) -> int:
    """How steep a slope is expected to be, in 27 steps."""
    return _clip(want, -4, 4) + 4 + 9 * (0 if v.n == 0 else (1 if v.n < 3 else 2))


@bare_inlined
def _bucket(value: int) -> int:
    """0, 1, 2-3, 4-7, 8-15, more: 0 … 5. Without a branch, which would be guessed wrong half of the time."""
    size = abs(value)
    return (
        (1 if size > 0 else 0) + (1 if size > 1 else 0) + (1 if size > 3 else 0) + (1 if size > 7 else 0)
        + (1 if size > 15 else 0)
    )  # fmt: skip


@bare_inlined
def _mean(total: int, n: int) -> int:
    """`_ratio` of a sum of 1 to 4 numbers: shifts, and a division by a constant, take a fifth of the time."""
    third = (2 * total + 3) // 6
    return third if n == 3 else (2 * total + n) >> (1 + (n >> 1))


@bare_inlined
def _ratio(numerator: int, denominator: int) -> int:
    """Nearest integer of a quotient, denominator > 0."""
    return (2 * numerator + denominator) // (2 * denominator)


@bare_inlined
def _clip(value: int, low: int, high: int) -> int:
    return min(max(value, low), high)
