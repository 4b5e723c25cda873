"""The whitened quantiser: Gaussians on a lattice of integers (after GND 4.1, whose floats it replaces on the wire).

Per voxel the axis along which the Gaussian is thinnest goes last, and Sigma = L L^T (Cholesky) of the permuted axes
(a, b, c) is written as

    L_ii = sd[k_i], a frozen table of integers; L_ba = s_ba · slope · L_bb, L_ca = s_ca · slope · L_cc, L_cb likewise;
    mean = L (m · step).

So every error is measured in standard deviations of the Gaussian itself: a wall 1 cm thick keeps its place to
millimetres, along the wall a few centimetres do not matter. Regression slopes (the plane's tilt) are kept when the
standard deviations are rounded.

Everything from integers to float32 is exact integer arithmetic and one correctly rounded conversion, so it gives the
same bits on every machine. `snap` moves Gaussians onto the lattice once; what lies on it stays, to the bit.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import lru_cache
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import F32, F64, I32, I64, check_array
from gnd.gnd_map.by_object import ByObject
from gnd.gnd_map.codec import lattice_kernels as k
from gnd.gnd_map.errors import CodecError, ShapeError
from gnd.gnd_map.gaussian import MAX_MEAN_M, Gaussians, concat

UNIT_BITS: Final = 20
"""Standard deviations are integers of 2^-20 m."""
LEVELS: Final = 48
MAX_SD_M: Final = 4
MAX_LENGTH_M: Final = 16
"""Of an entry of L: products of such entries fit 64 bits."""
MAX_SLOPE: Final = 4095
MAX_STEP: Final = 8191
CELLS: Final = 20
"""On the lattice `cells` says only "at least": a voxel holds a Gaussian from so many sub-cells on."""
_FEW: Final = (1, 2, 5, 10)
COUNTS: Final = (*_FEW, *(CELLS << j for j in range(27)))
"""Numbers of points on a lattice: one an octave,"""
ROUGH_COUNTS: Final = (*_FEW, *(CELLS << j for j in range(0, 27, 3)))
"""or one in three."""
MAP_COUNTS: Final = (*_FEW, *(CELLS << j for j in range(0, 27, 2)))
"""Those of a new *standard* map, one in two: with one in three, NDT on cells of 2 m feels the rounding."""

AXES: Final = np.array([[1, 2, 0], [0, 2, 1], [0, 1, 2]])
"""Axes (a, b, c) by the axis c along which the Gaussian is thinnest."""
_SIX: Final = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


@dataclass(frozen=True, slots=True)
class Lattice:
    """How finely Gaussians are rounded.

    Attributes:
        name: on the command line.
        code: its number on the wire, never reused.
        sd: (LEVELS,) int64 standard deviations, 2^-20 m, increasing.
        plane_step: levels of the standard deviations a and b, along the surface, are multiples of this.
        slope_bits: L_ca and L_cb are multiples of L_cc · 2^-slope_bits.
        shear_bits: L_ba is a multiple of L_bb · 2^-shear_bits.
        thin_bits: the whitened mean's last component is a multiple of 2^-thin_bits.
        plane_bits: its other two are multiples of 2^-plane_bits.
        counts: numbers of points, increasing.
        map_counts: those of `counts` to which the Gaussians of a new map are rounded; none given: all.
    """

    name: str
    code: int
    sd: tuple[int, ...]
    plane_step: int
    slope_bits: int
    shear_bits: int
    thin_bits: int
    plane_bits: int
    counts: tuple[int, ...] = COUNTS
    map_counts: tuple[int, ...] = ()

    @property
    def length_bits(self) -> int:
        """L is held in integers of 2^-length_bits m."""
        return UNIT_BITS + max(self.slope_bits, self.shear_bits)

    @property
    def mean_bits(self) -> int:
        """Means are held in integers of 2^-mean_bits m."""
        return self.length_bits + max(self.thin_bits, self.plane_bits)


def _levels(first_m: float, ratio: float) -> tuple[int, ...]:
    """Frozen by `tests/gnd_map/test_codec_golden.py`: another machine's `pow` must not move them."""
    return tuple(min(round(first_m * ratio**k * 2**UNIT_BITS), MAX_SD_M << UNIT_BITS) for k in range(LEVELS))


