"""What a map holds, and how two maps, two times or two versions differ: values that print as tables and as JSON."""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from gnd.gnd_map.codec import codec_of
from gnd.gnd_map.content import FEATURE_CODECS
from gnd.gnd_map.errors import CodecError
from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import diff
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.compare_features import FeatureMapInfo, feature_map_info, feature_tile_diff
from gnd.tile_store.errors import StoreError, UnknownVersion
from gnd.tile_store.regions import bounds_deg
from gnd.tile_store.store import Store
from gnd.tile_store.values import DEFAULT_LAYER, StoredTile


@dataclass(frozen=True, slots=True)
class MapInfo:
    """Totals of a region's newest versions of a layer of Gaussians."""

    layer: str
    prefix: str
    tiles: int
    districts: int
    gaussians: int
    points: int
    """Raw points that the Gaussians stand for; on a lattice within a factor of two each (*compact*: of three)."""
    body_bytes: int
    bytes_a_voxel: float
    """Of the bodies as they lie in the store; 0 without voxels."""
    codecs: dict[str, int]
    """Tiles in each codec, by its name."""
    lowest_version: int
    highest_version: int
    updated_ns: int
    """Time of the newest version, UTC."""
    south_deg: float
    west_deg: float
    north_deg: float
    east_deg: float
    lowest_m: int
    """Floor of the lowest Gaussian, ellipsoidal height."""
    highest_m: int

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class LayerTotals:
    """What is known of a region's newest versions without decoding any."""

    layer: str
    prefix: str
    tiles: int
    districts: int
    body_bytes: int
    codecs: dict[str, int]
    """Tiles in each codec, by its name."""
    lowest_version: int
    highest_version: int
    updated_ns: int
    """Time of the newest version, UTC."""
    south_deg: float
    west_deg: float
    north_deg: float
    east_deg: float

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return asdict(self)


def layer_totals(store: Store, *, layer: str = DEFAULT_LAYER, prefix: str = "") -> LayerTotals:
    """Totals of a region's newest versions of any layer, at once; `StoreError` when there are no tiles."""
    lines = store.head_lines(layer, prefix)
    if not lines:
        raise StoreError(f"no tiles in layer {layer!r}, region {prefix or 'everywhere'!r}")
    south, west, north, east = bounds_deg([one.tile for one in lines])
    return LayerTotals(
        layer=layer,
        prefix=prefix,
        tiles=len(lines),
        districts=len({one.tile.district for one in lines}),
        body_bytes=sum(one.size_bytes for one in lines),
        codecs=dict(Counter(codec_name(one.codec_id) for one in lines)),
        lowest_version=min(one.version for one in lines),
        highest_version=max(one.version for one in lines),
        updated_ns=max(one.created_ns for one in lines),
        south_deg=south,
        west_deg=west,
        north_deg=north,
        east_deg=east,
    )


def codec_name(codec_id: int) -> str:
    """The codec's name, also where this program cannot read it."""
    if codec_id in FEATURE_CODECS:
        return "features"
    try:
        return codec_of(codec_id).name
    except CodecError:
        return f"codec {codec_id}"


def layer_info(store: Store, *, layer: str = DEFAULT_LAYER, prefix: str = "") -> MapInfo | FeatureMapInfo:
    """Totals of a region's newest versions, whatever the layer holds; `StoreError` when there are no tiles."""
    if is_feature_layer(layer):
        return feature_map_info(list(_newest(store, layer, prefix, at_ns=None).values()), layer, prefix)
    return map_info(store, layer=layer, prefix=prefix)


def map_info(store: Store, *, layer: str = DEFAULT_LAYER, prefix: str = "") -> MapInfo:
    """Totals of a region's newest versions of a layer of Gaussians.

    Raises:
        StoreError: no tiles there.
        BadValue: the layer holds features.
    """
    stored = list(_newest(store, layer, prefix, at_ns=None).values())
    if not stored:
        raise StoreError(f"no tiles in layer {layer!r}, region {prefix or 'everywhere'!r}")
    gaussians = [(one.tile, one.decode_gaussians().gaussians) for one in stored]
    body_bytes, n_gaussians = sum(len(one.body) for one in stored), sum(len(g) for _, g in gaussians)
    south, west, north, east = bounds_deg([one.tile for one in stored])
    lowest, highest = _heights_m(gaussians)
    return MapInfo(
        layer=layer,
        prefix=prefix,
        tiles=len(stored),
        districts=len({one.tile.district for one in stored}),
        gaussians=n_gaussians,
        points=sum(int(g.count.sum(dtype=np.int64)) for _, g in gaussians),
        body_bytes=body_bytes,
        bytes_a_voxel=body_bytes / n_gaussians if n_gaussians else 0.0,
        codecs=dict(Counter(codec_of(one.codec_id).name for one in stored)),
        lowest_version=min(one.version for one in stored),
        highest_version=max(one.version for one in stored),
        updated_ns=max(one.created_ns for one in stored),
        south_deg=south,
        west_deg=west,
        north_deg=north,
        east_deg=east,
        lowest_m=lowest,
        highest_m=highest,
    )


