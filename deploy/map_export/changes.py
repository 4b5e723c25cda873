"""What differs between two states of a map as objects: a work list for a mapping team.

Voxels that are new, deleted or modified (of another shape) are clustered apart from each other (DBSCAN, Ester et al.
1996: 26 neighbours, at least two voxels), and what is longer than somebody sees at one look is cut. Where vehicles
reported them, the store says which reports made each voxel what it is; a report's id holds the time of its drive.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from typing import Any, Final, Literal

import numpy as np
from ulid import ULID

from gnd.deploy.map_export.libraries import library
from gnd.deploy.map_export.pieces import pieces
from gnd.gnd_map.arrays import F64, I32, I64
from gnd.gnd_map.features import is_feature_layer
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VOXEL_M, VoxelGrid
from gnd.gnd_map.similarity import similarity
from gnd.gnd_map.tile import diff
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.errors import StoreError
from gnd.tile_store.judging import ChangedTile
from gnd.tile_store.store import Store
from gnd.tile_store.values import StoredTile

What = Literal["new", "deleted", "modified"]
Shape = Literal["surface", "pole", "wall", "object"]

NEIGHBOUR_M: Final = 1.8 * VOXEL_M
"""Centres of voxels that touch at a face, an edge or a corner are at most the square root of 3 apart."""
LEAST_VOXELS: Final = 2
ALIKE: Final = 0.5
"""Voxels that are as similar as this count as the same: two surveys never give equal Gaussians."""
_SPREAD: Final = float(np.sqrt(3.0))  # half a uniform distribution's length over its standard deviation
_LOW_M: Final = 0.5
_TALL_M: Final = 1.5
_THIN_M: Final = 1.2
_LEAST_M: Final = 0.1
_MS: Final = 1_000_000


@dataclass(frozen=True, slots=True)
class Change:
    """One object-like cluster of changed voxels, or a piece of a long one.

    Attributes:
        change: what became of it.
        shape: by its size alone: "surface" is lower than 0.5 m, "pole" at least 1.5 m tall and thinner than 1.2 m both
            ways, "wall" as tall and thinner than 1.2 m one way, all else an "object".
        lat_deg: the middle.
        lon_deg: the same.
        height_m: its foot above the ellipsoid.
        length_m: the longer side of its footprint.
        width_m: the shorter side.
        tall_m: from foot to top.
        bearing_deg: of the longer side, 0 ... 180 clockwise from north.
        voxels: how many.
        points: raw points of its Gaussians, of the state that has them.
        first_seen: when the first report that tells of it was driven, or the survey ended that did; UTC, None: unknown.
        last_seen: the same of the last.
        vehicles: how many different ones reported it; None: it comes from a survey.
        reports: of how many reports.
        confidence: share of its voxels that two or more vehicles reported; None: it comes from a survey.
        tiles: the paths of its tiles.
        outline_deg: (5, 2) longitude and latitude of the corners of its footprint, counter-clockwise, closed.
        parts: what it is in each of its tiles that the new state has, by number.
    """

    change: What
    shape: Shape
    lat_deg: float
    lon_deg: float
    height_m: float
    length_m: float
    width_m: float
    tall_m: float
    bearing_deg: float
    voxels: int
    points: int
    first_seen: datetime | None
    last_seen: datetime | None
    vehicles: int | None
    reports: int
    confidence: float | None
    tiles: tuple[str, ...]
    outline_deg: F64 = field(repr=False, compare=False)
    parts: tuple[ChangedTile, ...] = field(default=(), repr=False, compare=False)

    def as_dict(self) -> dict[str, Any]:
        """JSON-able, without the outline and the parts."""
        values = asdict(replace(self, parts=()))
        del values["outline_deg"], values["parts"]
        for name in ("first_seen", "last_seen"):
            values[name] = None if values[name] is None else values[name].isoformat().replace("+00:00", "Z")
        return values | {"tiles": ",".join(self.tiles)}


@dataclass(frozen=True, slots=True)
class ChangedVoxels:
    """The clusters, largest first, and how many voxels lie alone and were left out."""

    changes: tuple[Change, ...]
    alone: int


@dataclass(frozen=True, slots=True)
class _Source:
    """Where the new state of a tile comes from."""

    vehicle_of: Mapping[str, str]
    reports_of: Mapping[int, tuple[str, ...]]  # voxel -> report ids
    surveyed_ns: int | None
    versions: tuple[int, int] = (0, 0)  # before and after; 0: not there


@dataclass(frozen=True, slots=True)
class _VoxelTable:
    """Changed voxels of one tile and kind in a common frame."""

    tile: TileId
    voxel_id: I32
    mean_m: F64
    cov_m2: F64
    count: I64
    source: _Source


def map_changes(
    old: Store, new: Store, *, layer: str, prefix: str = "", old_at_ns: int | None = None, tile: TileId | None = None,
    versions: tuple[int, int] | None = None, only: Sequence[TileId] | None = None,
) -> ChangedVoxels:  # fmt: skip
    """Object-like changes of a region between two stores, two times of one store, or two versions of a tile.

    Args:
        old: the store of the old state.
        new: that of the new state; may be the same one.
        layer: a layer of Gaussians.
        prefix: leading chunks of a tile's path; "" = all.
        old_at_ns: the old state's time, UTC; None: its newest versions.
        tile: only this tile, ...
        versions: ... these two versions of it.
        only: only these tiles; None: all of the region.

    Raises:
        StoreError: a layer of features, or no tiles in either.
        MissingExtra: scikit-learn is not installed.
    """
    if is_feature_layer(layer):
        raise StoreError(f"layer {layer!r} holds features: `gnd map diff` lists them, --to is for layers of Gaussians")
    tiles = [tile] if tile else sorted(only or {one.tile for store in (old, new) for one in store.heads(layer, prefix)})
    if not tiles:
        raise StoreError(f"no tiles in layer {layer!r}, region {prefix or 'everywhere'!r}")
    numbers = versions or (None, None)
    pairs = ((one, old.get(layer, one, numbers[0], old_at_ns), new.get(layer, one, numbers[1])) for one in tiles)
    return changes_of_tiles(new, layer, pairs, same_store=old is new)


def changes_of_tiles(
    store: Store, layer: str, pairs: Iterable[tuple[TileId, StoredTile | None, StoredTile | None]], *, same_store: bool
) -> ChangedVoxels:
    """Object-like changes between two states of tiles.

    Args:
        store: of the new state; tells which reports made it.
        layer: a layer of Gaussians.
        pairs: of each tile the state before and after, None where it is not there.
        same_store: whether the states before are versions of the same store, so that only later reports count.

    Raises:
        MissingExtra: scikit-learn is not installed.
    """
    held = sorted(pairs, key=lambda one: one[0].morton)
    if not held:
        return ChangedVoxels((), 0)
    frame = LocalFrame.of_tile(held[len(held) // 2][0])
    voxels: dict[What, list[_VoxelTable]] = {"new": [], "deleted": [], "modified": []}
    reporters = _Reporters(store, layer)
    for one, before, after in held:
        since = before.version if before and same_store else 0
        for what, found in _changed(one, before, after, frame, lambda a=after, n=since: reporters.source(a, n)):
            voxels[what].append(found)
    clusters = [cluster for what, found in voxels.items() for cluster in _clusters(what, found, frame)]
    changes = [one for one in clusters if isinstance(one, Change)]
    changes.sort(key=lambda one: (-one.voxels, one.lat_deg, one.lon_deg))
    return ChangedVoxels(tuple(changes), sum(one for one in clusters if isinstance(one, int)))


class _Reporters:
    """Which vehicle sent which report; read once, when the first tile asks."""

    def __init__(self, store: Store, layer: str) -> None:
        self._store, self._layer = store, layer
        self._vehicle_of: dict[str, str] | None = None

    def source(self, stored: StoredTile | None, since: int) -> _Source:
        """Reports of each voxel in the versions after `since`, and the survey of a base."""
        if stored is None:
            return _Source({}, {}, None, (since, 0))
        reports: dict[int, set[str]] = {}
        for line in self._store.history(self._layer, stored.tile):
            if since < line.version <= stored.version:
                found = self._store.voxel_provenance(self._layer, stored.tile, line.version)
                for voxel, ids in found.items():
                    reports.setdefault(voxel, set()).update(ids)
        if reports and self._vehicle_of is None:
            self._vehicle_of = {row.report_id: row.vehicle for row in self._store.reports(self._layer)}
        surveyed = stored.surveyed_ns if stored.kind == "base" else None
        told = {voxel: tuple(sorted(ids)) for voxel, ids in reports.items()}
        return _Source(self._vehicle_of or {}, told, surveyed, (since, stored.version))


def _changed(
    tile: TileId, before: StoredTile | None, after: StoredTile | None, frame: LocalFrame, source: Any
) -> Iterator[tuple[What, _VoxelTable]]:
    """The voxels of a tile that are new, deleted, or of another shape."""
    a = before.decode_gaussians().gaussians if before else Gaussians.empty()
    b = after.decode_gaussians().gaussians if after else Gaussians.empty()
    delta = diff(a, b)
    if not len(delta):
        return
    is_new = ~np.isin(delta.put.voxel_id, a.voxel_id)
    both = delta.put.take(~is_new)
    other = a.select(both.voxel_id)
    there = np.ones(len(both), bool)
    alike = similarity(there, other.mean_m, other.cov_m2, there, both.mean_m, both.cov_m2)
    where = source()
    parts: tuple[tuple[What, Gaussians], ...] = (
        ("new", delta.put.take(is_new)),
        ("deleted", a.select(delta.removed)),
        ("modified", both.take(alike < ALIKE)),
    )
    T = frame.T_self_other(LocalFrame.of_tile(tile))
    for what, g in parts:
        if len(g):
            mean_tile_m = VoxelGrid.of(tile).centre_m(g.voxel_id) + g.mean_m
            cov = T[:3, :3] @ g.full_cov() @ T[:3, :3].T
            mean_m = mean_tile_m @ T[:3, :3].T + T[:3, 3]
            yield what, _VoxelTable(tile, g.voxel_id, mean_m, cov, g.count.astype(np.int64), where)


def _clusters(what: What, found: Sequence[_VoxelTable], frame: LocalFrame) -> Iterator[Change | int]:
    """The clusters of one kind, or their pieces, and how many voxels lie alone."""
    if not found:
        return
    centre_m = np.concatenate(
        [frame.enu_from_geodetic(*VoxelGrid.of(one.tile).centre_geodetic(one.voxel_id)) for one in found]
    )
    cluster = library("sklearn.cluster").DBSCAN(eps=NEIGHBOUR_M, min_samples=LEAST_VOXELS).fit_predict(centre_m)
    part = np.repeat(np.arange(len(found)), [len(one.voxel_id) for one in found])
    row = np.concatenate([np.arange(len(one.voxel_id)) for one in found])
    for label in range(int(cluster.max()) + 1):
        chosen = np.flatnonzero(cluster == label)
        T = LocalFrame.of_tile(found[part[chosen[0]]].tile).T_self_other(frame)  # its own, whatever else has changed
        for piece in pieces(centre_m[chosen] @ T[:2, :3].T + T[:2, 3]):
            voxels = [(found[part[i]], int(row[i])) for i in chosen[piece]]
            yield _change(what, voxels, frame) if len(voxels) >= LEAST_VOXELS else len(voxels)
    yield int((cluster < 0).sum())


def _change(what: What, voxels: list[tuple[_VoxelTable, int]], frame: LocalFrame) -> Change:
    mean_m = np.stack([one.mean_m[i] for one, i in voxels])
    cov_m2 = np.stack([one.cov_m2[i] for one, i in voxels])
    count = np.array([one.count[i] for one, i in voxels])
    axes, low, high = _box(mean_m, cov_m2, count)
    size_m = np.maximum(high - low, _LEAST_M)
    corners = np.array([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1]), (low[0], low[1])])
    foot = np.concatenate([corners @ axes, np.full((5, 1), low[2])], axis=1)
    lat, lon, height = frame.geodetic_from_enu(foot)
    middle_lat, middle_lon, _ = frame.geodetic_from_enu(foot[:4].mean(axis=0))
    seen = _seen(voxels)
    return Change(
        change=what,
        shape=_shape(size_m),
        lat_deg=float(np.degrees(middle_lat)),
        lon_deg=float(np.degrees(middle_lon)),
        height_m=round(float(height[:4].mean()), 2),
        length_m=round(float(size_m[0]), 2),
        width_m=round(float(size_m[1]), 2),
        tall_m=round(float(size_m[2]), 2),
        bearing_deg=round(float(np.degrees(np.arctan2(axes[0, 0], axes[0, 1]))) % 180.0, 1),
        voxels=len(voxels),
        points=int(count.sum()),
        first_seen=seen[0],
        last_seen=seen[1],
        vehicles=seen[2],
        reports=seen[3],
        confidence=seen[4],
        tiles=tuple(sorted({one.tile.path for one, _ in voxels})),
        outline_deg=np.stack([np.degrees(lon), np.degrees(lat)], axis=1),
        parts=tuple(_parts(voxels)),
    )


def _parts(voxels: list[tuple[_VoxelTable, int]]) -> Iterator[ChangedTile]:
    """What a change is in each of its tiles."""
    by_tile: dict[int, list[tuple[_VoxelTable, int]]] = {}
    for one, i in voxels:
        by_tile.setdefault(one.tile.morton, []).append((one, i))
    for _, rows in sorted(by_tile.items()):
        source, tile = rows[0][0].source, rows[0][0].tile
        ids = tuple(sorted(int(one.voxel_id[i]) for one, i in rows))
        reports = {name for voxel in ids for name in source.reports_of.get(voxel, ())}
        if source.versions[0] < source.versions[1]:
            yield ChangedTile(tile, *source.versions, ids, tuple(sorted(reports)))


def _box(mean_m: F64, cov_m2: F64, count: I64) -> tuple[F64, F64, F64]:
    """Horizontal axes (2, 2) of a cluster, longer first, and its lowest and highest (3,) along them and up, m."""
    weight = count / count.sum()
    middle = weight @ mean_m
    spread = np.einsum("n,nij->ij", weight, cov_m2) + (mean_m - middle).T @ (weight[:, None] * (mean_m - middle))
    first = np.linalg.eigh(spread[:2, :2])[1][:, 1]
    axes = np.array([first, (-first[1], first[0])])
    along = np.concatenate([mean_m[:, :2] @ axes.T, mean_m[:, 2:]], axis=1)
    variance = np.einsum("ai,nij,aj->na", axes, cov_m2[:, :2, :2], axes)
    half = _SPREAD * np.sqrt(np.maximum(np.concatenate([variance, cov_m2[:, 2:, 2]], axis=1), 0.0))
    low, high = (along - half).min(axis=0), (along + half).max(axis=0)
    if high[1] - low[1] > high[0] - low[0]:
        axes = np.array([axes[1], -axes[0]])
        low, high = np.array([low[1], -high[0], low[2]]), np.array([high[1], -low[0], high[2]])
    return axes, low, high


def _shape(size_m: F64) -> Shape:
    length_m, width_m, tall_m = size_m
    if tall_m < _LOW_M:
        return "surface"
    if tall_m >= _TALL_M and width_m < _THIN_M:
        return "pole" if length_m < _THIN_M else "wall"
    return "object"


def _seen(
    voxels: list[tuple[_VoxelTable, int]],
) -> tuple[datetime | None, datetime | None, int | None, int, float | None]:
    """First and last seen, vehicles, reports, confidence."""
    ids: set[str] = set()
    vehicles: set[str] = set()
    twice = 0
    for one, i in voxels:
        reports = one.source.reports_of.get(int(one.voxel_id[i]), ())
        by = {one.source.vehicle_of[name] for name in reports if name in one.source.vehicle_of}
        ids.update(reports)
        vehicles |= by
        twice += len(by) >= 2
    if not ids:
        surveys = [one.source.surveyed_ns for one, _ in voxels if one.source.surveyed_ns is not None]
        return _time(min(surveys, default=None)), _time(max(surveys, default=None)), None, 0, None
    times = [ULID.from_str(name).milliseconds * _MS for name in ids]
    return _time(min(times)), _time(max(times)), len(vehicles), len(ids), round(twice / len(voxels), 3)


def _time(t_ns: int | None) -> datetime | None:
    return None if t_ns is None else datetime.fromtimestamp(t_ns // 1_000_000_000, UTC)
