"""Objects inserted ray-accurately into real scans: exact truth in real noise.

A point whose ray meets the object moves onto its surface, keeping its beam, time and place in the firing order; what
lay behind is thereby gone. Inserted into the vehicles' scans the object is `new`; inserted into the map's scans it is
`deleted`. Beams without a return (into the sky) are not in a recording, so an object seen against the sky stays without
the points there.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import SimError
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.shapes import Block, Post, Shape
from gnd.gnd_map.accumulate import N_MIN_CELLS, VoxelAccumulator
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile_id import TileId

FloatArray = NDArray[np.float64]

_REACH_M = 200.0
"""A sensor farther away than this from the objects does not see them."""
_SPACING_M = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class InsertedScan:
    """A scan with an object in it.

    Attributes:
        points_lidar_m: float32 (N, 3), as given, but for the points that met the object.
        hit: bool (N,), points that now lie on the object.
    """

    points_lidar_m: NDArray[np.float32]
    hit: NDArray[np.bool_]


class Inserter:
    """Objects to be put into scans; `shapes` are in the map frame (upright, heights along its z)."""

    def __init__(self, shapes: Sequence[Shape]) -> None:
        self._scene = Scene.build(shapes, margin_m=_REACH_M)

    def insert(
        self,
        points_lidar_m: NDArray[np.float32],
        T_map_lidar: FloatArray,
        rng: np.random.Generator | None = None,
        range_sigma_m: float = 0.0,
    ) -> InsertedScan:
        """Put the objects into one scan.

        Args:
            points_lidar_m: float32 (N, 3), each in the lidar frame of its own time.
            T_map_lidar: float64 (4, 4) for the whole scan, or (N, 4, 4) one pose a point (moving sensor).
            rng: draws the range noise of the points that are moved.
            range_sigma_m: its standard deviation.

        Returns:
            The scan with the objects.

        Raises:
            SimError: shapes of the arrays do not agree.
        """
        points = np.asarray(points_lidar_m, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or T_map_lidar.shape not in ((4, 4), (len(points), 4, 4)):
            found = f"{points.shape} and {T_map_lidar.shape}"
            raise SimError(f"points must be (N, 3) and poses (4, 4) or (N, 4, 4), got {found}")
        range_m = np.maximum(np.linalg.norm(points, axis=1), 1e-9)
        met_m = self._met_m(points / range_m[:, None], T_map_lidar)
        hit = met_m < range_m
        noise_m = 0.0 if rng is None else range_sigma_m * rng.standard_normal(int(hit.sum()))
        moved = np.array(points_lidar_m, dtype=np.float32)
        moved[hit] = points[hit] * ((met_m[hit] + noise_m) / range_m[hit])[:, None]
        return InsertedScan(moved, hit)

    def _met_m(self, directions_lidar: FloatArray, T_map_lidar: FloatArray) -> FloatArray:
        """Ranges (N,) at which beams meet the objects, inf where they do not, or start too far away."""
        T = np.broadcast_to(T_map_lidar, (len(directions_lidar), 4, 4))
        directions = np.einsum("nij,nj->ni", T[:, :3, :3], directions_lidar)
        met_m = np.full(len(directions), np.inf)
        near = self._scene.holds(T[:, :3, 3])
        met_m[near] = self._scene.cast(T[near, :3, 3], directions[near], _REACH_M)[0]
        return met_m


def surface_points(shape: Block | Post, spacing_m: float = _SPACING_M) -> FloatArray:
    """Return points spread evenly over the sides and the top of an object, float64 (N, 3), frame of the shape.

    The underside is left out: no sensor on a road sees it.
    """
    return _block_surface(shape, spacing_m) if isinstance(shape, Block) else _post_surface(shape, spacing_m)


def _block_surface(block: Block, spacing_m: float) -> FloatArray:
    u = _steps(-block.half_x_m, block.half_x_m, spacing_m)
    v = _steps(-block.half_y_m, block.half_y_m, spacing_m)
    top_u, top_v = (grid.ravel() for grid in np.meshgrid(u, v))
    rim_u = np.concatenate([u, u, np.full_like(v, -block.half_x_m), np.full_like(v, block.half_x_m)])
    rim_v = np.concatenate([np.full_like(u, -block.half_y_m), np.full_like(u, block.half_y_m), v, v])
    share = np.linspace(0.0, 1.0, max(2, round((block.top_m - block.bottom_m) / spacing_m) + 1))[:, None]
    rim_top = block.top_m + block.rise_x * rim_u + block.rise_y * rim_v
    side_z = block.bottom_m + share * (rim_top - block.bottom_m)
    a = np.concatenate([top_u, np.tile(rim_u, len(share))])
    b = np.concatenate([top_v, np.tile(rim_v, len(share))])
    z = np.concatenate([block.top_m + block.rise_x * top_u + block.rise_y * top_v, side_z.ravel()])
    c, s = np.cos(block.yaw_rad), np.sin(block.yaw_rad)
    return np.stack([block.x_m + c * a - s * b, block.y_m + s * a + c * b, z], axis=1)


def _post_surface(post: Post, spacing_m: float) -> FloatArray:
    angle = np.linspace(0.0, 2 * np.pi, max(8, round(2 * np.pi * post.radius_m / spacing_m)), endpoint=False)
    height = _steps(post.bottom_m, post.top_m, spacing_m)
    radius = _steps(0.0, post.radius_m, spacing_m)
    side = [(post.radius_m * np.cos(angle), post.radius_m * np.sin(angle), np.full_like(angle, z)) for z in height]
    lid = [(r * np.cos(angle), r * np.sin(angle), np.full_like(angle, post.top_m)) for r in radius]
    x, y, z = (np.concatenate(column) for column in zip(*side, *lid, strict=True))
    return np.stack([post.x_m + x, post.y_m + y, z], axis=1)


def _steps(low: float, high: float, spacing_m: float) -> FloatArray:
    return np.linspace(low, high, max(2, round((high - low) / spacing_m) + 1))


def surface_voxels(
    grid_frame: GridFrame, shapes: Sequence[Block | Post], n_min_cells: int = N_MIN_CELLS
) -> dict[TileId, Gaussians]:
    """Return the Gaussians of an object's surface by tile: the voxels that it occupies, whoever sees them.

    Args:
        grid_frame: its frame is the frame of the shapes.
        shapes: what the object is made of, map frame.
        n_min_cells: occupied sub-cells from which on a voxel counts.
    """
    accumulator = VoxelAccumulator(grid_frame)
    for shape in shapes:
        accumulator.add(surface_points(shape))
    return accumulator.finish(n_min_cells)
