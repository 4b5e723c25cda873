"""Why a voxel in which nothing changed was reported: the first of these that holds."""

from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.gaussian import full_matrices
from gnd.vehicle_agent.detect.records import planar_normals
from gnd.vehicle_agent.local_map import LocalMap
from studies.real.drive import local_map_of
from studies.real.rounds import Round

CAUSES: Final[dict[str, str]] = {
    "mover": "a third of its points lies on what motion segmentation calls moving",
    "edge of a surface": "the map just missed it: 5 to 19 sub-cells, on the plane of a planar neighbour",
    "map just missed it": "5 to 19 sub-cells in the map's half, on no neighbour's plane",
    "map did not see it": "fewer than 5 sub-cells in the map's half",
    "far": "more than 25 m from the track",
    "thin in the map": "20 to 30 sub-cells in the map's half",
    "rough": "no plane: leaves, posts, corners",
    "other": "",
}
MOVING_SHARE: Final = 1 / 3
FAR_M: Final = 25.0
THIN_CELLS: Final = 30
WEAK_CELLS: Final = 5
ON_PLANE_M: Final = 0.15
ROUGH: Final = 0.1
"""Smallest variance over the largest from which a Gaussian is rough."""

_AROUND: Final = np.array([step for step in product((-1, 0, 1), repeat=3) if any(step)])


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """The map as surfaces: window and its origin, means (M, 3), normals (M, 3; zeros: no plane), roughness (M,)."""

    index: NDArray[np.int32]
    origin_g: NDArray[np.int64]
    mean_m: NDArray[np.float64]
    normal: NDArray[np.float64]
    roughness: NDArray[np.float64]

    @classmethod
    def of(cls, local_map: LocalMap) -> "Surfaces":
        """From a map window."""
        cov = full_matrices(local_map.cov_m2)
        values = np.linalg.eigvalsh(cov) if len(cov) else np.ones((0, 3))
        normal = planar_normals(cov)
        roughness = values[:, 0] / np.maximum(values[:, 2], 1e-9)
        return cls(local_map.index, local_map.window_origin_g, local_map.mean_map_m, normal, roughness)

    def rows(self, g: NDArray[np.int64]) -> NDArray[np.int64]:
        """(K,) rows of the Gaussians at grid coordinates (K, 3), -1 where there is none."""
        at = g - self.origin_g
        inside = ((at >= 0) & (at < self.index.shape)).all(axis=1)
        row = np.full(len(g), -1, np.int64)
        row[inside] = self.index[tuple(at[inside].T)]
        return np.maximum(row, -1)

    def extended_to(self, g: NDArray[np.int64], mean_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(K,) whether a planar Gaussian around a voxel, extended, meets its mean within `ON_PLANE_M`."""
        met = np.zeros(len(g), np.bool_)
        for step in _AROUND:
            row = self.rows(g + step)
            normal = self.normal[row] if len(self.normal) else np.zeros((len(g), 3))
            off_m = np.abs(((mean_m - self.mean_m[row]) * normal).sum(axis=1)) if len(normal) else np.zeros(0)
            met |= (row >= 0) & normal.any(axis=1) & (off_m <= ON_PLANE_M)
        return met

    def rough_at(self, g: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(K,) whether the map's Gaussian there is rough."""
        row = self.rows(g)
        return (row >= 0) & (self.roughness[row] >= ROUGH)


def cause_of(one: Round, rows: NDArray[np.int64]) -> list[str]:
    """The cause of each of the reported voxels `rows` (K,) of the untouched drive."""
    if not len(rows):
        return []
    u = one.untouched
    keys, mean = u.found.keys[rows], u.found.mean_m[rows]
    surfaces = Surfaces.of(local_map_of(one.scene, u.tiles))
    mapped, in_map = u.mapped.cells_at(keys), u.found.in_map[rows]
    distance = np.linalg.norm(one.scene.positions_m[:, None, :2] - mean[None, :, :2], axis=2).min(axis=0)
    weak = ~in_map & (mapped >= WEAK_CELLS)
    conditions = [
        u.moving.count_at(keys) >= MOVING_SHARE * np.maximum(u.driven.count_at(keys), 1),
        weak & surfaces.extended_to(u.found.g[rows], mean),
        weak,
        ~in_map,
        distance > FAR_M,
        in_map & (mapped < THIN_CELLS),
        surfaces.rough_at(u.found.g[rows]),
    ]
    names = list(CAUSES)
    first = np.select(conditions, range(len(conditions)), len(names) - 1)
    return [names[int(i)] for i in first]
