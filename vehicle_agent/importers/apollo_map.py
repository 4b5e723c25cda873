"""Apollo's own NDT map (`map_ndt_v01`): cells of a metre in UTM, mean and covariance each.

A node is a file MAP/map/RESOLUTION/north|south/ZONE/NORTH/EAST: five little-endian uint32 (resolution, zone, node
number to the north and to the east, bytes that follow), then zlib. Inside: rows, columns, and for each column of
ground its cells. A mean counts from its cell's corner, upwards from the cell's number times its height; numbers upwards
are rounded towards zero. Format read from Apollo's sources (modules/localization/msf/local_map/ndt_map).
"""

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.apollo import utm_zone, zone_folders
from gnd.vehicle_agent.importers.files import read_file

F64 = NDArray[np.float64]

_HEADER: Final = struct.Struct("<5I")
_SIZES: Final = struct.Struct("<2I")
_COUNT: Final = struct.Struct("<I")
_CELL: Final = struct.Struct("<iffII12f")  # number upwards, intensity, its variance, road points, points, mean, E[x xᵀ]
_INVERSE_BYTES: Final = 37  # inverse covariance, and whether there is one
_INVERSE_FROM: Final = 6  # cells of so many points hold it
_COLUMN_END: Final = struct.Struct("<iiI")  # highest and lowest cell, and how many numbers of road cells follow
_MAX_NODE_BYTES: Final = 1 << 26
_MOST_OF_SIZES: Final = (65_536.0, 1_000.0, 1_000.0)
_PATTERNS: Final = (r"<x>(\d+)</x>", r"<resolutions><resolution>([\d.]+)<", r"<resolutions_z><resolution>([\d.]+)<")


@dataclass(frozen=True, slots=True, eq=False)
class NdtCells:
    """N cells: mean_utm_m (N, 3) easting, northing, height; cov_m2 (N, 3, 3) against the grid's axes; count (N,)."""

    mean_utm_m: F64
    cov_m2: F64
    count: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.count)


@dataclass(frozen=True, slots=True)
class _Sizes:
    """Cells along a node's side, and metres of a cell on the ground and upwards."""

    cells: int
    cell_m: float
    height_m: float


def read_ndt_map(folder: Path) -> NdtCells:
    """The NDT map beside the scans of an Apollo recording; of several resolutions the first.

    Raises:
        ImportDriveError: there is none, or it is damaged.
    """
    utm_zone(folder)
    place = zone_folders(folder)[0]
    sizes = _sizes(place.parents[3] / "config.xml")
    corner, rows = list[tuple[float, ...]](), list[tuple[float, ...]]()
    for path in sorted(place.glob("*/*")):
        for at, row in _node(path, sizes):
            corner.append(at)
            rows.append(row)
    table = np.array(rows, np.float64).reshape(-1, 13)
    within, outer = table[:, 1:4], table[:, 4:].reshape(-1, 3, 3)
    cov = outer - within[:, :, None] * within[:, None, :]
    return NdtCells(np.array(corner).reshape(-1, 3) + within, cov, table[:, 0].astype(np.int64))


def _sizes(path: Path) -> _Sizes:
    text = read_file(path).decode("utf-8", "replace")
    found = [re.search(pattern, text) for pattern in _PATTERNS]
    try:
        values = [float(one.group(1)) for one in found if one]
    except ValueError:
        values = []
    if "map_ndt_v01" not in text or len(values) != len(_PATTERNS):
        raise ImportDriveError(f"{path}: no configuration of a map_ndt_v01")
    if not all(0.0 < value <= most for value, most in zip(values, _MOST_OF_SIZES, strict=True)):
        raise ImportDriveError(f"{path}: cells of {values}; each is above 0 and at most {_MOST_OF_SIZES}")
    return _Sizes(int(values[0]), values[1], values[2])


def _node(path: Path, sizes: _Sizes) -> Iterator[tuple[tuple[float, ...], tuple[float, ...]]]:
    """Of each cell its corner (3), and points, mean (3) and E[x xᵀ] (9) from there."""
    data = read_file(path)
    try:
        _, _, north, east, size = _HEADER.unpack_from(data)
        body = zlib.decompressobj().decompress(data[_HEADER.size : _HEADER.size + size], _MAX_NODE_BYTES)
        for y, x, level, moments in _cells(body):
            corner = ((east * sizes.cells + x) * sizes.cell_m, (north * sizes.cells + y) * sizes.cell_m)
            yield (*corner, level * sizes.height_m), moments
    except (struct.error, zlib.error, ValueError) as error:
        raise ImportDriveError(f"{path}: {len(data)} bytes that are no node of an NDT map: {error}") from error


def _cells(body: bytes) -> Iterator[tuple[int, int, int, tuple[float, ...]]]:
    """Of each cell its numbers to the north, to the east and upwards, and its points and moments (13)."""
    rows, columns = _SIZES.unpack_from(body)
    at = _SIZES.size
    if rows and rows * columns * (_COUNT.size + _COLUMN_END.size) not in range(1, len(body)):
        raise ValueError(f"{rows} rows of {columns} columns in {len(body)} bytes")
    for row in range(rows):
        for column in range(columns):
            (n,) = _COUNT.unpack_from(body, at)
            at += _COUNT.size
            for _ in range(n):
                level, _, _, _, count, *moments = _CELL.unpack_from(body, at)
                at += _CELL.size + (_INVERSE_BYTES if count >= _INVERSE_FROM else 0)
                yield row, column, level, (count, *moments)
            _, _, n_road = _COLUMN_END.unpack_from(body, at)
            at += _COLUMN_END.size + 4 * n_road