ARCHIVE: Final = Lattice("archive", 0, _levels(0.002, 1.15), 1, 3, 3, 3, 4)
STANDARD: Final = Lattice("standard", 1, _levels(0.004, 1.2), 2, 2, 1, 2, 3, map_counts=MAP_COUNTS)
COMPACT: Final = Lattice("compact", 2, _levels(0.004, 1.3), 2, 1, 0, 1, 2, ROUGH_COUNTS)
REPORT: Final = Lattice("report", 3, _levels(0.004, 1.3), 2, 1, 0, 1, 1)
"""For what one vehicle measured, which the merger averages: half of a standard deviation does."""
LATTICES: Final[Mapping[str, Lattice]] = MappingProxyType({x.name: x for x in (ARCHIVE, STANDARD, COMPACT)})
"""Of maps."""


def lattice_with(code: int) -> Lattice:
    """The lattice of this number on the wire; `CodecError` when there is none."""
    for lattice in LATTICES.values():
        if lattice.code == code:
            return lattice
    raise CodecError(f"lattice {code} is unknown; known: {', '.join(str(x.code) for x in LATTICES.values())}")


@dataclass(frozen=True, slots=True, eq=False)
class Quantised:
    """N Gaussians of one tile as integers, sorted by voxel id; all columns int32 but the ids' own."""

    voxel_id: I32
    """(N,) strictly increasing."""
    axis: I32
    """(N,) 0, 1, 2: the axis along which the Gaussian is thinnest."""
    level: I32
    """(N, 3) levels of the standard deviations a, b (in units of plane_step) and c."""
    slope: I32
    """(N, 3) s_ba, s_ca, s_cb."""
    step: I32
    """(N, 3) whitened mean, components a, b, c."""
    count: I32
    """(N,) index into the lattice's counts."""

    def __post_init__(self) -> None:
        n = len(self.voxel_id)
        for name in ("voxel_id", "axis", "count"):
            check_array(name, getattr(self, name), np.int32, (n,))
        for name in ("level", "slope", "step"):
            check_array(name, getattr(self, name), np.int32, (n, 3))

    def __len__(self) -> int:
        return len(self.voxel_id)

    def take(self, index: npt.ArrayLike) -> "Quantised":
        """The rows at `index`: increasing positions or a mask (N,)."""
        return Quantised(*(np.ascontiguousarray(getattr(self, f.name)[index]) for f in fields(self)))

    def check(self, lattice: Lattice) -> None:
        """`CodecError` when a column leaves its range."""
        _refuse("axis", self.axis, 0, 2)
        _refuse("level a, b", self.level[:, :2], 0, (LEVELS - 1) // lattice.plane_step)
        _refuse("level c", self.level[:, 2], 0, LEVELS - 1)
        _refuse("slope", self.slope, -MAX_SLOPE, MAX_SLOPE)
        _refuse("step", self.step, -MAX_STEP, MAX_STEP)
        _refuse("count", self.count, 0, len(lattice.counts) - 1)


def _refuse(name: str, column: I32, low: int, high: int) -> None:
    if column.size and (column.min() < low or column.max() > high):
        raise CodecError(f"{name} {column.min()} .. {column.max()} is outside {low} .. {high}")


def dequantise(quantised: Quantised, lattice: Lattice) -> Gaussians:
    """The Gaussians that the integers stand for, the same bits on every machine.

    Raises:
        CodecError: a column leaves its range, or the values are no Gaussians (means beyond 2 m ...).
    """
    quantised.check(lattice)
    rows, (n, counts, _) = len(quantised), _numbers(lattice)
    mean_m, cov_m2 = np.empty((rows, 3), np.float32), np.empty((rows, 6), np.float32)
    _, axis, level, slope, step, number = (np.ascontiguousarray(getattr(quantised, f.name)) for f in fields(quantised))
    long = int(k.floats_of(axis, level, slope, step, *_tables(lattice)[2:], n, mean_m, cov_m2))
    if long:
        raise CodecError(f"lattice {lattice.name}: {long} of {len(quantised)} Gaussians reach {MAX_LENGTH_M} m")
    count = counts[number].astype(np.int32)
    try:
        return Gaussians(quantised.voxel_id, count, np.minimum(count, CELLS).astype(np.int32), mean_m, cov_m2)
    except ShapeError as error:
        raise CodecError(f"lattice {lattice.name}: {error}") from error


def _floats(quantised: Quantised, lattice: Lattice) -> tuple[F32, F32]:
    """Means (N, 3) and covariances (N, 6) as float32."""
    L = _lengths(quantised.level, quantised.slope, lattice)
    means, covariances = _means(L, quantised.step, lattice), _covariances(L)
    axes, row = AXES[quantised.axis], np.arange(len(quantised))
    mean_m, cov_m2 = np.zeros((len(row), 3), np.float32), np.zeros((len(row), 6), np.float32)
    for i in range(3):
        mean_m[row, axes[:, i]] = (means[i] * 2.0**-lattice.mean_bits).astype(np.float32)
        for j in range(i + 1):
            values = (covariances[i][j] * 2.0 ** (-2 * lattice.length_bits)).astype(np.float32)
            cov_m2[row, _SIX[axes[:, i], axes[:, j]]] = values
    return mean_m, cov_m2


def snap(gaussians: Gaussians, lattice: Lattice, *, new_map: bool = False) -> Gaussians:
    """The Gaussians moved onto the lattice; what lies on it, and "nothing here" (count 0), stays to the bit.

    Args:
        gaussians: of one tile.
        lattice: where to.
        new_map: of a map that is built: numbers of points become coarser, which nothing that reads a map feels. What is
            merged into a map keeps the finer ones: a merge must give the same bits whenever it is computed anew.
    """
    there = gaussians.exists
    if not there.any():
        return gaussians
    some = gaussians if there.all() else gaussians.take(there)
    off = np.flatnonzero(~_found(some, lattice)[1])
    if len(off) == 0:
        return gaussians
    integers = _readable(some.take(off), lattice)
    if new_map and lattice.map_counts:
        integers.count[:] = _coarser(some.count[off], lattice)
    moved = dequantise(integers, lattice)
    kept = np.delete(np.arange(len(gaussians)), np.flatnonzero(there)[off])
    return concat([gaussians.take(kept), moved])


def _readable(gaussians: Gaussians, lattice: Lattice) -> Quantised:
    """The nearest integers that can be read back from their float32 and are Gaussians: as it is, else rounder and
    finally without tilt (extremes only: lines, points, variances beyond any voxel's, means at the limit).
    """
    found = quantise(gaussians, lattice)
    for simpler in (_rounder, _upright):
        rows = np.flatnonzero(~_can_be_read(found, lattice))
        if len(rows) == 0:
            break
        other = quantise(simpler(gaussians.take(rows)), lattice)
        for field in fields(found):
            getattr(found, field.name)[rows] = getattr(other, field.name)
    return found


def _can_be_read(quantised: Quantised, lattice: Lattice) -> npt.NDArray[np.bool_]:
    """(N,) whether the integers stand for a Gaussian that gives itself back."""
    good = _is_short(quantised, lattice)
    mean_m, _ = _floats(quantised, lattice)
    good &= (np.abs(mean_m) <= MAX_MEAN_M).all(axis=1)
    rows = np.flatnonzero(good)
    good[rows] = _found(dequantise(quantised.take(rows), lattice), lattice)[1]
    return good


def _rounder(gaussians: Gaussians) -> Gaussians:
    """A millimetre more along every axis, means well inside."""
    mean_m = np.clip(gaussians.mean_m, -_INSIDE_M, _INSIDE_M)
    cov_m2 = gaussians.cov_m2.copy()
    cov_m2[:, [0, 3, 5]] += np.float32(1e-6)
    return Gaussians(gaussians.voxel_id, gaussians.count, gaussians.cells, mean_m, cov_m2)


def _upright(gaussians: Gaussians) -> Gaussians:
    """Without tilt, the mean so near the centre that no rounding carries it out of bounds."""
    cov_m2 = gaussians.cov_m2.copy()
    cov_m2[:, [1, 2, 4]] = 0.0
    cov_m2[:, [0, 3, 5]] = np.minimum(cov_m2[:, [0, 3, 5]], 1.0)
    mean_m = np.clip(gaussians.mean_m, -_INSIDE_M, _INSIDE_M)
    return Gaussians(gaussians.voxel_id, gaussians.count, gaussians.cells, mean_m, cov_m2)


_INSIDE_M: Final = 1.0


def is_on(gaussians: Gaussians, lattice: Lattice) -> bool:
    """Whether every Gaussian lies on the lattice (count 0 does not)."""
    if not gaussians.exists.all():
        return False
    if len(gaussians) > _PROBE and not _find(gaussians, lattice, _PROBE)[1].all():  # a few tell most that do not
        return False
    return bool(_found(gaussians, lattice)[1].all())


def integers_of(gaussians: Gaussians, lattice: Lattice) -> Quantised:
    """The integers of Gaussians that lie on the lattice: `dequantise` gives them back to the bit.

    Raises:
        CodecError: some do not lie on it.
    """
    if not gaussians.exists.all():
        raise CodecError(f"{int((~gaussians.exists).sum())} voxels hold no Gaussian: nothing to encode")
    found, on = _found(gaussians, lattice)
    if not on.all():
        first = gaussians.voxel_id[np.flatnonzero(~on)[0]]
        raise CodecError(
            f"{int((~on).sum())} of {len(on)} Gaussians do not lie on the lattice {lattice.name}, first voxel {first}"
        )
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Integers:
    """The integers of all Gaussians of a tile, of which any part can be taken.

    Attributes:
        found: those that give a Gaussian back to the bit, where it lies on the lattice.
        is_on: (N,) where that is.
        rounded: the nearest ones; the same object where all lie on it.
    """

    found: Quantised
    is_on: npt.NDArray[np.bool_]
    rounded: Quantised

    @classmethod
    def of(cls, gaussians: Gaussians, lattice: Lattice) -> "Integers":
        """Find them."""
        found, on = _found(gaussians, lattice)
        is_on = np.asarray(on & gaussians.exists)
        return cls(found, is_on, found if is_on.all() else quantise(gaussians, lattice))

    def nearest(self, kept: npt.NDArray[np.bool_]) -> Quantised:
        """Of some of the Gaussians, (N,) bool, the integers that both sides of a message use: those that give them
        back to the bit where all of these lie on the lattice, else the nearest ones. They depend on no other Gaussian.
        """
        return (self.found if self.is_on[kept].all() else self.rounded).take(kept)


def quantise(gaussians: Gaussians, lattice: Lattice) -> Quantised:
    """The nearest integers, tilt of the surface first; every count > 0."""
    cov = gaussians.full_cov()
    axis = _thin_axis(cov)
    S = _permuted(cov, axis)
    L11 = np.sqrt(np.maximum(S[0][0], _TINY))
    L21 = S[1][0] / L11
    L22 = np.sqrt(np.maximum(S[1][1] - L21**2, _TINY))
    L31 = S[2][0] / L11
    L32 = (S[2][1] - L31 * L21) / L22
    L33 = np.sqrt(np.maximum(S[2][2] - L31**2 - L32**2, _TINY))
    level = np.stack([_level(L11, lattice, True), _level(L22, lattice, True), _level(L33, lattice, False)], axis=1)
    D = [_length(level, i, lattice) for i in range(3)]
    # The regression of c on a and b is the surface's tilt: it is kept, whatever became of the standard deviations.
    tilt_b = L32 / L22
    tilt_a = (L31 - tilt_b * L21) / L11
    s_ba = _rounded(L21 / L11 * D[0] / D[1] * 2**lattice.shear_bits, MAX_SLOPE)
    L21q = s_ba * D[1] / 2**lattice.shear_bits
    s_ca = _rounded((tilt_a * D[0] + tilt_b * L21q) / D[2] * 2**lattice.slope_bits, MAX_SLOPE)
    s_cb = _rounded(tilt_b * D[1] / D[2] * 2**lattice.slope_bits, MAX_SLOPE)
    slope = np.stack([s_ba, s_ca, s_cb], axis=1).astype(np.int32)
    return _with_means(gaussians, axis, level, slope, lattice)


_TINY: Final = 1e-12


def _thin_axis(cov: F64) -> I32:
    """(N,) axis of the largest diagonal entry of Sigma^-1: thinnest given the other two."""
    cofactors = [
        cov[:, (i + 1) % 3, (i + 1) % 3] * cov[:, (i + 2) % 3, (i + 2) % 3] - cov[:, (i + 1) % 3, (i + 2) % 3] ** 2
        for i in range(3)
    ]
    return np.asarray(np.argmax(np.stack(cofactors, axis=1), axis=1), np.int32)


def _permuted(cov: F64, axis: I32) -> list[list[F64]]:
    """Lower triangle of Sigma in the order (a, b, c)."""
    row, axes = np.arange(len(axis)), AXES[axis]
    return [[cov[row, axes[:, i], axes[:, j]] for j in range(i + 1)] for i in range(3)]


@lru_cache(maxsize=16)
def _tables(lattice: Lattice) -> tuple[F64, F64, I64, I64]:
    """Between which standard deviations, m, levels change, and those of the levels, 2^-length_bits m: along the surface
    and across it.
    """
    across = np.array(lattice.sd, np.int64)
    along = across[:: lattice.plane_step]
    change = (np.sqrt(t[1:] * t[:-1]) for t in (along * 2.0**-UNIT_BITS, across * 2.0**-UNIT_BITS))
    shift = lattice.length_bits - UNIT_BITS
    return (*change, along << shift, across << shift)  # type: ignore[return-value]


def _level(sd_m: F64, lattice: Lattice, is_plane: bool) -> I32:
    return np.searchsorted(_tables(lattice)[0 if is_plane else 1], sd_m).astype(np.int32)


def _length(level: I32, which: int, lattice: Lattice) -> F64:
    """L_aa, L_bb or L_cc in metres."""
    return np.asarray(_units(level, which, lattice) * 2.0**-lattice.length_bits)


def _units(level: I32, which: int, lattice: Lattice) -> I64:
    """The same in integers of 2^-length_bits m."""
    return np.asarray(_tables(lattice)[3 if which == 2 else 2][level[:, which]])


def _rounded(values: F64, limit: int) -> F64:
    return np.clip(np.rint(values), -limit, limit)


_Lower = tuple[I64, I64, I64, I64, I64, I64]  # L_aa, L_ba, L_bb, L_ca, L_cb, L_cc


def _lengths(level: I32, slope: I32, lattice: Lattice) -> _Lower:
    """L in integers of 2^-length_bits m."""
    a, b, c = (_units(level, i, lattice) for i in range(3))
    s = slope.astype(np.int64)
    return (
        a,
        s[:, 0] * b >> lattice.shear_bits,
        b,
        s[:, 1] * c >> lattice.slope_bits,
        s[:, 2] * c >> lattice.slope_bits,
        c,
    )


def _is_short(quantised: Quantised, lattice: Lattice) -> npt.NDArray[np.bool_]:
    """(N,) whether no entry of L is longer than MAX_LENGTH_M."""
    longest = MAX_LENGTH_M << lattice.length_bits
    lower = np.stack(_lengths(quantised.level, quantised.slope, lattice))
    return np.asarray((np.abs(lower) <= longest).all(axis=0))


def _means(L: _Lower, step: I32, lattice: Lattice) -> tuple[I64, I64, I64]:
    """L (m · step) in integers of 2^-mean_bits m."""
    bits = lattice.mean_bits - lattice.length_bits
    a, b = (step[:, i].astype(np.int64) << (bits - lattice.plane_bits) for i in (0, 1))
    c = step[:, 2].astype(np.int64) << (bits - lattice.thin_bits)
    return L[0] * a, L[1] * a + L[2] * b, L[3] * a + L[4] * b + L[5] * c


def _covariances(L: _Lower) -> tuple[tuple[I64, ...], ...]:
    """Lower triangle of L L^T in integers of 2^-(2 · length_bits) m²."""
    aa, ba, bb, ca, cb, cc = L
    return ((aa * aa,), (ba * aa, ba * ba + bb * bb), (ca * aa, ca * ba + cb * bb, ca * ca + cb * cb + cc * cc))


def _with_means(gaussians: Gaussians, axis: I32, level: I32, slope: I32, lattice: Lattice) -> Quantised:
    """Round the mean one whitened component after the other, each correcting for what the ones before lost."""
    lower = [column * 2.0**-lattice.length_bits for column in _lengths(level, slope, lattice)]
    row, axes = np.arange(len(axis)), AXES[axis]
    mu = [gaussians.mean_m[row, axes[:, i]].astype(np.float64) for i in range(3)]
    plane, thin = 2.0**-lattice.plane_bits, 2.0**-lattice.thin_bits
    a = _rounded(mu[0] / lower[0] / plane, MAX_STEP)
    b = _rounded((mu[1] - lower[1] * a * plane) / lower[2] / plane, MAX_STEP)
    c = _rounded((mu[2] - (lower[3] * a + lower[4] * b) * plane) / lower[5] / thin, MAX_STEP)
    step = np.stack([a, b, c], axis=1).astype(np.int32)
    return Quantised(gaussians.voxel_id, axis, level, slope, step, _count_index(gaussians.count, lattice))


def _count_index(count: I32, lattice: Lattice) -> I32:
    """Nearest number of points on the lattice; what suffices for a Gaussian (20) still does."""
    return np.searchsorted(_between(lattice.counts), count).astype(np.int32)


def _coarser(count: I32, lattice: Lattice) -> I32:
    """Of the nearest number of points of a new map."""
    kept = np.array(lattice.map_counts)[np.searchsorted(_between(lattice.map_counts), count)]
    return np.searchsorted(lattice.counts, kept).astype(np.int32)


def _between(numbers: tuple[int, ...]) -> F64:
    """Where the nearest number of points changes."""
    counts = np.array(numbers, np.float64)
    between = np.sqrt(counts[1:] * counts[:-1])
    between[counts[1:] == CELLS] = CELLS - 0.5
    return np.asarray(between)


@lru_cache(maxsize=16)
def _numbers(lattice: Lattice) -> tuple[I64, I64, F64]:
    """What the kernels know of a lattice, its numbers of points, and where they change."""
    n = np.zeros(k.NUMBERS, np.int64)
    n[k.PLANE_STEP], n[k.SLOPE_BITS], n[k.SHEAR_BITS] = lattice.plane_step, lattice.slope_bits, lattice.shear_bits
    n[k.THIN_BITS], n[k.PLANE_BITS] = lattice.thin_bits, lattice.plane_bits
    n[k.LENGTH_BITS], n[k.MEAN_BITS] = lattice.length_bits, lattice.mean_bits
    n[k.CELLS_AT], n[k.LONGEST] = CELLS, MAX_LENGTH_M << lattice.length_bits
    return n, np.array(lattice.counts, np.int64), _between(lattice.counts)


_PROBE: Final = 8
_FOUND: Final[ByObject[tuple[Quantised, npt.NDArray[np.bool_]]]] = ByObject(128)
"""Of the Gaussians used last: a tile is snapped, encoded and compared, each time as the same object."""


def _found(gaussians: Gaussians, lattice: Lattice) -> tuple[Quantised, npt.NDArray[np.bool_]]:
    """Integers of each Gaussian, and whether they give it back to the bit: each thin axis is tried."""
    return _FOUND.of(gaussians, lambda: _find(gaussians, lattice, len(gaussians)), lattice.code)


def _find(gaussians: Gaussians, lattice: Lattice, rows: int) -> tuple[Quantised, npt.NDArray[np.bool_]]:
    """The same of the first `rows` of them."""
    axis, number, on = np.zeros(rows, np.int32), np.zeros(rows, np.int32), np.zeros(rows, np.int64)
    level, slope, step = (np.zeros((rows, 3), np.int32) for _ in range(3))
    n, counts, between = _numbers(lattice)
    room = np.zeros((1, 3), np.float32), np.zeros((1, 6), np.float32)
    count, cells = np.ascontiguousarray(gaussians.count[:rows]), np.ascontiguousarray(gaussians.cells[:rows])
    mean_m, cov_m2 = np.ascontiguousarray(gaussians.mean_m[:rows]), np.ascontiguousarray(gaussians.cov_m2[:rows])
    k.find_integers(
        count, cells, mean_m, cov_m2, counts, between, *_tables(lattice), n, axis, level, slope, step, number, on, *room
    )
    return Quantised(gaussians.voxel_id[:rows], axis, level, slope, step, number), on.astype(np.bool_)


def _found_plain(gaussians: Gaussians, lattice: Lattice) -> tuple[Quantised, npt.NDArray[np.bool_]]:
    """`_found` in plain numpy: the kernel's twin."""
    cov = gaussians.full_cov()
    likely = _thin_axis(cov)
    found = _read_off(gaussians, cov, likely, lattice)
    on = _gives_back(found, gaussians, lattice)
    for turn in (1, 2):
        rows = np.flatnonzero(~on)
        if len(rows) == 0:
            break
        some = gaussians.take(rows)
        other = _read_off(some, cov[rows], ((likely[rows] + turn) % 3).astype(np.int32), lattice)
        right = _gives_back(other, some, lattice)
        for field in fields(found):
            getattr(found, field.name)[rows[right]] = getattr(other, field.name)[right]
        on[rows] = right
    return found, on


def _read_off(gaussians: Gaussians, cov: F64, axis: I32, lattice: Lattice) -> Quantised:
    """The integers, taken that the Gaussians lie on the lattice with these thin axes.

    Unlike `quantise` it divides by the lattice's own standard deviations, so that only the rounding to float32 errs.
    """
    S = _permuted(cov, axis)
    level = np.zeros((len(axis), 3), np.int32)
    level[:, 0] = _level(np.sqrt(np.maximum(S[0][0], _TINY)), lattice, True)
    D1 = _length(level, 0, lattice)
    L21 = S[1][0] / D1
    level[:, 1] = _level(np.sqrt(np.maximum(S[1][1] - L21**2, _TINY)), lattice, True)
    D2 = _length(level, 1, lattice)
    s_ba = _rounded(L21 / D2 * 2**lattice.shear_bits, MAX_SLOPE)
    L21 = s_ba * D2 / 2**lattice.shear_bits
    L31 = S[2][0] / D1
    L32 = (S[2][1] - L31 * L21) / D2
    level[:, 2] = _level(np.sqrt(np.maximum(S[2][2] - L31**2 - L32**2, _TINY)), lattice, False)
    D3 = _length(level, 2, lattice)
    s_ca, s_cb = (_rounded(x / D3 * 2**lattice.slope_bits, MAX_SLOPE) for x in (L31, L32))
    slope = np.stack([s_ba, s_ca, s_cb], axis=1).astype(np.int32)
    return _with_means(gaussians, axis, level, slope, lattice)


def _gives_back(quantised: Quantised, gaussians: Gaussians, lattice: Lattice) -> npt.NDArray[np.bool_]:
    """(N,) whether `dequantise` gives the same bits."""
    mean_m, cov_m2 = _floats(quantised, lattice)
    count = np.array(lattice.counts, np.int64)[quantised.count]
    same = (count == gaussians.count) & (np.minimum(count, CELLS) == gaussians.cells)
    same &= _is_short(quantised, lattice)
    same &= (mean_m == gaussians.mean_m).all(axis=1) & (cov_m2 == gaussians.cov_m2).all(axis=1)
    return np.asarray(same)
