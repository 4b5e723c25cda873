"""A map for other programs: Gaussians as points (PCD, PLY), tiles as polygons (GeoJSON).

Points lie in one ENU frame at the middle of the exported region, on the ellipsoid; its position is in a comment of the
file. Covariances are turned into the same frame.
"""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.day import UNKNOWN_DAY, ns_of
from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.gaussian import six_entries
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.tile_store.errors import StoreError
from gnd.tile_store.store import Store

POINT_TYPE: Final = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z")),
        *((f"cov_{name}", "<f4") for name in ("xx", "xy", "xz", "yy", "yz", "zz")),
        ("count", "<u4"),
        ("cells", "<u4"),
        ("voxel_id", "<i4"),
        ("tile_high", "<u4"),
        ("tile_low", "<u4"),
        ("day", "<i4"),
    ]
)
"""One exported Gaussian: mean [m], covariance [m^2], points, occupied sub-cells, voxel id, Morton code of the tile, and
when the world was last seen so: days since 1970-01-01 UTC, 0: unknown.
"""

Points = npt.NDArray[np.void]
_NS_PER_DAY: Final = 86_400_000_000_000


class ExportError(StoreError):
    """A map that cannot be exported: no tiles, unknown format, no place to write."""


@dataclass(frozen=True, slots=True)
class TilesExported:
    """What was written."""

    path: Path
    tiles: int
    gaussians: int
    size_bytes: int


def export_map(store: Store, layer: str, prefix: str, path: Path | str, format: str | None = None) -> TilesExported:  # noqa: A002
    """Write the newest tiles of a region; the file appears whole or not at all.

    Args:
        store: where the tiles are.
        layer: such as "ndt".
        prefix: leading chunks of a tile's path; "" = all.
        path: the file.
        format: "pcd", "ply" or "geojson"; None = by the file's ending.

    Raises:
        ExportError: no tiles there, an unknown format, or the file cannot be written.
    """
    target = Path(path)
    name = (format or target.suffix.removeprefix(".")).lower()
    if name not in FORMATS:
        raise ExportError(f"unknown export format {name!r}; known are {', '.join(FORMATS)}")
    tiles = region_tiles(store, layer, prefix)
    write_whole(target, lambda stream: FORMATS[name](stream, tiles))
    return TilesExported(target, len(tiles), sum(len(tile.gaussians) for tile in tiles), target.stat().st_size)


def region_tiles(store: Store, layer: str, prefix: str) -> list[Tile]:
    """The newest version of every tile of a region of Gaussians, hashes checked.

    Raises:
        ExportError: there is none, or the layer holds features.
    """
    entries = store.heads(layer, prefix)
    if not entries:
        raise ExportError(f"no tiles in layer {layer!r}, region {prefix or 'everywhere'!r}")
    if is_feature_layer(layer):
        raise ExportError(
            f"the {len(entries)} tiles of layer {layer!r} hold features, not Gaussians: use `gnd features export`"
        )
    stored = (store.get(layer, entry.tile, entry.version) for entry in entries)
    return [tile.decode_gaussians() for tile in stored if tile is not None]


def region_frame(tiles: list[Tile]) -> LocalFrame:
    """The ENU frame in the middle of the tiles' bounding box, on the ellipsoid."""
    corners = np.array([(*tile.tile_id.south_west_rad, *tile.tile_id.north_east_rad) for tile in tiles])
    turn = 2.0 * np.pi
    corners[:, 1::2] -= turn * np.round((corners[:, 1::2] - corners[0, 1]) / turn)  # a map across 180 degrees is one
    south, west = corners[:, :2].min(axis=0)
    north, east = corners[:, 2:].max(axis=0)
    lon_rad = (west + east) / 2
    return LocalFrame(float(south + north) / 2, float(lon_rad - turn * np.round(lon_rad / turn)), 0.0)


def points_of(tile: Tile, frame: LocalFrame) -> Points:
    """The tile's Gaussians as `POINT_TYPE` (N,), means and covariances in `frame`."""
    gaussians, own = tile.gaussians, LocalFrame.of_tile(tile.tile_id)
    T_frame_tile = frame.T_self_other(own)
    mean_tile_m = VoxelGrid.of(tile.tile_id).centre_m(gaussians.voxel_id) + gaussians.mean_m
    R = T_frame_tile[:3, :3]
    points = np.zeros(len(gaussians), POINT_TYPE)
    for name, column in zip("xyz", (mean_tile_m @ R.T + T_frame_tile[:3, 3]).T, strict=True):
        points[name] = column
    for name, column in zip(POINT_TYPE.names[3:9], six_entries(R @ gaussians.full_cov() @ R.T).T, strict=True):  # type: ignore[index]
        points[name] = column
    points["day"] = 0 if tile.day == UNKNOWN_DAY else ns_of(tile.day) // _NS_PER_DAY
    points["count"], points["cells"], points["voxel_id"] = gaussians.count, gaussians.cells, gaussians.voxel_id
    points["tile_high"], points["tile_low"] = divmod(tile.tile_id.morton, 2**32)
    return points


