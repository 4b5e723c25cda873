"""Features into a store and out of it: an import is one transaction, over the versions that it was made from."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from gnd.gnd_map.errors import GndError
from gnd.gnd_map.features import MAX_FEATURES_OF_TILE, Feature, FeatureTile, is_feature_layer
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store import sql_versions as versions
from gnd.tile_store.connection import SqlConnection, fetch
from gnd.tile_store.feature_io.errors import BadGeometry, DuplicateId, FeatureFileError
from gnd.tile_store.feature_io.lane_network import counted
from gnd.tile_store.feature_io.osm_document import Progress
from gnd.tile_store.feature_io.sources import FeatureSource, get_sources, put_source
from gnd.tile_store.feature_io.tiling import cut, whole
from gnd.tile_store.feature_io.values import FeatureFile, MapFeature
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.values import Content, check_layer

_EVERY: Final = 64


@dataclass(frozen=True, slots=True)
class ImportResult:
    """What an import did. tiles: that it published; unchanged: that held the same already. features: put, by layer;
    removed: that an earlier import of the same source had put and this file has no more; left_out: by kind. lanes: how
    many lanes, of them with a successor and with a neighbour; kept: what the file keeps that is no feature, by type.
    """

    source: str
    format: str
    features: Mapping[str, int]
    removed: int
    tiles: int
    unchanged: int
    left_out: Mapping[str, int]
    notes: tuple[str, ...] = ()
    lanes: Mapping[str, int] = field(default_factory=dict)
    kept: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Put:
    """A tile of a layer, and the version it was made from (0: none)."""

    layer: str
    tile: FeatureTile
    content: Content
    over: int


def import_features(
    store: SqlStore,
    file: FeatureFile,
    source: str,
    options: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> ImportResult:
    """Put a file's features into the store's layers: new versions of the tiles they lie in, all or none.

    Features of other origin stay; those that an earlier import of the same `source` put are replaced.

    Args:
        store: where they go.
        file: what was read.
        source: what the file is known by; its features' ids were made with it.
        options: how the file was read, for the way back: `about_options`.
        progress: called now and then.

    Raises:
        FeatureFileError: no features, an id that another source has in the store, or a merger has published one of the
            tiles meanwhile.
        StoreError: the store cannot take them.
    """
    if not file.features:
        what = ", ".join(f"{n} of kind {kind}" for kind, n in file.left_out.items()) or "nothing"
        raise FeatureFileError(f"{source}: no features to import; left out: {what} (name a layer for them)")
    known = sources_of(store)
    _refuse_foreign(file, source, known)
    old = known[source].ids if source in known else {}
    puts, removed = _puts(store, file, old, progress)
    ids = {layer: tuple(sorted(f.feature_id for f in file.features if f.layer == layer)) for layer in file.layers}
    new = FeatureSource(source, file.format, ids, options or {}, file.document or b"", file.lanes)
    kept = _kept(new, known.get(source))

    def work(c: SqlConnection, now: int) -> int:
        published = sum(_put(c, one, now, store.signing) for one in puts)
        put_source(c, kept, now)
        return published

    published = store.transact(work)
    return ImportResult(
        source, file.format, file.layers, removed, published, len(puts) - published, file.left_out, file.notes,
        counted(file.lanes), file.kept,
    )  # fmt: skip


def _kept(new: FeatureSource, before: FeatureSource | None) -> FeatureSource:
    """What is kept of a source: features that come back from an editor keep their document and their lanes."""
    if before is None or new.document or new.lanes or not (before.document or before.lanes):
        return new
    return FeatureSource(new.name, before.format, new.ids, before.options, before.document, before.lanes)


def _put(c: SqlConnection, one: _Put, now: int, signing: Signing | None) -> bool:
    rows = fetch(c, "head", {"layer": one.layer, "tile": one.tile.tile_id.morton})
    head = int(rows[0][0]) if rows else 0
    if head != one.over:
        raise FeatureFileError(
            f"tile {one.tile.tile_id.path} of layer {one.layer} went from version {one.over} to {head} during the "
            "import; nothing was imported, try again"
        )
    put = versions.put_base(c, one.layer, one.tile.tile_id, one.content, "base", now, signing=signing)
    return put.status == "published"


def _refuse_foreign(file: FeatureFile, source: str, known: Mapping[str, FeatureSource]) -> None:
    """Two files must not write one feature in turns."""
    others = (other for other in known.values() if other.name != source)
    owner = {id_: other.name for other in others for ids in other.ids.values() for id_ in ids}
    twice = [feature for feature in file.features if feature.feature_id in owner]
    if twice:
        first = twice[0]
        raise DuplicateId(
            f"{source}: {len(twice)} of {len(file.features)} features are in the store already, from "
            f"{owner[first.feature_id]}, first {first.name} with id {first.feature_id}; import under that source "
            "to replace them"
        )


def _puts(
    store: SqlStore, file: FeatureFile, old: Mapping[str, Sequence[int]], progress: Progress | None
) -> tuple[list[_Put], int]:
    """The tiles as they will be, and how many features of the source go."""
    new = cut(file.features, len(file.features), progress)
    puts: list[_Put] = []
    gone = 0
    for layer in sorted({*new, *old}):
        mine = {f.feature_id for f in file.features if f.layer == layer}
        before = set(old.get(layer, ()))
        there = _tiles_with(store, layer, before) if before else {}
        gone += len({f.feature_id for tile in there.values() for f in tile.features if f.feature_id in before - mine})
        touched = sorted({*new.get(layer, {}), *there})
        for number, tile in enumerate(touched):
            puts.append(_tile(store, layer, tile, new.get(layer, {}).get(tile, []), before | mine))
            if progress and number % _EVERY == 0:
                progress(f"layer {layer}", number, len(touched))
    return puts, gone


def _tile(store: SqlStore, layer: str, tile: TileId, features: list[Feature], ours: set[int]) -> _Put:
    stored = store.get(layer, tile)
    kept = [] if stored is None else [f for f in stored.decode_features().features if f.feature_id not in ours]
    n = len(kept) + len(features)
    if n > MAX_FEATURES_OF_TILE:
        raise BadGeometry(f"tile {tile.path} of layer {layer}: {n} features, the limit is {MAX_FEATURES_OF_TILE}")
    try:
        made = FeatureTile.of(tile, 1, [*kept, *features])
        return _Put(layer, made, Content.of(made), stored.version if stored else 0)
    except GndError as error:
        raise BadGeometry(f"tile {tile.path} of layer {layer}: {error}") from None


def _tiles_with(store: SqlStore, layer: str, ids: set[int]) -> dict[TileId, FeatureTile]:
    return {one.tile_id: one for one in layer_tiles(store, layer) if any(f.feature_id in ids for f in one.features)}


def layer_tiles(store: SqlStore, layer: str) -> list[FeatureTile]:
    """The newest versions of the tiles of a feature layer."""
    stored = (store.get(layer, entry.tile, entry.version) for entry in store.heads(layer))
    return [one.decode_features() for one in stored if one is not None]


def sources_of(store: SqlStore) -> dict[str, FeatureSource]:
    """The files that the store's features come from, by name."""
    return {source.name: source for source in store.look(get_sources)}


def feature_layers(store: SqlStore) -> list[str]:
    """The store's layers that hold features."""
    return [layer for layer in store.layers() if is_feature_layer(layer)]


def load_features(store: SqlStore, layers: Iterable[str] = (), region: str = "") -> list[MapFeature]:
    """The features of layers (none named: of all feature layers), whole, that touch a region (a prefix of tile paths).

    Raises:
        FeatureFileError: a layer that the store has not, or that holds Gaussians.
    """
    there, wanted = feature_layers(store), list(layers)
    absent = [layer for layer in wanted if check_layer(layer) not in there]
    if absent:
        raise FeatureFileError(f"{store.location}: no feature layer {absent[0]!r}; it has {', '.join(there) or 'none'}")
    tiles = {layer: layer_tiles(store, layer) for layer in wanted or there}
    prefix = region.replace("/", "")
    inside = {
        feature.feature_id
        for of_layer in tiles.values()
        for tile in of_layer
        if tile.tile_id.path.replace("/", "").startswith(prefix)
        for feature in tile.features
    }
    return [feature for feature in whole(tiles) if feature.feature_id in inside]
