"""A map for Autoware: point clouds in cells of 20 m, their metadata, and the projection.

    FOLDER/pointcloud_map.pcd/40_-20_3f9c01ab77de.pcd   x, y, z as float32
    FOLDER/pointcloud_map_metadata.yaml                  the south-west corner of each, whole metres
    FOLDER/map_projector_info.yaml

Autoware's loaders and its NDT localiser know a cell by its file's name and fetch no name twice, so the name ends in the
hash of the content. An export into the same folder keeps its projection and the files that are still right; the
metadata is replaced at one instant, and what it no longer names is removed afterwards. Source: README of
autoware_map_loader (autoware_core), which asks for cells of about 20 m.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from gnd.deploy.map_export.projection import Projection, ProjectionError, projection_for, projection_in
from gnd.deploy.map_export.sampling import PointsOf, points_of_tile
from gnd.gnd_map.arrays import F32, F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.tile_store.export import ExportError, region_frame, region_tiles, write_whole
from gnd.tile_store.store import Store

CELL_M: Final = 20
CLOUDS: Final = "pointcloud_map.pcd"
"""The folder of the cells; Autoware's launch files look for this name."""
METADATA: Final = "pointcloud_map_metadata.yaml"
PROJECTOR: Final = "map_projector_info.yaml"
_OURS: Final = re.compile(r"(-?\d+)_(-?\d+)_[0-9a-f]{12}\.pcd")
_ENTRY: Final = re.compile(r"(\S+\.pcd): \[(-?\d+), (-?\d+)\]")


@dataclass(frozen=True, slots=True)
class AutowareExport:
    """What was written.

    Attributes:
        folder: where.
        projector: name of the projection.
        lat_deg: its origin; of MGRS the middle of the map.
        lon_deg: the same.
        scale: its scale.
        square: of MGRS the grid square.
        gaussians: how many the map holds.
        points: how many points stand for them.
        written: cells whose content is new.
        kept: cells that were there with the same content.
        removed: cells of exports before that are gone.
        size_bytes: of all cells.
    """

    folder: Path
    projector: str
    lat_deg: float
    lon_deg: float
    scale: float
    square: str
    gaussians: int
    points: int
    written: int
    kept: int
    removed: int
    size_bytes: int


def export_autoware(
    store: Store,
    layer: str,
    prefix: str,
    folder: Path,
    *,
    projector: str | None = None,
    points: PointsOf = "samples",
) -> AutowareExport:
    """Write the newest tiles of a region as a map that Autoware loads, or bring such a map up to date.

    Args:
        store: where the tiles are.
        layer: such as "ndt".
        prefix: leading chunks of a tile's path; "" = all.
        folder: the folder of the map; it is made when missing.
        projector: of `PROJECTORS`; None: that of the export before, else TransverseMercator.
        points: what stands for a Gaussian.

    Raises:
        ExportError: no tiles, the folder holds a map of another program, or it cannot be written.
        ProjectionError: the region is too large for the projection, or the one before differs.
    """
    tiles = region_tiles(store, layer, prefix)
    try:
        _entries(folder)  # refuses a folder of another program
        projection = _projection(tiles, folder, projector)
        cells = {_name(corner, cloud): (corner, cloud) for corner, cloud in _cells(tiles, projection, points)}
        (folder / CLOUDS).mkdir(parents=True, exist_ok=True)
        _write(folder / PROJECTOR, projection.yaml().encode())
        kept = {name for name in cells if (folder / CLOUDS / name).is_file()}
        for name in cells.keys() - kept:
            _write(folder / CLOUDS / name, _pcd(cells[name][1]))
        lines = [f"x_resolution: {CELL_M}.0", f"y_resolution: {CELL_M}.0"]
        lines += [f"{name}: [{corner[0]}, {corner[1]}]" for name, (corner, _) in sorted(cells.items())]
        _write(folder / METADATA, "\n".join((*lines, "")).encode())
        # those of an export that was interrupted, too
        gone = {path.name for path in (folder / CLOUDS).iterdir() if _OURS.fullmatch(path.name)} - cells.keys()
        for name in gone:
            (folder / CLOUDS / name).unlink()
        size_bytes = sum((folder / CLOUDS / name).stat().st_size for name in cells)
    except OSError as error:
        raise ExportError(f"{folder}: cannot write: {error.strerror or error}") from error
    return AutowareExport(
        folder=folder,
        projector=projection.projector,
        lat_deg=projection.lat_deg,
        lon_deg=projection.lon_deg,
        scale=projection.scale,
        square=projection.square,
        gaussians=sum(len(tile.gaussians) for tile in tiles),
        points=sum(len(cloud) for _, cloud in cells.values()),
        written=len(cells) - len(kept),
        kept=len(kept),
        removed=len(gone),
        size_bytes=size_bytes,
    )


