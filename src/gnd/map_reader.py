"""A map's file, to read: tiles, Gaussians and features of a region as they are or were, history and differences."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, Self

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import F64, I32, I64
from gnd.gnd_map.content import AnyTile
from gnd.gnd_map.day import UNKNOWN_DAY
from gnd.gnd_map.day import ns_of as ns_of_day
from gnd.gnd_map.features import Feature
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.region import Region, as_region
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.arguments import parse_tile, parse_time_ns
from gnd.tile_store.compare import MapDiff, map_diff, version_diff
from gnd.tile_store.errors import UnknownVersion
from gnd.tile_store.sqlite_store import SqliteStore, SqlStore
from gnd.tile_store.values import DEFAULT_LAYER, StoredTile, VersionInfo

AnyRegion = Region | TileId | str | None
AnyTileId = TileId | str | int
AnyTime = datetime | str | int
"""UTC: a datetime (without a zone it is UTC), text like 2026-01-31T12:00:00Z, or ns since 1970."""

DEFAULT_FEATURES: Final = "signs"
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True, eq=False)
class GaussianColumns:
    """The Gaussians of a region as columns: row i of each is one voxel's.

    Attributes:
        frame: the frame of `mean_m` and `cov_m2`: east, north, up in metres, with its origin on the ellipsoid.
        mean_m: (N, 3) float64 means in `frame`, m.
        cov_m2: (N, 3, 3) float64 covariances of a voxel's points along the axes of `frame`, m².
        lat_deg: (N,) float64 WGS-84 latitudes of the means, degrees.
        lon_deg: (N,) float64 longitudes, degrees.
        height_m: (N,) float64 heights above the ellipsoid, m.
        count: (N,) int32 points that the Gaussian was made of; of published tiles within a factor of two (*compact*:
            of three).
        cells: (N,) int32 how many 10 cm cells of the voxel hold points: its support.
        day: (N,) datetime64[D] when the world was last seen so (of the tile's version); NaT where nobody knows.
        reports: (N,) int32 how many reports of vehicles the tile's version was made of; 0: it was built of a survey.
        tile: (N,) int64 Morton number of the tile: `TileId(int(tile[i]))`.
        voxel_id: (N,) int32 which voxel of the tile.
        version: (N,) int32 version of the tile.
    """

    frame: LocalFrame
    mean_m: F64
    cov_m2: F64
    lat_deg: F64
    lon_deg: F64
    height_m: F64
    count: I32
    cells: I32
    day: npt.NDArray[np.datetime64]
    reports: I32
    tile: I64
    voxel_id: I32
    version: I32

    def __len__(self) -> int:
        return len(self.count)


@dataclass(frozen=True, slots=True, eq=False)
class PlacedFeature:
    """A feature (of a polyline: its piece in one tile) and where it is on the Earth.

    Attributes:
        feature: kind, attributes, existence, covariance; its points are in its tile's frame.
        tile: the tile that holds it.
        version: that tile's version.
        lat_deg: (P,) float64 WGS-84 latitudes of its points, degrees; a point has one.
        lon_deg: (P,) float64 longitudes, degrees.
        height_m: (P,) float64 heights above the ellipsoid, m.
    """

    feature: Feature
    tile: TileId
    version: int
    lat_deg: F64
    lon_deg: F64
    height_m: F64


class Map:
    """A map in a file (a tile store), to read; it may lie in a folder that is read-only, and be in use by a fleet.

    Use it in a `with` block. Regions are those of `gnd.connect(...).tiles`; tiles are named by a `TileId`, its path,
    its number or "lat,lon" in degrees; times are UTC: a datetime, text like "2026-01-31T12:00:00Z", or ns since 1970.
    Layers whose names begin with ndt hold Gaussians, all others features.

    Args:
        path: the file.

    Raises:
        StoreUnavailable: no such file, no permission, or no map.
    """

    def __init__(self, path: str | Path) -> None:
        self._store = SqliteStore(path, create=False, read_only=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file. May be called again."""
        self._store.close()

    @property
    def store(self) -> SqlStore:
        """The store behind it, for what this class does not do."""
        return self._store

    @property
    def layers(self) -> tuple[str, ...]:
        """The layers that hold tiles."""
        return tuple(self._store.layers())

    def tile_ids(self, region: AnyRegion = None, *, layer: str = DEFAULT_LAYER) -> list[TileId]:
        """The tiles that a region has or had, by number; no content is read.

        Raises:
            RegionError: `region` is none.
        """
        chosen = as_region(region)
        return [entry.tile for entry in self._store.heads(layer, chosen.prefix) if entry.tile in chosen]

    def tile(
        self, tile: AnyTileId, *, version: int | None = None, at: AnyTime | None = None, layer: str = DEFAULT_LAYER
    ) -> AnyTile:
        """One tile: its newest version, the one named, or the newest at a time.

        Raises:
            UnknownVersion: there is none, or retention has removed it.
            StoreError: `tile` names none, `at` is no time, or the file cannot be read.
            WrongHash: the content is damaged.
        """
        return self._stored(_tile_id(tile), layer, version, time_ns(at)).decode()

    def tiles(
        self, region: AnyRegion = None, *, at: AnyTime | None = None, layer: str = DEFAULT_LAYER
    ) -> Iterator[AnyTile]:
        """The tiles of a region as they are, or as they were at a time, by number: `Tile` or `FeatureTile`.

        Raises:
            RegionError, StoreError, WrongHash: as `tile`.
        """
        return (stored.decode() for stored in self._of_region(as_region(region), layer, time_ns(at)))

    def gaussians(
        self,
        region: AnyRegion = None,
        *,
        at: AnyTime | None = None,
        frame: LocalFrame | None = None,
        layer: str = DEFAULT_LAYER,
    ) -> GaussianColumns:
        """The Gaussians of a region's tiles as numpy columns.

        Args:
            region: which tiles; a circle gives all tiles that it touches, whole.
            at: as the map was then.
            frame: of means and covariances; None: that of the first tile (ENU at its centre on the ellipsoid). Far from
                its origin its plane leaves the ground: by 8 m at 10 km.
            layer: a layer of Gaussians.

        Raises:
            RegionError, StoreError, WrongHash: as `tile`.
            BadValue: the layer holds features.
        """
        stored = list(self._of_region(as_region(region), layer, time_ns(at)))
        frame = frame or LocalFrame.of_tile(stored[0].tile if stored else TileId(0))
        return _joined(frame, [_columns(one, frame) for one in stored])

    def features(
        self, region: AnyRegion = None, *, at: AnyTime | None = None, layer: str = DEFAULT_FEATURES
    ) -> list[PlacedFeature]:
        """The features of a region's tiles, tile by tile.

        Raises:
            RegionError, StoreError, WrongHash: as `tile`.
            BadValue: the layer holds Gaussians.
        """
        stored = self._of_region(as_region(region), layer, time_ns(at))
        return [_placed(feature, one) for one in stored for feature in one.decode_features().features]

    def history(self, tile: AnyTileId, *, layer: str = DEFAULT_LAYER) -> list[VersionInfo]:
        """The versions of a tile that retention has left, oldest first; times are `created_ns`, ns UTC."""
        return self._store.history(layer, _tile_id(tile))

    def diff(
        self,
        before: int | AnyTime | None,
        after: int | AnyTime | None = None,
        *,
        tile: AnyTileId | None = None,
        region: AnyRegion = None,
        layer: str = DEFAULT_LAYER,
    ) -> MapDiff:
        """What differs between two versions of a tile, or between two times of a region.

        Args:
            before: with `tile` a version; else a time, None: the newest versions.
            after: likewise; None: the newest.
            tile: two versions of this tile are compared.
            region: without `tile`: the tiles that are compared.
            layer: name of the layer.

        Raises:
            UnknownVersion: the tile has no such version.
            RegionError, StoreError, WrongHash: as `tile`.
        """
        if tile is None:
            chosen = as_region(region)
            return map_diff(
                self._store,
                self._store,
                layer=layer,
                prefix=chosen.prefix,
                old_at_ns=time_ns(before),
                new_at_ns=time_ns(after),
                only=chosen.tiles,
            )
        tile_id = _tile_id(tile)
        newest = self._stored(tile_id, layer, None, None).version
        old, new = (_version(value, newest) for value in (before, after))
        return version_diff(self._store, layer, tile_id, old, new)

    def _stored(self, tile: TileId, layer: str, version: int | None, at_ns: int | None) -> StoredTile:
        stored = self._store.get(layer, tile, version, at_ns)
        if stored is None:
            which = f"version {version}" if version is not None else "tile" if at_ns is None else "version then"
            raise UnknownVersion(f"{self._store.location}, layer {layer}, tile {tile}: there is no such {which}")
        return stored

    def _of_region(self, region: Region, layer: str, at_ns: int | None) -> Iterator[StoredTile]:
        for entry in self._store.heads(layer, region.prefix):
            if entry.tile in region:
                stored = self._store.get(layer, entry.tile, at_ns=at_ns)
                if stored is not None:
                    yield stored


def time_ns(at: AnyTime | None) -> int | None:
    """A time as users give it as ns UTC.

    Raises:
        StoreError: a text that is no time.
    """
    if isinstance(at, str):
        return parse_time_ns(at)
    if isinstance(at, datetime):
        since = (at if at.tzinfo else at.replace(tzinfo=UTC)) - _EPOCH
        return ((since.days * 86_400 + since.seconds) * 1_000_000 + since.microseconds) * 1_000
    return at


def _tile_id(tile: AnyTileId) -> TileId:
    return tile if isinstance(tile, TileId) else parse_tile(str(tile))


def _version(value: int | AnyTime | None, newest: int) -> int:
    if value is None:
        return newest
    if not isinstance(value, int):
        raise UnknownVersion(f"{value!r} is no version of a tile; without `tile` two times of a region are compared")
    return value


def _columns(stored: StoredTile, frame: LocalFrame) -> tuple[npt.NDArray[np.generic], ...]:
    """The columns of `GaussianColumns` of one tile, behind its frame."""
    gaussians, grid = stored.decode_gaussians().gaussians, VoxelGrid.of(stored.tile)
    n, T = len(gaussians), frame.T_self_other(grid.frame)
    in_tile_m = grid.centre_m(gaussians.voxel_id) + gaussians.mean_m
    lat_rad, lon_rad, height_m = grid.frame.geodetic_from_enu(in_tile_m)
    return (
        in_tile_m @ T[:3, :3].T + T[:3, 3],
        T[:3, :3] @ gaussians.full_cov() @ T[:3, :3].T,
        np.degrees(lat_rad),
        np.degrees(lon_rad),
        height_m,
        gaussians.count,
        gaussians.cells,
        np.full(n, _date_of(stored.day)),
        np.full(n, stored.n_reports, np.int32),
        np.full(n, stored.tile.morton, np.int64),
        gaussians.voxel_id,
        np.full(n, stored.version, np.int32),
    )


def _date_of(day: int) -> np.datetime64:
    if day == UNKNOWN_DAY:
        return np.datetime64("NaT", "D")
    return np.datetime64(ns_of_day(day) // 86_400_000_000_000, "D")


def _joined(frame: LocalFrame, parts: Sequence[tuple[npt.NDArray[np.generic], ...]]) -> GaussianColumns:
    shapes: tuple[tuple[int, ...], ...] = ((0, 3), (0, 3, 3), *((0,),) * 10)
    kinds = (*("f8",) * 5, "i4", "i4", "M8[D]", "i4", "i8", "i4", "i4")
    empty = tuple(np.empty(shape, kind) for shape, kind in zip(shapes, kinds, strict=True))
    columns = [np.concatenate(column) for column in zip(empty, *parts, strict=True)]
    return GaussianColumns(frame, *columns)


def _placed(feature: Feature, stored: StoredTile) -> PlacedFeature:
    lat_rad, lon_rad, height_m = LocalFrame.of_tile(stored.tile).geodetic_from_enu(feature.points_m)
    return PlacedFeature(
        feature, stored.tile, stored.version, np.degrees(lat_rad), np.degrees(lon_rad), np.asarray(height_m)
    )
