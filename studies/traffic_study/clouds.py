"""The same street as a point cloud, one point each 0.2 m: PCD file (version 0.7), LAZ, Draco."""

import io
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np

from gnd.fleet_sim.truth import world_sha
from gnd.fleet_sim.world import World
from gnd.gnd_map.arrays import F32, F64, I64
from gnd.gnd_map.tile_id import TileId, morton_of
from studies.frame.errors import FolderError, ReproduceError
from studies.frame.kept import SIMULATOR, key_of, sources_sha
from studies.pcd.points import PcdMap, base_pcd, downsample
from studies.simulation.base_map import mapping_points
from studies.simulation.baseline import keep_cloud, read_cloud
from studies.simulation.options import Base
from studies.simulation.worlds import PCD

_HEADER = (
    "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    "WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA {kind}\n"
)


def pcd_binary(points_m: F32) -> bytes:
    """The file of points (N, 3), point after point."""
    return _HEADER.format(n=len(points_m), kind="binary").encode() + points_m.astype("<f4").tobytes()


LEAVES: Final = 5
"""Leaves of the voxel-grid filter along each side of a voxel: 0.2 m."""
LAZ_STEP_M: Final = 0.01
DRACO_BITS: Final = 12
"""Of each coordinate within a tile of 38 m: steps of 1 cm."""
_SCANS_AT_ONCE: Final = 100


def street_cloud(world: World, base: Base) -> PcdMap:
    """The cloud of the state before from the points that the map's Gaussians come from, one point each 0.2 m."""
    if base == "surveyed":
        return base_pcd(world, leaves=LEAVES)
    grid_frame = PcdMap(np.empty((0, 3), np.float32), world.frame).grid_frame
    return PcdMap(downsample(_joined(mapping_points(world)), grid_frame, LEAVES), world.frame)


def kept_cloud(world: World, base: Base, path: Path) -> PcdMap:
    """`street_cloud`, made once and kept in a file; made again when the programs that make it have changed."""
    key = key_of(world=world_sha(world), base=base, sources=sources_sha((*SIMULATOR, *PCD)), leaves=LEAVES)
    key_file = path.with_suffix(".key")
    try:
        if key_file.read_text(encoding="utf-8") == key:
            return read_cloud(path)
    except (FolderError, OSError):
        pass
    cloud = street_cloud(world, base)
    keep_cloud(cloud, path)
    key_file.write_text(key, encoding="utf-8")
    return cloud


def _joined(scans: Iterable[F64]) -> Iterator[F64]:
    """The points of many scans at a time."""
    waiting: list[F64] = []
    for scan in scans:
        waiting.append(scan)
        if len(waiting) == _SCANS_AT_ONCE:
            yield np.concatenate(waiting)
            waiting = []
    if waiting:
        yield np.concatenate(waiting)


def points_by_tile(cloud: PcdMap, tiles: Collection[TileId]) -> dict[TileId, F32]:
    """The points (N, 3) that lie in each of `tiles`; the others are left out."""
    lat_rad, lon_rad, _ = cloud.frame.geodetic_from_enu(cloud.points_m.astype(np.float64))
    tile: I64 = morton_of(lat_rad, lon_rad)
    return {one: cloud.points_m[tile == one.morton] for one in sorted(tiles)}


Written = int | str
"""A size in bytes, or why there is none."""


def cloud_sizes(points: Mapping[TileId, F32]) -> dict[str, Written]:
    """Bytes of the cloud in each format; Draco tile by tile (its steps are a share of the extent), the others as one
    file, in which points lie sorted along the street's grid.
    """
    whole = np.concatenate([*points.values(), np.empty((0, 3), np.float32)])
    return {
        "pcd": len(pcd_binary(whole)),
        "laz": _or_why(lambda: len(laz(whole))),
        "draco": _or_why(lambda: sum(len(draco(one)) for one in points.values() if len(one))),
    }


def laz(points_m: F32) -> bytes:
    """A LAZ file of points (N, 3), coordinates in steps of 1 cm (laspy with lazrs, point format 0).

    Raises:
        ReproduceError: the libraries are not installed.
    """
    laspy = _library("laspy")
    _library("lazrs")
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales, header.offsets = np.full(3, LAZ_STEP_M), np.zeros(3)
    file = laspy.LasData(header)
    file.x, file.y, file.z = points_m.astype(np.float64).T
    out = io.BytesIO()
    file.write(out, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)
    return out.getvalue()


def draco(points_m: F32) -> bytes:
    """A Draco point cloud of points (N, 3), 12 bits a coordinate, highest compression, order not kept.

    Raises:
        ReproduceError: the library is not installed.
    """
    body: bytes = _library("DracoPy").encode(
        points_m, quantization_bits=DRACO_BITS, compression_level=10, preserve_order=False
    )
    return body


def _or_why(write: Callable[[], int]) -> Written:
    try:
        return write()
    except ReproduceError as error:
        return str(error)


def _library(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise ReproduceError(f"needs {name}: pip install 'gnd-fleet[peers]'") from error
