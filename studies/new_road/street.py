"""A street whose map is cut: a hole in its middle, and nothing beyond an edge."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.world import World
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.se3 import transform
from gnd.gnd_map.tile_id import TileId
from studies.simulation.base_map import BaseMap

BEFORE_M: Final = 110.0
"""Way on the map before the hole."""
BETWEEN_M: Final = 80.0
"""Way on the map between the hole and the edge, at least."""
_BACK_M: Final = (0.05, 0.15, 0.3, 0.5)
_FAR_M: Final = 1.0


@dataclass(frozen=True, slots=True)
class MapCut:
    """Where the map ends, along the street: a hole from `gap_m[0]` to `gap_m[1]`, and all beyond `edge_m`."""

    gap_m: tuple[float, float]
    edge_m: float

    @classmethod
    def of(cls, half_length_m: float, gap_m: float, edge_m: float) -> "MapCut":
        """A hole and an edge of these lengths on a street."""
        low_m = -half_length_m + BEFORE_M
        return cls((low_m, low_m + gap_m), half_length_m - edge_m)

    def is_new(self, x_m: F64) -> NDArray[np.bool_]:
        """(N,) whether places along the street are off the map."""
        return np.asarray(((x_m > self.gap_m[0]) & (x_m < self.gap_m[1])) | (x_m > self.edge_m))


def means_map_m(world: World, tile: TileId, gaussians: Gaussians) -> F64:
    """(N, 3) means in the world's map frame."""
    T = world.frame.T_self_other(LocalFrame.of_tile(tile))
    return transform(T, VoxelGrid.of(tile).centre_m(gaussians.voxel_id) + gaussians.mean_m)


def split_map(world: World, base: BaseMap, cut: MapCut) -> tuple[BaseMap, BaseMap]:
    """The map with the cut, and what was cut out."""
    parts: tuple[dict[TileId, Gaussians], dict[TileId, Gaussians]] = ({}, {})
    for tile, gaussians in base.tiles.items():
        new = cut.is_new(world.street_of_map(means_map_m(world, tile, gaussians))[:, 0])
        for part, chosen in zip(parts, (~new, new), strict=True):
            if chosen.any():
                part[tile] = gaussians.take(chosen)
    return BaseMap(parts[0]), BaseMap(parts[1])


@dataclass(frozen=True, slots=True)
class TrueSurface:
    """The true surfaces of a world, without cars and without noise."""

    world: World
    scene: Scene

    @classmethod
    def of(cls, world: World) -> "TrueSurface":
        """Of the state after."""
        return cls(world, Scene.build(world.shapes("after"), world.A_street_map, margin_m=50.0))

    def distances_m(self, p_map_m: F64, axes: F64) -> F64:
        """(N,) distance of points (N, 3) from the nearest surface along the axes (N, 3, 3, columns); 1 m at most.

        Rays go towards the point from either side, from some centimetres to half a metre away.
        """
        best = np.full(len(p_map_m), _FAR_M)
        for axis in range(3):
            for side in (-1.0, 1.0):
                direction = np.ascontiguousarray(side * axes[:, :, axis])
                for back_m in _BACK_M:
                    start = p_map_m - back_m * direction
                    range_m, _ = self.scene.cast(start, direction, 2.0 * _FAR_M)
                    best = np.minimum(best, np.abs(range_m - back_m))
        return best


def axes_of(world: World, tile: TileId, gaussians: Gaussians) -> tuple[F64, F64]:
    """(N, 3) standard deviations, ascending, and (N, 3, 3) axes in columns, in the world's map frame."""
    R = world.frame.T_self_other(LocalFrame.of_tile(tile))[:3, :3]
    values, axes = np.linalg.eigh(R @ gaussians.full_cov() @ R.T)
    return np.sqrt(np.maximum(values, 0.0)), axes
