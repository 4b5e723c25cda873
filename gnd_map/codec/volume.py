"""Voxels of a tile as arrays around them, as the kernels take them."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import I32, I64
from gnd.gnd_map.by_object import ByObject
from gnd.gnd_map.codec import kernels as k
from gnd.gnd_map.codec import voxel_kernels as v
from gnd.gnd_map.codec.coding import Coder
from gnd.gnd_map.codec.lattice import Integers, Lattice, Quantised
from gnd.gnd_map.codec.priors import FLAGS_AT, VOXEL_WEIGHTS_AT, VOXELS_AT, number_at
from gnd.gnd_map.errors import CodecError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile_id import TileId

U8 = npt.NDArray[np.uint8]
MAX_VOLUME: Final = 1 << 22
"""Voxels of the box around a tile's Gaussians: 2,700 floors of 39 x 39."""
MAX_MESSAGE_VOLUME: Final = 1 << 23
"""Voxels of all boxes of a message: 270 tiles with 20 floors each; reading them takes some 0.2 s."""
MOST_COUNT: Final = 30
"""Largest index of a number of points that is coded."""
MAX_FLOOR: Final = 100_000
"""As `VoxelGrid` has it."""
_ANY: Final = number_at(0) + 69  # a context of its own in the room of the first number


