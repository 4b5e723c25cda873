"""The voxels of a world as strangers index them: i, j, k from 0, in one map frame."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.truth import Truth, grid_of
from gnd.gnd_map.arrays import I64
from gnd.gnd_map.bounded import json_value
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile_id import TileId
from studies.benchmark.errors import BenchmarkError

_MOST: Final = 1e5
_MARGIN: Final = 8
"""Voxels of room around those that the truth knows."""


def _coordinate(value: Any) -> float:
    """A latitude, longitude or height; ValueError, TypeError: it is none."""
    number = float(value)
    if not abs(number) < _MOST:  # NaN fails, too
        raise ValueError(f"{number} is no coordinate")
    return number


@dataclass(frozen=True, slots=True)
class IndexFrame:
    """The grid of a world, cut to a box of voxels whose lowest corner is (0, 0, 0).

    Attributes:
        grid: the voxels of the Earth in the world's map frame.
        first: int64 (3,) grid coordinates of voxel (0, 0, 0).
        size: int64 (3,) voxels along each axis.
    """

    grid: GridFrame
    first: I64
    size: I64

    @classmethod
    def around(cls, truth: Truth) -> "IndexFrame":
        """Return the box around all voxels of a truth."""
        grid = grid_of(truth)
        g = _grid_of(grid, truth.morton, truth.voxel_id)
        first = g.min(axis=0) - _MARGIN
        return cls(grid, first, g.max(axis=0) + _MARGIN + 1 - first)

    @classmethod
    def read(cls, path: Path) -> "IndexFrame":
        """Read what `write` wrote.

        Raises:
            BenchmarkError: the file is missing or damaged.
        """
        try:
            found = json_value(path.read_text(encoding="utf-8"))
            frame = LocalFrame(*(_coordinate(found[name]) for name in ("lat_rad", "lon_rad", "height_m")))
            grid = GridFrame.around(frame, [TileId.from_geodetic(frame.lat_rad, frame.lon_rad)])
            first, size = (np.array(found[name], np.int64) for name in ("first", "size"))
            of_file = found["nx"], found["ny"]
        except (OSError, ValueError, KeyError, TypeError, OverflowError, GndError) as error:
            raise BenchmarkError(f"cannot read the frame {path}: {error}") from error
        if of_file != (grid.nx, grid.ny):
            raise BenchmarkError(f"{path} has tiles of {of_file} voxels, here they are {(grid.nx, grid.ny)}")
        return cls(grid, first, size)

    def plain(self) -> dict[str, Any]:
        """Return the content of frame.json."""
        frame = self.grid.frame
        return {
            "about": "map frame: east, north, up in metres at this point; voxel (0,0,0) is `first` of the grid",
            "lat_rad": frame.lat_rad,
            "lon_rad": frame.lon_rad,
            "height_m": frame.height_m,
            "nx": self.grid.nx,
            "ny": self.grid.ny,
            "first": self.first.tolist(),
            "size": self.size.tolist(),
        }

    def ijk(self, morton: NDArray[np.int64], voxel_id: NDArray[np.int32]) -> I64:
        """Return i, j, k, int64 (N, 3), of voxels by tile and id."""
        return _grid_of(self.grid, morton, voxel_id) - self.first

    def inside(self, ijk: I64) -> NDArray[np.bool_]:
        """Return which voxels (N, 3) lie in the box, bool (N,)."""
        return np.asarray(((ijk >= 0) & (ijk < self.size)).all(axis=1))


def _grid_of(grid: GridFrame, morton: NDArray[np.int64], voxel_id: NDArray[np.int32]) -> I64:
    """Integer grid coordinates, int64 (N, 3), of voxels of several tiles."""
    found = np.zeros((len(morton), 3), np.int64)
    for code in np.unique(morton).tolist():
        at = np.flatnonzero(morton == code)
        found[at] = grid.grid_of_voxel(TileId(code), voxel_id[at])
    return found
