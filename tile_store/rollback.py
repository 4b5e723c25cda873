"""Bringing tiles back to an older state: a plan that can be looked at, and its execution as one transaction."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

from gnd.gnd_map.content import AnyTile
from gnd.gnd_map.features import FeatureTile, is_feature_layer
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store import sql_versions as versions
from gnd.tile_store.connection import SqlConnection, fetch
from gnd.tile_store.errors import StoreError, UnknownVersion
from gnd.tile_store.regions import morton_range
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.values import Content

Action = Literal["rollback", "empty", "same", "unknown"]
MEANING: Final[dict[Action, str]] = {
    "rollback": "gets the older content",
    "empty": "was not there yet: becomes empty",
    "same": "is as it was",
    "unknown": "retention has removed what it was: stays as it is",
}


@dataclass(frozen=True, slots=True)
class RollbackTarget:
    """Where to: a version of one tile, or a time (int ns UTC) of all tiles of a region."""

    version: int | None = None
    at_ns: int | None = None

    def __post_init__(self) -> None:
        if (self.version is None) == (self.at_ns is None):
            raise StoreError("a rollback needs a version or a time")


@dataclass(frozen=True, slots=True)
class RollbackStep:
    """What becomes of one tile: from its newest version to the content of another (0: there was none)."""

    tile: TileId
    from_version: int
    to_version: int
    action: Action


def plan(store: SqlStore, layer: str, region: TileId | str, to: RollbackTarget) -> list[RollbackStep]:
    """What a rollback of a tile or a region (path prefix) would do, by tile.

    Raises:
        UnknownVersion: the tile has no such version.
        StoreError: there are no such tiles, or a version is given for a region.
    """
    return store.look(lambda c: _plan(c, layer, region, to))


def roll_back(store: SqlStore, layer: str, region: TileId | str, to: RollbackTarget) -> list[RollbackStep]:
    """Do what `plan` says of the store as it is now, all or nothing; every tile that changes begins a new epoch."""

    def work(c: SqlConnection, now: int) -> list[RollbackStep]:
        steps = _plan(c, layer, region, to)
        for step in steps:
            if step.action == "rollback":
                versions.rollback(c, layer, step.tile, step.to_version, now, store.signing)
            elif step.action == "empty":
                content = Content.of(_empty(layer, step.tile))
                versions.put_base(c, layer, step.tile, content, "rollback", now, signing=store.signing)
        return steps

    return store.transact(work)


def _plan(c: SqlConnection, layer: str, region: TileId | str, to: RollbackTarget) -> list[RollbackStep]:
    heads = _heads(c, layer, region)
    if to.version is not None:
        if not isinstance(region, TileId):
            raise StoreError("a region goes back to a time, not to a version: its tiles count their versions apart")
        return [_to_version(c, layer, *heads[0], to.version)]
    assert to.at_ns is not None
    return [_to_time(c, layer, tile, head, sha, to.at_ns) for tile, head, sha in heads]


def _heads(c: SqlConnection, layer: str, region: TileId | str) -> Sequence[tuple[TileId, int, bytes]]:
    first, end = (region.morton, region.morton + 1) if isinstance(region, TileId) else morton_range(region)
    rows = fetch(c, "heads", {"layer": layer, "first": first, "end": end})
    if not rows:
        name = region.path if isinstance(region, TileId) else region or "everywhere"
        raise StoreError(f"no tiles in layer {layer!r}, region {name!r}")
    return [(TileId(tile), version, sha) for tile, version, sha in rows]


def _to_version(c: SqlConnection, layer: str, tile: TileId, head: int, sha: bytes, version: int) -> RollbackStep:
    rows = fetch(c, "sha_of_version", {"layer": layer, "tile": tile.morton, "version": version})
    if not rows:
        raise UnknownVersion(f"tile {tile.path} of layer {layer} has no version {version} (newest: {head})")
    return RollbackStep(tile, head, version, "same" if rows[0][0] == sha else "rollback")


def _to_time(c: SqlConnection, layer: str, tile: TileId, head: int, sha: bytes, at_ns: int) -> RollbackStep:
    place = {"layer": layer, "tile": tile.morton}
    found = fetch(c, "version_at", place | {"at_ns": at_ns})
    version = found[0][0] if found else 0
    following = fetch(c, "parent_of_next", place | {"version": version})
    if following and following[0][0] != version:  # others lay between them, of whose times nothing is known any more
        return RollbackStep(tile, head, version, "unknown")
    if not version:
        return RollbackStep(tile, head, 0, "same" if sha == _empty(layer, tile).sha else "empty")
    return _to_version(c, layer, tile, head, sha, version)


def _empty(layer: str, tile: TileId) -> AnyTile:
    return FeatureTile(tile, 0, ()) if is_feature_layer(layer) else Tile(tile, 0, Gaussians.empty())