@dataclass(frozen=True, slots=True)
class Box:
    """All voxels of a tile between two floors.

    Attributes:
        grid: the tile's.
        lowest: first floor.
        floors: how many.
    """

    grid: VoxelGrid
    lowest: int
    floors: int

    def __post_init__(self) -> None:
        size = self.floors * self.grid.nx * self.grid.ny
        if not 0 < size <= MAX_VOLUME:
            raise CodecError(f"a box of {self.floors} floors, {size} voxels: the limit is {MAX_VOLUME}")
        if max(-self.lowest, self.lowest + self.floors - 1) > MAX_FLOOR:
            raise CodecError(f"{self.floors} floors from {self.lowest} on: the limit is {MAX_FLOOR} either way")

    def empty(self, dtype: type[np.generic], value: int) -> "npt.NDArray[np.generic]":
        """(floors + 4, ny + 4, nx + 4) of one value."""
        edge = 2 * k.EDGE
        return np.full((self.floors + edge, self.grid.ny + edge, self.grid.nx + edge), value, dtype)

    def places(self, voxel_id: I32) -> tuple[I64, I64, I64]:
        """(N,) each: indices z, y, x into the arrays."""
        ix, iy, floor = self.grid.unravel(voxel_id)
        z = floor.astype(np.int64) - self.lowest + k.EDGE
        return z, iy.astype(np.int64) + k.EDGE, ix.astype(np.int64) + k.EDGE

    def voxel_ids(self, z: I64, y: I64, x: I64) -> I32:
        """(N,) ids of places."""
        ids = self.grid.voxel_id(x - k.EDGE, y - k.EDGE, z - k.EDGE + self.lowest)
        return np.asarray(ids, np.int32)

    def marks(self) -> U8:
        """Room for the blocks."""
        return np.zeros([-(-n // k.BLOCK) + 2 for n in (self.floors, self.grid.ny, self.grid.nx)], np.uint8)


def floors_of(tile_id: TileId, voxel_id: I32) -> tuple[int, int]:
    """Lowest and highest floor of some voxels (at least one), ascending."""
    _, _, floor = VoxelGrid.of(tile_id).unravel(voxel_id[[0, -1]])
    return int(floor[0]), int(floor[1])


def box_of(tile_id: TileId, voxel_id: I32) -> Box:
    """The box around some voxels (at least one), ascending."""
    low, high = floors_of(tile_id, voxel_id)
    return Box(VoxelGrid.of(tile_id), low, high - low + 1)


def code_box(coder: Coder, tile_id: TileId, held: I32, flagged: I32 | None) -> Box | None:
    """Write or read the floors between which the held and the flagged voxels lie; None: nothing is flagged.

    Args:
        coder: the stream.
        tile_id: which tile.
        held: (H,) voxel ids that both sides know.
        flagged: (F,) to write; None to read.
    """
    if not coder.bit(_ANY, 0 if flagged is None else len(flagged) > 0):
        return None
    low, high = floors_of(tile_id, held) if len(held) else (0, 0)
    lo, hi = floors_of(tile_id, flagged) if flagged is not None else (0, 0)
    if len(held):
        below = coder.number(number_at(1), max(low - lo, 0))
        above = coder.number(number_at(2), max(hi - high, 0))
        if below < 0 or above < 0:
            raise CodecError(f"floors {low - below} .. {high + above} leave out those held, {low} .. {high}")
        lo, hi = low - below, high + above
    else:
        lo = coder.number(number_at(0), lo)
        hi = lo + coder.number(number_at(3), hi - lo)
    box = Box(VoxelGrid.of(tile_id), lo, hi - lo + 1)
    coder.volume += box.floors * box.grid.nx * box.grid.ny
    if coder.volume > MAX_MESSAGE_VOLUME:
        raise CodecError(f"boxes of {coder.volume} voxels in one message: the limit is {MAX_MESSAGE_VOLUME}")
    return box


def code_flags(coder: Coder, box: Box, held: I32, flag: U8) -> int:
    """Write the flags of a box's voxels or read them into `flag`; how many."""
    known = np.asarray(box.empty(np.uint8, 0), np.uint8)
    if len(held):
        known[box.places(held)] = 1
    size = box.floors, box.grid.ny, box.grid.nx
    n = int(k.code_flags(coder.state, known.reshape(-1), flag.reshape(-1), box.marks(), size, FLAGS_AT, 0))
    coder.check()
    return n


_INTEGERS: Final[ByObject[Integers]] = ByObject(128)
"""Of the bases used last: many messages refer to one version of a tile."""


@dataclass(frozen=True, slots=True)
class KnownVolume:
    """Gaussians that both sides hold, as integers of a lattice (nearest where they do not lie on it)."""

    quantised: Quantised
    replaced: npt.NDArray[np.bool_]
    """(N,) those that will be replaced: they predict their successor, and nothing else."""


def known_of(
    base: Gaussians, replaced: npt.NDArray[np.bool_], gone: npt.NDArray[np.bool_], lattice: Lattice
) -> KnownVolume:
    """What the base tells about those that come."""
    integers = _INTEGERS.of(base, lambda: Integers.of(base, lattice), lattice)
    return KnownVolume(integers.nearest(~gone), replaced[~gone])


NOTHING_KNOWN: Final = KnownVolume(
    Quantised(*(np.zeros((0, 3) if wide else 0, np.int32) for wide in (0, 0, 1, 1, 1, 0))), np.zeros(0, np.bool_)
)


@dataclass(frozen=True, slots=True, eq=False)
class LaidOut:
    """The Gaussians of some voxels of a box as the kernel takes them; once laid out, they are written any number of
    times.

    Attributes:
        box: in which they lie.
        lattice: of their integers.
        voxel_id: (N,) of those that are coded.
        places: of these.
        table: (1 + K + N, COLUMNS) see `VoxelCoding`.
        where: (floors + 4, ny + 4, nx + 4) likewise.
    """

    box: Box
    lattice: Lattice
    voxel_id: I32
    places: tuple[I64, I64, I64]
    table: I32
    where: I32

    @classmethod
    def of(
        cls, box: Box, voxel_id: I32, known: KnownVolume, lattice: Lattice, quantised: Quantised | None
    ) -> "LaidOut":
        """Those of these voxels, to be written; to be read where `quantised` is None."""
        n_known, places = len(known.quantised), box.places(voxel_id)
        table = np.zeros((1 + n_known + len(voxel_id), v.COLUMNS), np.int32)
        where = np.asarray(box.empty(np.int32, -1), np.int32)
        table[0] = _typical(lattice)
        new = table[1 + n_known :]
        new[:, v.SELF] = -1
        if n_known:
            known_places = box.places(known.quantised.voxel_id)
            _fill_places(table[1 : 1 + n_known], known_places)
            _fill(table[1 : 1 + n_known], known.quantised)
            where[known_places] = np.arange(1, 1 + n_known)
            new[:, v.SELF] = where[places]
            where[tuple(one[known.replaced] for one in known_places)] = -2
        _fill_places(new, places)
        if quantised is not None:
            _fill(new, quantised)
        return cls(box, lattice, voxel_id, places, table, where)

    @property
    def n_known(self) -> int:
        """K: how many both sides hold."""
        return len(self.table) - len(self.voxel_id) - 1

    def code(self, coder: Coder) -> None:
        """Write them, or read them into the table."""
        self.expect()
        v.code_voxels(voxel_coding(coder, self), 1 + self.n_known)
        coder.check()

    def expect(self) -> None:
        """Note where a Gaussian will come."""
        self.where[self.places] = -2

    def read(self) -> Quantised:
        """What stands in the table."""
        rows = self.table[1 + self.n_known :]
        columns = (
            rows[:, v.AXIS],
            rows[:, v.LEVEL : v.LEVEL + 3],
            rows[:, v.SLOPE : v.SLOPE + 3],
            rows[:, v.STEP : v.STEP + 3],
            rows[:, v.COUNT],
        )
        return Quantised(self.voxel_id, *map(np.ascontiguousarray, columns))


def code_voxels(
    coder: Coder, box: Box, voxel_id: I32, known: KnownVolume, lattice: Lattice, quantised: Quantised | None
) -> Quantised:
    """Write the Gaussians of these voxels, or read them (`quantised` None)."""
    laid_out = LaidOut.of(box, voxel_id, known, lattice, quantised)
    laid_out.code(coder)
    return laid_out.read() if quantised is None else quantised


def _fill_places(rows: I32, places: tuple[I64, I64, I64]) -> None:
    rows[:, v.Z], rows[:, v.Y], rows[:, v.X] = places


def _fill(rows: I32, q: Quantised) -> None:
    rows[:, v.AXIS], rows[:, v.COUNT] = q.axis, q.count
    rows[:, v.LEVEL : v.LEVEL + 3], rows[:, v.SLOPE : v.SLOPE + 3], rows[:, v.STEP : v.STEP + 3] = (
        q.level,
        q.slope,
        q.step,
    )


@lru_cache(maxsize=16)
def _typical(lattice: Lattice) -> I32:
    """A row of values to expect where no neighbour is known: 1.5 cm thick, 28 cm wide, some hundred points."""
    row = np.zeros(v.COLUMNS, np.int32)
    sd_m = np.array(lattice.sd) * 2.0**-20
    wide = int(np.searchsorted(sd_m[:: lattice.plane_step], 0.28))
    row[v.LEVEL : v.LEVEL + 3] = wide, wide, int(np.searchsorted(sd_m, 0.015))
    row[v.AXIS], row[v.SELF], row[v.COUNT] = 3, -1, int(np.searchsorted(lattice.counts, 80))
    return row


@lru_cache(maxsize=16)
def _sizes(lattice: Lattice) -> tuple[I64, I64]:
    """Standard deviations, and the largest numbers of the families that have one."""
    top = len(lattice.sd) - 1
    tops = [top, top // lattice.plane_step, top // lattice.plane_step, MOST_COUNT]
    return np.array(lattice.sd, np.int64), np.array(tops, np.int64)


def voxel_coding(coder: Coder, laid_out: LaidOut) -> v.VoxelCoding:
    """What the voxels of the box are coded with."""
    lattice, grid, (_, ny, nx) = laid_out.lattice, laid_out.box.grid, laid_out.where.shape
    # 1/256 m: coarse enough that no machine's sine rounds it another way
    pitch = [round(size_m * 256) << (lattice.mean_bits - 8) for size_m in (grid.dx_m, grid.dy_m, grid.dz_m)]
    has_base = laid_out.n_known > 0
    sd, tops = _sizes(lattice)
    return v.VoxelCoding(
        coder.state,
        VOXELS_AT,
        VOXEL_WEIGHTS_AT,
        laid_out.table,
        laid_out.where.reshape(-1),
        ny * nx,
        nx,
        v.neighbours(ny * nx, nx, only_before=not has_base),
        np.zeros(1 + v.NEIGHBOURS + 1, np.int64),
        np.zeros(v.MOST_REFS + 1, np.int64),
        np.zeros(v.MEMO, np.int64),
        tops,
        sd,
        np.array(pitch, np.int64),
        lattice.plane_step,
        lattice.slope_bits,
        lattice.shear_bits,
        lattice.thin_bits,
        lattice.plane_bits,
        lattice.length_bits,
        lattice.mean_bits,
        int(has_base),
        int(coder.five),
    )
