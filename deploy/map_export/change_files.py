"""Changes as files for a GIS: GeoJSON (RFC 7946) and GeoPackage (OGC 12-128r18, version 1.3), without a library."""

import json
import sqlite3
import struct
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import IO, Any, Final

import numpy as np

from gnd.deploy.map_export.changes import Change
from gnd.tile_store.errors import StoreError
from gnd.tile_store.export import write_whole

_WGS84: Final = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563,AUTHORITY["EPSG","7030"]],'
    'AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],UNIT["degree",0.0174532925199433,'
    'AUTHORITY["EPSG","9122"]],AUTHORITY["EPSG","4326"]]'
)
_APPLICATION_ID: Final = 0x47504B47  # "GPKG"
_VERSION: Final = 10300
_SRS: Final = 4326
_COLUMNS: Final = {
    "change": "TEXT", "shape": "TEXT", "lat_deg": "DOUBLE", "lon_deg": "DOUBLE", "height_m": "DOUBLE",
    "length_m": "DOUBLE", "width_m": "DOUBLE", "tall_m": "DOUBLE", "bearing_deg": "DOUBLE", "voxels": "INTEGER",
    "points": "INTEGER", "first_seen": "DATETIME", "last_seen": "DATETIME", "vehicles": "INTEGER",
    "reports": "INTEGER", "confidence": "DOUBLE", "tiles": "TEXT",
}  # fmt: skip
_TABLES: Final = f"""
CREATE TABLE gpkg_spatial_ref_sys (
  srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (
  table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE, description TEXT DEFAULT '',
  last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')), min_x DOUBLE, min_y DOUBLE,
  max_x DOUBLE, max_y DOUBLE, srs_id INTEGER,
  CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (
  table_name TEXT NOT NULL, column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL,
  z TINYINT NOT NULL, m TINYINT NOT NULL,
  CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name), CONSTRAINT uk_gc_table_name UNIQUE (table_name),
  CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
  CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
CREATE TABLE changes (
  fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom POLYGON,
  {", ".join(f"{name} {kind}" for name, kind in _COLUMNS.items())});
"""


def write_changes(changes: tuple[Change, ...], path: Path) -> None:
    """Write changes as the file's ending says, .geojson or .gpkg; the file appears whole or not at all.

    Raises:
        StoreError: another ending, or the file cannot be written.
    """
    try:
        write = WRITERS[path.suffix.lower()]
    except KeyError:
        raise StoreError(f"{path}: changes go to {' or '.join(WRITERS)}") from None
    write_whole(path, lambda stream: write(stream, changes))


def _geojson(stream: IO[bytes], changes: tuple[Change, ...]) -> None:
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Polygon", "coordinates": [np.round(change.outline_deg, 8).tolist()]},
            "properties": change.as_dict(),
        }
        for change in changes
    ]
    stream.write(json.dumps({"type": "FeatureCollection", "features": features}, indent=1).encode())


def _geopackage(stream: IO[bytes], changes: tuple[Change, ...]) -> None:
    with closing(sqlite3.connect(":memory:")) as base:
        base.executescript(f"PRAGMA application_id = {_APPLICATION_ID}; PRAGMA user_version = {_VERSION};{_TABLES}")
        base.executemany(
            "INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)",
            [
                ("WGS 84", _SRS, "EPSG", _SRS, _WGS84, "longitude, latitude"),
                ("Undefined cartesian SRS", -1, "NONE", -1, "undefined", None),
                ("Undefined geographic SRS", 0, "NONE", 0, "undefined", None),
            ],
        )
        outlines = [change.outline_deg for change in changes]
        bounds = _bounds(np.concatenate(outlines)) if outlines else (None,) * 4
        base.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier, description, min_x, min_y, max_x, max_y,"
            " srs_id) VALUES ('changes', 'features', 'changes', 'What differs between two states of a map', ?, ?, ?, ?,"
            " ?)",
            (*bounds, _SRS),
        )
        base.execute("INSERT INTO gpkg_geometry_columns VALUES ('changes', 'geom', 'POLYGON', ?, 0, 0)", (_SRS,))
        names = ", ".join(_COLUMNS)
        base.executemany(
            f"INSERT INTO changes (geom, {names}) VALUES (?{', ?' * len(_COLUMNS)})",  # noqa: S608  (constants)
            [(_geometry(change.outline_deg), *_row(change.as_dict())) for change in changes],
        )
        base.commit()
        stream.write(base.serialize())


def _row(values: dict[str, Any]) -> tuple[Any, ...]:
    """The columns; times with milliseconds, as the standard writes them."""
    return tuple(
        values[name][:-1] + ".000Z" if kind == "DATETIME" and values[name] else values[name]
        for name, kind in _COLUMNS.items()
    )


def _bounds(points: "np.ndarray[Any, Any]") -> tuple[float, ...]:
    """West, south, east, north."""
    return (*points.min(axis=0).tolist(), *points.max(axis=0).tolist())


def _geometry(ring: "np.ndarray[Any, Any]") -> bytes:
    """A polygon as GeoPackage binary: header with envelope (2.1.3), little-endian WKB."""
    west, south, east, north = _bounds(ring)
    head = b"GP" + struct.pack("<BBi4d", 0, 0b0000_0011, _SRS, west, east, south, north)
    return head + struct.pack("<BIII", 1, 3, 1, len(ring)) + ring.astype("<f8").tobytes()


WRITERS: Final[Mapping[str, Callable[[IO[bytes], tuple[Change, ...]], None]]] = {
    ".gpkg": _geopackage,
    ".geojson": _geojson,
}