def _heights_m(gaussians: Iterable[tuple[TileId, Gaussians]]) -> tuple[int, int]:
    floors = [VoxelGrid.of(tile).unravel(g.voxel_id)[2] for tile, g in gaussians if len(g)]
    return (min(int(f.min()) for f in floors), max(int(f.max()) for f in floors) + 1) if floors else (0, 0)


@dataclass(frozen=True, slots=True)
class TileDiff:
    """How one tile differs between an old and a new state; version 0 = the tile is not there.

    Counted are voxels, of a feature layer pieces of features (a point is one piece).
    """

    tile: str
    """Path."""
    old_version: int
    new_version: int
    new: int
    """Only in the new state."""
    deleted: int
    """Only in the old state."""
    modified: int
    """In both, another one."""
    same: int
    max_shift_m: float
    """Largest move of a changed voxel's mean, or of a changed feature."""


@dataclass(frozen=True, slots=True)
class MapDiff:
    """How two maps differ: the tiles with a difference, and totals over all."""

    layer: str
    prefix: str
    tiles: tuple[TileDiff, ...]
    """Those that differ, in the order of their ids."""
    tiles_same: int
    new: int
    deleted: int
    modified: int
    same: int

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return asdict(self)

    @property
    def noun(self) -> str:
        """What is counted."""
        return "features" if is_feature_layer(self.layer) else "voxels"

    def rows(self) -> Iterator[tuple[str, ...]]:
        """A table: its head, then one row a tile that differs."""
        yield tuple(field.name for field in fields(TileDiff))
        for tile in self.tiles:
            yield tuple(_cell(getattr(tile, field.name)) for field in fields(TileDiff))


def _cell(value: object) -> str:
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def map_diff(
    old: Store,
    new: Store,
    *,
    layer: str = DEFAULT_LAYER,
    prefix: str = "",
    old_at_ns: int | None = None,
    new_at_ns: int | None = None,
    only: Collection[TileId] | None = None,
) -> MapDiff:
    """How a region differs between two stores, or between two times of one store.

    Args:
        old: the store of the old state.
        new: the store of the new state; may be the same one.
        layer: such as "ndt".
        prefix: leading chunks of a tile's path; "" = all.
        old_at_ns: the old state's time, UTC; None = its newest versions.
        new_at_ns: the new state's time, UTC; None = its newest versions.
        only: of the tiles below the prefix these alone; None = all.
    """
    before, after = _newest(old, layer, prefix, old_at_ns, only), _newest(new, layer, prefix, new_at_ns, only)
    both = sorted(before.keys() | after.keys())
    diffs = [tile_diff(tile, before.get(tile), after.get(tile), layer) for tile in both]
    return _map_diff(layer, prefix, diffs)


def version_diff(store: Store, layer: str, tile: TileId, old_version: int, new_version: int) -> MapDiff:
    """How two versions of one tile differ; `UnknownVersion` when one is not there."""
    versions = []
    for version in (old_version, new_version):
        stored = store.get(layer, tile, version)
        if stored is None:
            raise UnknownVersion(f"tile {tile} of layer {layer!r} has no version {version}")
        versions.append(stored)
    return _map_diff(layer, tile.path, [tile_diff(tile, versions[0], versions[1], layer)])


def tile_diff(tile: TileId, old: StoredTile | None, new: StoredTile | None, layer: str = DEFAULT_LAYER) -> TileDiff:
    """How one tile of a layer differs between two states."""
    numbers = (old.version if old else 0, new.version if new else 0)
    if is_feature_layer(layer):
        counts = feature_tile_diff(tile, old, new)
        return TileDiff(
            tile.path, *numbers, counts.new, counts.deleted, counts.modified, counts.same, counts.max_shift_m
        )
    before, after = _gaussians(old), _gaussians(new)
    delta = diff(before, after)
    changed = np.intersect1d(delta.put.voxel_id, before.voxel_id)
    shift_m = before.select(changed).mean_m - after.select(changed).mean_m
    return TileDiff(
        tile=tile.path,
        old_version=numbers[0],
        new_version=numbers[1],
        new=len(delta.put) - len(changed),
        deleted=len(delta.removed),
        modified=len(changed),
        same=len(after) - len(delta.put),
        max_shift_m=float(np.linalg.norm(shift_m, axis=1).max(initial=0.0)),
    )


def _gaussians(stored: StoredTile | None) -> Gaussians:
    return stored.decode_gaussians().gaussians if stored else Gaussians.empty()


def _map_diff(layer: str, prefix: str, diffs: list[TileDiff]) -> MapDiff:
    different = tuple(d for d in diffs if d.new or d.deleted or d.modified)
    return MapDiff(
        layer=layer,
        prefix=prefix,
        tiles=different,
        tiles_same=len(diffs) - len(different),
        new=sum(d.new for d in diffs),
        deleted=sum(d.deleted for d in diffs),
        modified=sum(d.modified for d in diffs),
        same=sum(d.same for d in diffs),
    )


def _newest(
    store: Store, layer: str, prefix: str, at_ns: int | None, only: Collection[TileId] | None = None
) -> dict[TileId, StoredTile]:
    """The tiles of a region as they are, or as they were at a time."""
    tiles = [entry.tile for entry in store.heads(layer, prefix) if only is None or entry.tile in only]
    stored = (store.get(layer, tile, at_ns=at_ns) for tile in tiles)
    return {one.tile: one for one in stored if one is not None}