def map_points(tile: Tile, projection: Projection, points: PointsOf) -> F64:
    """(N, 3) points of a tile in the frame of an exported map: x and y projected, z the ellipsoidal height, m."""
    lat, lon, height = LocalFrame.of_tile(tile.tile_id).geodetic_from_enu(points_of_tile(tile, points))
    return np.stack([*projection.forward(lat, lon), height], axis=1)


def read_metadata(folder: Path) -> dict[str, tuple[int, int]]:
    """The south-west corner, m, of each cell of an export by its file's name; ExportError: there is none."""
    entries = _entries(folder)
    if not entries:
        raise ExportError(f"{folder}: no {METADATA} of an exported map; `gnd map export STORE FOLDER --to autoware`")
    return entries


def _entries(folder: Path) -> dict[str, tuple[int, int]]:
    path = folder / METADATA
    if not path.is_file():
        if folder.exists() and any(folder.iterdir()) and not (folder / PROJECTOR).is_file():
            raise ExportError(f"{folder} is not empty, and holds no map that was exported before")
        return {}
    text = path.read_text()
    entries = {match[1]: (int(match[2]), int(match[3])) for match in _ENTRY.finditer(text)}
    foreign = [name for name in entries if not _OURS.fullmatch(name)]
    if foreign or text.count(".pcd") != len(entries):
        raise ExportError(f"{path} names files of another program ({', '.join(foreign[:3])}): give an empty folder")
    return entries


def _projection(tiles: list[Tile], folder: Path, projector: str | None) -> Projection:
    """That of the export before, where there is one; else one whose origin is the middle of the tiles."""
    path = folder / PROJECTOR
    text = path.read_text() if path.is_file() else None
    made = projection_in(text) if text is not None else None
    if made is None or projector not in (None, made.projector):
        middle = region_frame(tiles)
        lat_deg, lon_deg = float(np.degrees(middle.lat_rad)), float(np.degrees(middle.lon_rad))
        fallback = "TransverseMercator" if text is None else "MGRS"
        made = projection_for(projector or fallback, lat_deg, lon_deg, _ground_m(tiles))
    if text is not None and text != made.yaml():
        name = f"{made.projector} {made.square}".strip()
        raise ProjectionError(
            f"{path} says another projection than {name} with heights above the ellipsoid, or says it in other words: "
            "give an empty folder"
        )
    return made


def _ground_m(tiles: list[Tile]) -> float:
    """The median height of the Gaussians' floors."""
    floors = [VoxelGrid.of(tile.tile_id).unravel(tile.gaussians.voxel_id)[2] for tile in tiles]
    heights = np.concatenate(floors)
    return float(np.median(heights)) if len(heights) else 0.0


def _cells(tiles: list[Tile], projection: Projection, points: PointsOf) -> Iterator[tuple[tuple[int, int], F32]]:
    """South-west corner and points of each cell. The order within is that of tiles and voxels: the same each time."""
    clouds = [map_points(tile, projection, points) for tile in tiles]
    cloud = np.concatenate(clouds).astype(np.float32)
    index = np.floor(cloud[:, :2].astype(np.float64) / CELL_M).astype(np.int64)
    corners, cell = np.unique(index, axis=0, return_inverse=True)
    order = np.argsort(cell.ravel(), kind="stable")
    for corner, rows in zip(corners, _parts(order, cell.ravel(), len(corners)), strict=True):
        yield (int(corner[0]) * CELL_M, int(corner[1]) * CELL_M), cloud[rows]


def _parts(order: npt.NDArray[np.int64], cell: npt.NDArray[np.int64], n: int) -> list[npt.NDArray[np.int64]]:
    return np.split(order, np.searchsorted(cell[order], np.arange(1, n))) if n else []


def _name(corner: tuple[int, int], cloud: F32) -> str:
    return f"{corner[0]}_{corner[1]}_{sha256(cloud.tobytes()).hexdigest()[:12]}.pcd"


def _pcd(cloud: F32) -> bytes:
    head = (
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS x y z",
        "SIZE 4 4 4",
        "TYPE F F F",
        "COUNT 1 1 1",
        f"WIDTH {len(cloud)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(cloud)}",
        "DATA binary",
        "",
    )
    return "\n".join(head).encode() + cloud.tobytes()


def _write(path: Path, data: bytes) -> None:
    write_whole(path, lambda stream: stream.write(data))
