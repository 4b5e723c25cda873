"""The Gaussians of a tile's voxels, each coded in the context of its neighbours that are known already.

A Gaussian is a row of integers on a lattice: the axis c along which it is thinnest, and over the axes a and b of its
surface the factor of its covariance, Σ = L Lᵀ with L = [[D1, 0, 0], [L21, D2, 0], [L31, L32, D3]] in the order a, b, c;
D by a level (a standard deviation of the lattice), the others by a slope each; its mean by steps along the columns of
L. Integers only, as in `kernels`: what is coded is the difference from what the neighbours let expect.
"""

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

MOST_REFS: Final = 4
_BITS: Final = 16
"""Of a tilt's fraction."""
_NO_AXIS: Final = 3


class VoxelCoding(NamedTuple):
    """What the voxels of one box are coded with.

    Attributes:
        state: coder and contexts.
        at: first context.
        w: first mixing weights.
        table: (N, COLUMNS); row 0 holds typical values, the rows before the first that is coded are known to both
            sides, of the others Z, Y, X and SELF are.
        where: (nz, ny, nx) row of each voxel known so far, -1 elsewhere, -2 where one will come; padded.
        refs: (MOST_REFS,) int64, room for the rows of neighbours.
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
    refs: I64
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


@bare
def code_voxels(m: VoxelCoding, first: int) -> None:
    """The Gaussians of the rows `first` … of the table, in order."""
    table = m.table
    for row in range(1, first):
        _keep_tilts(m, row)
    for row in range(first, len(table)):
        _code_voxel(m, row)
        m.where[table[row, Z], table[row, Y], table[row, X]] = row
        if m.state[0][TROUBLE] != 0:
            return


@bare_inlined
def _code_voxel(m: VoxelCoding, row: int) -> None:
    """One Gaussian: its thin axis, sizes, slopes and mean."""
    table = m.table
    occupied = _occupied(m.where, table[row, Z], table[row, Y], table[row, X])
    kind = 2 if table[row, SELF] >= 0 else m.has_base
    axis = table[row, AXIS] = _code_axis(m, row, occupied, kind)
    n = _neighbours(m, row, axis, MOST_REFS)
    first = m.refs[0] if n > 0 else 0
    along_a, along_b = (0 if axis != 0 else 1), (2 if axis != 2 else 1)
    v = _Voxel(
        row, kind, axis, n, first, occupied >> (2 * along_a) & 3, occupied >> (2 * along_b) & 3,
        occupied >> (2 * axis) & 3, occupied, m.refs[1] if n > 1 else first,
    )  # fmt: skip
    _code_sizes(m, v)
    odd_a, odd_b = _code_slopes(m, v)
    _code_mean(m, v, min(_bucket(odd_a), 3) * 4 + min(_bucket(odd_b), 3))
    _keep_tilts(m, row)


@bare_inlined
def _code_axis(m: VoxelCoding, row: int, occupied: int, kind: int) -> int:
    """The axis along which the Gaussian is thinnest."""
    table, refs = m.table, m.refs
    m.state[0][FIELD] = 1
    n = _neighbours(m, row, _ANY_AXIS, 2)
    first = table[refs[0], AXIS] if n > 0 else _NO_AXIS
    second = table[refs[1], AXIS] if n > 1 else _NO_AXIS
    own = table[table[row, SELF], AXIS] if kind == 2 else _NO_AXIS
    a, b, c = m.at + 2 * (first * 4 + second), m.at + 32 + 2 * occupied, m.at + 160 + 2 * (kind * 4 + own)
    axis = table[row, AXIS]
    if code_mixed(m.state, a, b, c, m.w, 1 if axis == 2 else 0) == 1:
        return 2
    return code_mixed(m.state, a + 1, b + 1, c + 1, m.w + 1, 1 if axis == 1 else 0)


@bare_inlined
def _code_sizes(m: VoxelCoding, v: _Voxel) -> None:
    """The three levels and the count: of c and the count against the neighbours' mean, of a and b against the first."""
    table, row, top = m.table, v.row, len(m.sd) - 1
    mean_c = mean_count = 0
    low_c, high_c = 99, 0
    for i in range(v.n):
        level, count = table[m.refs[i], LEVEL + 2], table[m.refs[i], COUNT]
        mean_c, mean_count = mean_c + level, mean_count + count
        low_c, high_c = min(low_c, level), max(high_c, level)
    mean_c = _ratio(mean_c, v.n) if v.n > 0 else table[0, LEVEL + 2]
    mean_count = _ratio(mean_count, v.n) if v.n > 0 else table[0, COUNT]
    known = min(v.n, 3) * 3 + v.kind
    spread = min(high_c - low_c, 5) if v.n > 1 else 0

    one, two = table[v.first, LEVEL + 2] - mean_c, table[v.second, LEVEL + 2] - mean_c
    d, e = _two_neighbours(v, one, two), v.occupied * 2 + (v.n > 0)
    odd_c = _number(
        m, v, _LEVEL_C, known, _clip(mean_c // 2, 0, 23), spread * 3 + v.axis, d, e, table[row, LEVEL + 2] - mean_c
    )
    level_c = table[row, LEVEL + 2] = _clip(mean_c + odd_c, 0, top)
    level_a = _code_level(m, v, 0, _LEVEL_A, v.around_a, min(level_c // 2, 15))
    level_b = _code_level(m, v, 1, _LEVEL_B, v.around_b, min(level_a, 15))
    one, two = table[v.first, COUNT] - mean_count, table[v.second, COUNT] - mean_count
    d, e = _two_neighbours(v, one, two), v.occupied * 2 + (v.n > 0)
    odd_count = _number(
        m, v, _COUNT, known, _clip(mean_count, 0, 23), min(level_a + level_b, 23), d, e, table[row, COUNT] - mean_count
    )
    table[row, COUNT] = _clip(mean_count + odd_count, 0, 30)


@bare_inlined
def _code_level(m: VoxelCoding, v: _Voxel, which: int, family: int, around: int, other: int) -> int:
    """A standard deviation along the surface."""
    want = m.table[v.first, LEVEL + which]
    contexts = min(want, 15), (around * 3 + v.axis) * 3 + v.kind, other
    odd_b = _clip(m.table[v.row, LEVEL] - m.table[v.first, LEVEL], -2, 2) + 2 if which == 1 else 2
    second = _clip(m.table[v.second, LEVEL + which] - want, -2, 2) + 2
    d = ((odd_b * 2 + (v.n > 0)) * 4 + around) * 5 + second
    odd = _number(
        m, v, family, contexts[0], contexts[1], contexts[2], d, v.occupied, m.table[v.row, LEVEL + which] - want
    )
    found = _clip(want + odd, 0, (len(m.sd) - 1) // m.plane_step)
    m.table[v.row, LEVEL + which] = found
    return found


@bare_inlined
def _code_slopes(m: VoxelCoding, v: _Voxel) -> tuple[int, int]:
    """The shear, and the slopes of c against those of a surface with the neighbours' mean tilt,
    c = tilt_a a + tilt_b b; by how much they differ from it.
    """
    table, row = m.table, v.row
    level_a, level_b, level_c = table[row, LEVEL], table[row, LEVEL + 1], table[row, LEVEL + 2]
    near_shear = _bucket(table[v.first, SLOPE]) if v.n > 0 else 0
    d = (_clip(table[v.first, SLOPE], -2, 2) + 2) * 5 + _clip(table[v.second, SLOPE], -2, 2) + 2 if v.n > 0 else 12
    s_ba = table[row, SLOPE] = _number(
        m, v, _SHEAR, min(near_shear, 4) * 3 + v.kind, min(level_a, 15), min(level_b, 15), d, v.occupied,
        table[row, SLOPE],
    )  # fmt: skip
    D1, D2, D3 = _diagonal(m, row)
    L21 = s_ba * D2 >> m.shear_bits

    tilt_a = tilt_b = 0
    low_a = low_b = 1 << 40
    high_a = high_b = -(1 << 40)
    for i in range(v.n):
        ta, tb = int(table[m.refs[i], TILT]), int(table[m.refs[i], TILT + 1])
        tilt_a, tilt_b = tilt_a + ta, tilt_b + tb
        low_a, high_a, low_b, high_b = min(low_a, ta), max(high_a, ta), min(low_b, tb), max(high_b, tb)
    if v.n > 0:
        tilt_a, tilt_b = _ratio(tilt_a, v.n), _ratio(tilt_b, v.n)
    doubt_a = _bucket(_ratio((high_a - low_a) * D1 >> _BITS << m.slope_bits, D3)) if v.n > 1 else 0
    doubt_b = _bucket(_ratio((high_b - low_b) * D2 >> _BITS << m.slope_bits, D3)) if v.n > 1 else 0

    near, thin, turned = min(v.n, 3) * 6, _clip(level_c, 0, 23), (v.kind * 3 + v.axis) * 4
    want = _clip(_ratio((tilt_b * D2 >> _BITS) << m.slope_bits, D3), -2000, 2000)
    first = _clip(_ratio((int(table[v.first, TILT + 1]) * D2 >> _BITS) << m.slope_bits, D3), -2000, 2000) - want
    d, e = (_clip(first, -6, 6) + 6) * 9 + v.around_b * 2 + (v.n > 1), _sloped(v, want) * 4 + v.around_c
    odd_b = _number(
        m, v, _SLOPE_CB, near + doubt_b, thin, turned + min(_bucket(s_ba), 3), d, e, table[row, SLOPE + 2] - want
    )
    table[row, SLOPE + 2] = want + odd_b
    want = _clip(_ratio((tilt_a * D1 + tilt_b * L21 >> _BITS) << m.slope_bits, D3), -2000, 2000)
    first = _clip(_ratio((int(table[v.first, TILT]) * D1 >> _BITS) << m.slope_bits, D3), -2000, 2000) - want
    d, e = (_clip(first, -6, 6) + 6) * 9 + v.around_a * 2 + (v.n > 1), _sloped(v, want) * 4 + v.around_c
    odd_a = _number(
        m, v, _SLOPE_CA, near + doubt_a, thin, turned + min(_bucket(odd_b), 3), d, e, table[row, SLOPE + 1] - want
    )
    table[row, SLOPE + 1] = want + odd_a
    return odd_a, odd_b


@bare_inlined
def _code_mean(m: VoxelCoding, v: _Voxel, surprise: int) -> None:
    """The steps of the mean: of a and b against the Gaussian that is replaced, of c against the height at which the
    neighbours' planes pass there. `surprise` is by how much the slopes differed from what was expected, 0 … 15.
    """
    table, row = m.table, v.row
    own = v.kind == 2 and v.n > 0 and v.first == table[row, SELF]
    want_a, want_b = (table[v.first, STEP], table[v.first, STEP + 1]) if own else (0, 0)
    turn_a = _clip(table[v.first, STEP], -1, 1) + 1 if v.n > 0 else 0
    turn_b = _clip(table[v.first, STEP + 1], -1, 1) + 1 if v.n > 0 else 0
    context_a, context_b = (v.around_a * 3 + v.kind) * 3 + v.axis, (v.around_b * 3 + v.kind) * 3 + v.axis
    near_a = turn_a * 6 + min(_bucket(table[row, SLOPE]), 5)
    e = (_clip(table[v.first, STEP], -6, 6) + 6) * 4 + v.around_a if v.n > 0 else 24 + v.around_a
    odd_a = _number(
        m, v, _STEP_A, context_a, min(table[row, LEVEL], 15), near_a, v.occupied, e, table[row, STEP] - want_a
    )
    m_a = table[row, STEP] = want_a + odd_a
    near_b = turn_b * 6 + min(_bucket(m_a), 5)
    e = (_clip(table[v.first, STEP + 1], -6, 6) + 6) * 4 + v.around_b if v.n > 0 else 24 + v.around_b
    odd_b = _number(
        m, v, _STEP_B, context_b, min(table[row, LEVEL + 1], 15), near_b, v.occupied, e, table[row, STEP + 1] - want_b
    )
    m_b = table[row, STEP + 1] = want_b + odd_b

    D1, D2, D3 = _diagonal(m, row)
    L21, L31, L32 = _below_diagonal(m, row, D2, D3)
    fine = m.mean_bits - m.length_bits
    ya, yb, quantum = m_a << (fine - m.plane_bits), m_b << (fine - m.plane_bits), D3 << (fine - m.thin_bits)
    mu_a, mu_b = D1 * ya, L21 * ya + D2 * yb
    height = nearest = smooth = 0
    low, high = 1 << 60, -(1 << 60)
    own_tilt_b = _clip((L32 << _BITS) // D2, -(4 << _BITS), 4 << _BITS)
    own_tilt_a = _clip(((L31 << _BITS) - own_tilt_b * L21) // D1, -(4 << _BITS), 4 << _BITS)
    for i in range(v.n):
        h, s = _height(m, v, m.refs[i], mu_a, mu_b, own_tilt_a, own_tilt_b)
        height, smooth = height + h, smooth + s
        if i == 0:
            nearest = h
        low, high = min(low, h), max(high, h)
    want = 0
    if v.n > 0:
        want = _clip(_ratio(_ratio(height, v.n) - (L31 * ya + L32 * yb), quantum), -4000, 4000)
    doubt = _bucket(_ratio(high - low, quantum)) if v.n > 1 else 0
    thin = _clip(table[row, LEVEL + 2], 0, 23)
    d = (_clip(_ratio(_ratio(smooth, max(v.n, 1)) - _ratio(height, max(v.n, 1)), quantum), -6, 6) + 6) * 12
    d += min(doubt, 3) * 3 + min(_bucket(_ratio(nearest - _ratio(height, max(v.n, 1)), quantum)), 2)
    e = (_inside(m, v, want * quantum + (L31 * ya + L32 * yb)) * 4 + v.around_c) * 9 + min(thin // 2, 8)
    odd_c = _number(
        m, v, _STEP_C, min(v.n, 3) * 6 + doubt, thin, surprise * 3 + v.kind, d, e, table[row, STEP + 2] - want
    )
    table[row, STEP + 2] = want + odd_c


@bare_inlined
def _number(m: VoxelCoding, v: _Voxel, family: int, a: int, b: int, c: int, d: int, e: int, value: int) -> int:
    """A number of a family in its contexts a, b, c, or in all five."""
    at = m.at + AXIS_CONTEXTS
    m.state[0][FIELD] = family + 2
    if m.five == 1:
        more = m.at + VOXEL_CONTEXTS
        five = (
            at + _START[3 * family] + a * WIDTH,
            at + _START[3 * family + 1] + b * WIDTH,
            at + _START[3 * family + 2] + c * WIDTH,
            more + _MORE_START[2 * family] + d * WIDTH,
            more + _MORE_START[2 * family + 1] + e * WIDTH,
        )
        return code_signed_5(m.state, five, m.w + 2 + (min(v.n, 2) * 10 + family) * WIDTH, value)
    return code_signed(
        m.state,
        at + _START[3 * family] + a * WIDTH,
        at + _START[3 * family + 1] + b * WIDTH,
        at + _START[3 * family + 2] + c * WIDTH,
        m.w + 2 + family * WIDTH,
        value,
    )


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
def _keep_tilts(m: VoxelCoding, row: int) -> None:
    """Tilt of a known voxel's surface along a and b, 2^-16, at most 4 either way."""
    D1, D2, D3 = _diagonal(m, row)
    L21, L31, L32 = _below_diagonal(m, row, D2, D3)
    tilt_b = _clip((L32 << _BITS) // D2, -(4 << _BITS), 4 << _BITS)
    m.table[row, TILT] = _clip(((L31 << _BITS) - tilt_b * L21) // D1, -(4 << _BITS), 4 << _BITS)
    m.table[row, TILT + 1] = tilt_b


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


def _around() -> I64:
    """(26, 3) steps to the neighbours across faces, then edges, then corners."""
    steps = [(z, y, x) for z in (-1, 0, 1) for y in (-1, 0, 1) for x in (-1, 0, 1) if (z, y, x) != (0, 0, 0)]
    return np.array(sorted(steps, key=lambda step: sum(map(abs, step))), np.int64)


_AROUND: Final = _around()
_ANY_AXIS: Final = -1


@bare
def _neighbours(m: VoxelCoding, row: int, axis: int, most: int) -> int:
    """Rows of up to `most` known neighbours of one thin axis (or any) in `refs`, the replaced one first; how many."""
    table, where, refs = m.table, m.where, m.refs
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