def _write_pcd(stream: IO[bytes], tiles: list[Tile]) -> None:
    frame = region_frame(tiles)
    points = np.concatenate([points_of(tile, frame) for tile in tiles])
    kinds = {"f": "F", "u": "U", "i": "I"}
    lines = (
        "# .PCD v0.7 - Point Cloud Data file format",
        f"# GND map: {_frame_comment(frame)}",
        "VERSION 0.7",
        f"FIELDS {' '.join(name for name, _ in _columns())}",
        f"SIZE {' '.join('4' for _ in _columns())}",
        f"TYPE {' '.join(kinds[kind] for _, kind in _columns())}",
        f"COUNT {' '.join('1' for _ in _columns())}",
        f"WIDTH {len(points)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(points)}",
        "DATA binary",
    )
    stream.write("\n".join((*lines, "")).encode())
    stream.write(points.tobytes())


def _write_ply(stream: IO[bytes], tiles: list[Tile]) -> None:
    frame = region_frame(tiles)
    points = np.concatenate([points_of(tile, frame) for tile in tiles])
    kinds = {"f": "float", "u": "uint", "i": "int"}
    lines = (
        "ply",
        "format binary_little_endian 1.0",
        f"comment GND map: {_frame_comment(frame)}",
        f"element vertex {len(points)}",
        *(f"property {kinds[kind]} {name}" for name, kind in _columns()),
        "end_header",
    )
    stream.write("\n".join((*lines, "")).encode())
    stream.write(points.tobytes())


def _columns() -> Iterator[tuple[str, str]]:
    """Name and numpy kind of each field."""
    return ((name, POINT_TYPE[name].kind) for name in POINT_TYPE.names or ())


def _frame_comment(frame: LocalFrame) -> str:
    lat, lon = np.degrees(frame.lat_rad), np.degrees(frame.lon_rad)
    return (
        f"metres in the ENU frame at latitude {lat:.9f} deg, longitude {lon:.9f} deg, ellipsoidal height 0 m (WGS-84)"
    )


def _write_geojson(stream: IO[bytes], tiles: list[Tile]) -> None:
    collection = {"type": "FeatureCollection", "features": [_feature(tile) for tile in tiles]}
    stream.write(json.dumps(collection).encode())


def _feature(tile: Tile) -> dict[str, Any]:
    """One tile as a polygon, counter-clockwise, longitude before latitude in degrees (RFC 7946)."""
    south, west = np.degrees(tile.tile_id.south_west_rad).tolist()
    north, east = np.degrees(tile.tile_id.north_east_rad).tolist()
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    return {
        "type": "Feature",
        "geometry": {"type": "Polygon", "coordinates": [ring]},
        "properties": _properties(tile),
    }


def _properties(tile: Tile) -> dict[str, Any]:
    _, _, floor = VoxelGrid.of(tile.tile_id).unravel(tile.gaussians.voxel_id)
    return {
        "tile": tile.tile_id.path,
        "morton": tile.tile_id.morton,
        "version": tile.version,
        "sha": tile.sha.hex(),
        "gaussians": len(tile.gaussians),
        "points": int(tile.gaussians.count.sum(dtype=np.int64)),
        "lowest_m": int(floor.min()) if len(floor) else None,
        "highest_m": int(floor.max()) + 1 if len(floor) else None,
    }


FORMATS: Final[Mapping[str, Callable[[IO[bytes], list[Tile]], None]]] = {
    "pcd": _write_pcd,
    "ply": _write_ply,
    "geojson": _write_geojson,
}


def write_whole(target: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Write beside the target and rename at the end, so that no half file ever has its name."""
    partial = target.with_name(f".{target.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as stream:
            write(stream)
        partial.replace(target)
    except OSError as error:
        raise ExportError(f"{target}: cannot write: {error.strerror or error}") from error
    finally:
        partial.unlink(missing_ok=True)
