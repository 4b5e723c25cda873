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
from collections.abc import Mapping, Sequence
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
_POINT_BYTES: Final = 12
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


@dataclass(frozen=True, slots=True, eq=False)
class CloudCell:
    """One cell of a map.

    Attributes:
        corner: x and y of its south-west corner, m.
        cloud: (N, 3) its points.
    """

    corner: tuple[int, int]
    cloud: F32


@dataclass(frozen=True, slots=True)
class ChangedCells:
    """How many cells of a folder were written, and how many removed."""

    written: int
    removed: int


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
    projection = projection_of(tiles, folder, projector)
    cells = cells_of(tiles, projection, points)
    changed = write_cells(folder, projection, {name: cell.corner for name, cell in cells.items()}, cells)
    size_bytes = sum((folder / CLOUDS / name).stat().st_size for name in cells)
    return AutowareExport(
        folder=folder,
        projector=projection.projector,
        lat_deg=projection.lat_deg,
        lon_deg=projection.lon_deg,
        scale=projection.scale,
        square=projection.square,
        gaussians=sum(len(tile.gaussians) for tile in tiles),
        points=sum(len(cell.cloud) for cell in cells.values()),
        written=changed.written,
        kept=len(cells) - changed.written,
        removed=changed.removed,
        size_bytes=size_bytes,
    )


def map_points(tile: Tile, projection: Projection, points: PointsOf) -> F64:
    """(N, 3) points of a tile in the frame of an exported map: x and y projected, z the ellipsoidal height, m."""
    lat, lon, height = LocalFrame.of_tile(tile.tile_id).geodetic_from_enu(points_of_tile(tile, points))
    return np.stack([*projection.forward(lat, lon), height], axis=1)


def projection_of(tiles: list[Tile], folder: Path, projector: str | None) -> Projection:
    """That of the export before, where there is one; else one whose origin is the middle of the tiles.

    Raises:
        ExportError: the folder holds a map of another program.
        ProjectionError: the export before has another one.
    """
    _entries(folder)
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


def cells_of(tiles: Sequence[Tile], projection: Projection, points: PointsOf) -> dict[str, CloudCell]:
    """The cells of some tiles by their names. The order of points is that of tiles and voxels: the same each time."""
    clouds = [map_points(tile, projection, points) for tile in tiles]
    cloud = np.concatenate([np.zeros((0, 3)), *clouds]).astype(np.float32)
    corners, cell = np.unique(_corners(cloud), axis=0, return_inverse=True)
    order = np.argsort(cell.ravel(), kind="stable")
    parts = _parts(order, cell.ravel(), len(corners))
    made = [CloudCell((int(x), int(y)), cloud[rows]) for (x, y), rows in zip(corners, parts, strict=True)]
    return {_name(one): one for one in made}


def corners_of(tile: Tile, projection: Projection, points: PointsOf) -> frozenset[tuple[int, int]]:
    """The south-west corners, m, of the cells in which a tile has points."""
    cloud = map_points(tile, projection, points).astype(np.float32)
    return frozenset((int(x), int(y)) for x, y in np.unique(_corners(cloud), axis=0))


def write_cells(
    folder: Path, projection: Projection, corners: Mapping[str, tuple[int, int]], cells: Mapping[str, CloudCell]
) -> ChangedCells:
    """Make a folder the map of these cells: files that are there stay, those of other cells go.

    Args:
        folder: it is made when missing.
        projection: of the points.
        corners: the cells by name.
        cells: with the points of those among them whose files may be missing.

    Raises:
        ExportError: it cannot be written; what was there is still there.
    """
    try:
        (folder / CLOUDS).mkdir(parents=True, exist_ok=True)
        _write(folder / PROJECTOR, projection.yaml().encode())
        missing = [name for name in cells if not (folder / CLOUDS / name).is_file()]
        for name in missing:
            _write(folder / CLOUDS / name, _pcd(cells[name].cloud))
        lines = [f"x_resolution: {CELL_M}.0", f"y_resolution: {CELL_M}.0"]
        lines += [f"{name}: [{x}, {y}]" for name, (x, y) in sorted(corners.items())]
        _write(folder / METADATA, "\n".join((*lines, "")).encode())
        # those of an export that was interrupted, too
        gone = {path.name for path in (folder / CLOUDS).iterdir() if _OURS.fullmatch(path.name)} - corners.keys()
        for name in gone:
            (folder / CLOUDS / name).unlink()
    except OSError as error:
        raise ExportError(f"{folder}: cannot write: {error.strerror or error}") from error
    return ChangedCells(len(missing), len(gone))


def place_of(name: str) -> str:
    """What a cell's name says of its place, without its content; of other names a part."""
    return name.rpartition("_")[0]


def read_cell(path: Path) -> F32:
    """(N, 3) the points of a cell's file; ExportError: it cannot be read, or is not what was written."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ExportError(f"{path}: cannot read: {error.strerror or error}") from error
    _, mark, body = data.partition(b"DATA binary\n")
    if not mark or len(body) % _POINT_BYTES or _digest(body) != path.stem.rpartition("_")[2]:
        raise ExportError(
            f"{path}: {len(data)} bytes that are not the cell of this name: export into this folder again"
        )
    return np.frombuffer(body, "<f4").reshape(-1, 3)


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


def _ground_m(tiles: list[Tile]) -> float:
    """The median height of the Gaussians' floors."""
    floors = [VoxelGrid.of(tile.tile_id).unravel(tile.gaussians.voxel_id)[2] for tile in tiles]
    heights = np.concatenate(floors)
    return float(np.median(heights)) if len(heights) else 0.0


def _parts(order: npt.NDArray[np.int64], cell: npt.NDArray[np.int64], n: int) -> list[npt.NDArray[np.int64]]:
    return np.split(order, np.searchsorted(cell[order], np.arange(1, n))) if n else []


def _corners(cloud: F32) -> npt.NDArray[np.int64]:
    return np.asarray(np.floor(cloud[:, :2].astype(np.float64) / CELL_M).astype(np.int64) * CELL_M)


def _name(cell: CloudCell) -> str:
    return f"{cell.corner[0]}_{cell.corner[1]}_{_digest(cell.cloud.tobytes())}.pcd"


def _digest(points: bytes) -> str:
    return sha256(points).hexdigest()[:12]


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
