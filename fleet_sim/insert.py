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
from gnd.fleet_sim.shapes import Shape

FloatArray = NDArray[np.float64]

_REACH_M = 200.0
"""A sensor farther away than this from the objects does not see them."""


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
