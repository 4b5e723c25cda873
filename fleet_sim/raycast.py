"""Exact intersection of rays with the primitives of a street, by a walk over a flat grid of primitive lists.

Nothing here is shared with the vehicle's ray caster: the simulator stays an independent witness. The kernels are those
of `gnd.fleet_sim.ray_kernels`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import SceneError
from gnd.fleet_sim.ray_kernels import FloatArray, IntArray, RayGrid, cast_fan, cast_rays
from gnd.fleet_sim.shapes import Shape, pack

CELL_M: Final = 2.0


@dataclass(frozen=True, slots=True)
class Scene:
    """Primitives with their grid, ready for rays that are given in the map frame.

    Attributes:
        A_street_map: float64 (3, 3), street-frame coordinates of a map-frame vector (turn about z, then shear).
        packed: float64 (M, 13), primitives as `shapes.pack` lays them out.
        starts: int32 (nx * ny + 1,), where the list of each grid cell starts in `items`.
        items: int32, primitives of the cells, one list after the other.
        tops_m: float64 (nx * ny,), nothing in the cell reaches higher.
        origin_m: (x, y) of the grid's corner in the street frame.
        shape: (nx, ny) cells.
        cell_m: edge of a cell.
    """

    A_street_map: FloatArray
    packed: FloatArray
    starts: IntArray
    items: IntArray
    tops_m: FloatArray
    origin_m: tuple[float, float]
    shape: tuple[int, int]
    cell_m: float

    @staticmethod
    def build(
        shapes: Sequence[Shape], A_street_map: FloatArray | None = None, cell_m: float = CELL_M, margin_m: float = 0.0
    ) -> "Scene":
        """Sort primitives into the grid's cells.

        Args:
            shapes: at least one primitive, in the street frame.
            A_street_map: float64 (3, 3); identity when the rays come in the frame of the shapes.
            cell_m: edge of a grid cell.
            margin_m: so much room for ray origins around the primitives.

        Raises:
            SceneError: there is no primitive.
        """
        if not shapes:
            raise SceneError("a scene needs at least one primitive, got none")
        bounds = np.array([shape.bounds() for shape in shapes])
        low = np.floor((bounds[:, 0:2].min(axis=0) - margin_m) / cell_m - 1) * cell_m
        high = bounds[:, 2:4].max(axis=0) + margin_m
        nx, ny = (np.ceil((high - low) / cell_m).astype(int) + 1).tolist()
        starts, items, tops = _fill_cells(bounds, low, (nx, ny), cell_m)
        A = np.eye(3) if A_street_map is None else np.ascontiguousarray(A_street_map, dtype=np.float64)
        return Scene(A, pack(shapes), starts, items, tops, (float(low[0]), float(low[1])), (nx, ny), cell_m)

    def cast(self, origins: FloatArray, directions: FloatArray, range_m: float) -> tuple[FloatArray, IntArray]:
        """Cast N rays.

        Args:
            origins: float64 (N, 3) or (3,), map frame [m].
            directions: float64 (N, 3), unit vectors of the map frame.
            range_m: hits beyond it are misses.

        Returns:
            range to the first surface, float64 (N,), inf for a miss; index of the primitive, int32 (N,), -1 for a miss.

        Raises:
            SceneError: an origin lies outside the grid of the scene, or shapes do not agree.
        """
        if directions.ndim != 2 or directions.shape[1] != 3:
            raise SceneError(f"directions must be (N, 3), got {directions.shape}")
        start = np.ascontiguousarray(np.broadcast_to(origins @ self.A_street_map.T, directions.shape))
        self.check_inside(start)
        return self.cast_in_street(start, directions @ self.A_street_map.T, range_m)

    def cast_in_street(
        self, origins: FloatArray, directions: FloatArray, range_m: float
    ) -> tuple[FloatArray, IntArray]:
        """As `cast`, of origins and directions float64 (N, 3) that are images in the street frame, and whose origins
        are known to lie inside.
        """
        met = np.empty(len(directions)), np.empty(len(directions), np.int32)
        cast_rays(origins, directions, range_m, *self.arrays(), *met)
        return met

    def cast_fan(self, origin: FloatArray, directions: FloatArray, reach_m: FloatArray) -> tuple[FloatArray, IntArray]:
        """As `cast`, of N rays from one place (3,), each with its own reach (N,), all in the frame of the shapes.

        Directions float64 (N, 3) are images of the map frame's unit vectors, so that ranges are in metres.

        Raises:
            SceneError: the origin lies outside the grid of the scene.
        """
        self.check_inside(origin[None, :])
        met = np.empty(len(directions)), np.empty(len(directions), np.int32)
        cast_fan(origin, directions, reach_m, *self.arrays(), *met)
        return met

    def holds(self, points_street: FloatArray) -> NDArray[np.bool_]:
        """Return which points (N, 3) lie inside the grid, bool (N,): rays may start there."""
        low = np.array(self.origin_m)
        high = low + np.array(self.shape) * self.cell_m
        return np.asarray(((points_street[:, 0:2] > low) & (points_street[:, 0:2] < high)).all(axis=1))

    def check_inside(self, points_street: FloatArray) -> None:
        """Refuse ray origins (N, 3) outside the grid: the walk starts in a cell.

        Raises:
            SceneError: names the first such origin and the grid's extent.
        """
        outside = np.flatnonzero(~self.holds(points_street))
        if outside.size:
            low, size = np.array(self.origin_m), np.array(self.shape) * self.cell_m
            raise SceneError(
                f"{outside.size} ray origins lie outside the scene, the first at"
                f" {points_street[outside[0], 0:2].round(2).tolist()} m;"
                f" the scene spans {low.tolist()} to {(low + size).tolist()} m"
            )

    def arrays(self) -> tuple[FloatArray, IntArray, IntArray, FloatArray, RayGrid]:
        """Return the scene as the compiled kernels take it: flat primitives, starts, items, tops, grid."""
        grid = RayGrid(*self.origin_m, *self.shape, self.cell_m)
        return self.packed.reshape(-1), self.starts, self.items, self.tops_m, grid


def _fill_cells(
    bounds: FloatArray, low: FloatArray, shape: tuple[int, int], cell_m: float
) -> tuple[IntArray, IntArray, FloatArray]:
    lists: list[list[int]] = [[] for _ in range(shape[0] * shape[1])]
    first = np.floor((bounds[:, 0:2] - low) / cell_m - 1e-9).astype(int)
    last = np.floor((bounds[:, 2:4] - low) / cell_m + 1e-9).astype(int)
    for index in range(len(bounds)):
        for ix in range(max(first[index, 0], 0), last[index, 0] + 1):
            for iy in range(max(first[index, 1], 0), last[index, 1] + 1):
                lists[ix * shape[1] + iy].append(index)
    starts = np.concatenate([[0], np.cumsum([len(cell) for cell in lists])]).astype(np.int32)
    items = np.fromiter((i for cell in lists for i in cell), dtype=np.int32, count=int(starts[-1]))
    tops = np.array([max((bounds[i, 4] for i in cell), default=-np.inf) for cell in lists])
    return starts, items, tops
