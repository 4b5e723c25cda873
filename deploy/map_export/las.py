"""A map as LAS or LAZ for surveyors: the means in UTM with ellipsoidal heights, covariances and support beside them.

LAS 1.4, point format 6, millimetres; the coordinate system goes along as WKT (laspy, pyproj: the extra `export`).
"""

from pathlib import Path
from typing import Final

import numpy as np

from gnd.deploy.map_export.libraries import library
from gnd.deploy.map_export.projection import utm_zone
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.utm import SCALE, convergence_rad, utm_from_geodetic
from gnd.tile_store.export import Points, TilesExported, points_of, region_frame, region_tiles, write_whole
from gnd.tile_store.store import Store

_COVARIANCES: Final = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
COLUMNS: Final = {
    **dict.fromkeys(_COVARIANCES, ("f4", "m2, axes east, north, up of the grid")),
    "count": ("u4", "raw points"),
    "cells": ("u4", "occupied 10 cm cells"),
    "day": ("i4", "last seen, days since 1970, 0 unknown"),
    "voxel_id": ("i4", "voxel of the tile"),
    "tile_high": ("u4", "Morton code of the tile"),
    "tile_low": ("u4", "Morton code of the tile"),
}
"""Extra dimensions: type and description (of at most 31 bytes in the file)."""


def export_las(store: Store, layer: str, prefix: str, path: Path, *, compressed: bool = False) -> TilesExported:
    """Write the newest tiles of a region as LAS, or compressed as LAZ.

    Raises:
        ExportError: no tiles there, or the file cannot be written.
        ProjectionError: it lies beyond UTM's latitudes.
        MissingExtra: laspy or pyproj is not installed.
    """
    laspy, pyproj = library("laspy"), library("pyproj")
    tiles = region_tiles(store, layer, prefix)
    frame = region_frame(tiles)
    points = np.concatenate([points_of(tile, frame) for tile in tiles])
    zone = utm_zone(float(np.degrees(frame.lat_rad)), float(np.degrees(frame.lon_rad)))
    southern = frame.lat_rad < 0
    xyz_m = _utm(points, frame, zone, southern)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 0.001)
    header.offsets = np.floor(xyz_m.min(axis=0))
    header.add_crs(pyproj.CRS.from_epsg((32700 if southern else 32600) + zone).to_3d())
    header.add_extra_dims(
        [laspy.ExtraBytesParams(name=name, type=kind, description=text[:31]) for name, (kind, text) in COLUMNS.items()]
    )
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz_m.T
    las.return_number[:] = las.number_of_returns[:] = 1
    covariance = _turned(points, frame, zone)
    for name in COLUMNS:
        las[name] = covariance[name] if name in covariance else points[name]
    write_whole(path, lambda stream: las.write(stream, do_compress=compressed))
    return TilesExported(path, len(tiles), len(points), path.stat().st_size)


def _utm(points: Points, frame: LocalFrame, zone: int, southern: bool) -> F64:
    lat, lon, height = frame.geodetic_from_enu(np.stack([points[name].astype(np.float64) for name in "xyz"], axis=1))
    return np.stack([*utm_from_geodetic(lat, lon, zone, southern=southern), height], axis=1)


def _turned(points: Points, frame: LocalFrame, zone: int) -> dict[str, F64]:
    """The covariances along the axes of the grid, by name."""
    angle = float(convergence_rad(np.array(frame.lat_rad), np.array(frame.lon_rad), zone))
    c, s = SCALE * np.cos(angle), SCALE * np.sin(angle)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])  # grid north lies at bearing `angle`
    full = np.empty((len(points), 3, 3))
    for name in _COVARIANCES:
        i, j = ("xyz".index(letter) for letter in name[-2:])
        full[:, i, j] = full[:, j, i] = points[name]
    turned = R @ full @ R.T
    return {name: turned[:, "xyz".index(name[-2]), "xyz".index(name[-1])] for name in _COVARIANCES}
