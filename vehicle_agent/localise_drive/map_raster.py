"""The map from above as an image of fixed size, whatever the length of the drive: tiles are drawn one by one."""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.gaussian import full_matrices
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile

GROUND, WALL, OTHER = 0, 1, 2
KINDS: Final = ("ground", "walls", "other")
COLOURS: Final = np.array([[0xDD, 0xE4, 0xEC], [0x4E, 0x5D, 0x70], [0xA3, 0xB0, 0xBF]]) / 255.0
_SIGMAS: Final = 1.9
"""Drawn size: an evenly filled plane across a 1 m voxel just reaches the neighbouring voxel's."""
_FLAT: Final = 0.1
"""A surface's smallest variance is at most this share of the next one."""
_LEVEL, _UPRIGHT = 0.9, 0.35
"""Vertical part of the normal of ground, and of walls."""
_DOTS_A_PIXEL: Final = 6.0
_MAX_DOTS: Final = 1200
_FULL: Final = 4.0
"""So many dots fill a pixel."""
_GOLDEN_ANGLE: Final = np.pi * (3.0 - np.sqrt(5.0))


@dataclass(slots=True, eq=False)
class MapRaster:
    """An image of the rectangle of a view: x to the right from `left_m`, y up from `bottom_m`.

    R_view_map (2, 2) turns the horizontal map frame into the view.
    """

    frame: LocalFrame
    R_view_map: F64
    left_m: float
    bottom_m: float
    pixel_m: float
    shape: tuple[int, int]
    """Rows, columns."""
    gaussians: int = 0
    _dots: npt.NDArray[np.float32] = field(init=False)

    def __post_init__(self) -> None:
        self._dots = np.zeros((len(KINDS), *self.shape), np.float32)

    def add(self, tile: Tile) -> None:
        """Draw the Gaussians of a tile as ellipses."""
        gaussians = tile.gaussians
        if not len(gaussians):
            return
        self.gaussians += len(gaussians)
        T = self.frame.T_self_other(LocalFrame.of_tile(tile.tile_id))
        p_tile = VoxelGrid.of(tile.tile_id).centre_m(gaussians.voxel_id) + gaussians.mean_m
        p_map, cov = p_tile @ T[:3, :3].T + T[:3, 3], T[:3, :3] @ full_matrices(gaussians.cov_m2) @ T[:3, :3].T
        R = self.R_view_map
        centre, spread = p_map[:, :2] @ R.T, R @ cov[:, :2, :2] @ R.T
        kind = kinds_of(cov)
        for k in range(len(KINDS)):
            self._draw(k, centre[kind == k], spread[kind == k])

    def image(self) -> F64:
        """(rows, columns, 3) colours in 0 ... 1, first row lowest: walls over other things over ground over white."""
        image = np.ones((*self.shape, 3))
        for kind in (GROUND, OTHER, WALL):
            cover = np.minimum(self._dots[kind] / _FULL, 1.0)[..., None]
            image = image * (1.0 - cover) + COLOURS[kind] * cover
        return image

    def _draw(self, kind: int, centre_m: F64, cov_m2: F64) -> None:
        """Scatter dots evenly over ellipses of N covariances (N, 2, 2); where they are few, each counts more."""
        dots = int(np.clip(round(_DOTS_A_PIXEL / self.pixel_m**2), int(_FULL), _MAX_DOTS))
        values, vectors = np.linalg.eigh(cov_m2)
        root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        at = centre_m[:, None, :] + _SIGMAS * disc(dots) @ np.swapaxes(root, 1, 2)
        pixel = np.floor((at.reshape(-1, 2) - [self.left_m, self.bottom_m]) / self.pixel_m).astype(np.int64)
        rows, columns = self.shape
        inside = (pixel >= 0).all(axis=1) & (pixel[:, 0] < columns) & (pixel[:, 1] < rows)
        flat = pixel[inside, 1] * columns + pixel[inside, 0]
        area_pixels = np.pi * _SIGMAS**2 * np.sqrt(np.maximum(values.prod(axis=1), 0.0)) / self.pixel_m**2
        weight = np.repeat(np.maximum(1.0, _FULL * area_pixels / dots), dots)[inside]
        drawn = np.bincount(flat, weight, minlength=rows * columns)
        self._dots[kind] += drawn.reshape(self.shape).astype(np.float32)


def disc(n: int) -> F64:
    """(n, 2) points spread evenly over the unit disc (Vogel's spiral)."""
    k = np.arange(n)
    radius, angle = np.sqrt((k + 0.5) / n), k * _GOLDEN_ANGLE
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def kinds_of(cov_m2: F64) -> npt.NDArray[np.int64]:
    """(N,) GROUND, WALL or OTHER of covariances (N, 3, 3) in a frame whose z is up."""
    values, vectors = np.linalg.eigh(cov_m2)
    flat, up = values[:, 0] <= _FLAT * values[:, 1], np.abs(vectors[:, 2, 0])
    return np.where(flat & (up >= _LEVEL), GROUND, np.where(flat & (up <= _UPRIGHT), WALL, OTHER))
