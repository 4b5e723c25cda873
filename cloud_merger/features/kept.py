"""Reports about feature layers between bus and store: checked against the map, spread to the tiles around."""

from collections import OrderedDict
from collections.abc import Iterable
from functools import lru_cache
from threading import Lock
from typing import Final

from gnd.cloud_merger.errors import BadReport
from gnd.cloud_merger.features.check import check_feature_report
from gnd.cloud_merger.features.parameters import FeatureMergeParameters
from gnd.cloud_merger.features.spread import spread
from gnd.gnd_map.features import Feature
from gnd.gnd_map.tile_id import LAT_TILES, LON_TILES, District, TileId
from gnd.schemas.feature_layer import LayerParameters
from gnd.schemas.features import FeatureReport
from gnd.schemas.keys import parse_change_key
from gnd.tile_store.store import Store
from gnd.tile_store.values import ReportRow

REMEMBERED_REPORTS: Final = 8192  # some kB each
REMEMBERED_TILES: Final = 4096  # some kB each
_NO_BASE: Final = b""


@lru_cache(maxsize=REMEMBERED_REPORTS)
def said_of(body: bytes) -> FeatureReport:
    """The part of a report that a tile keeps; remembered: each merge of a tile reads all reports again.

    Raises:
        SchemaError: it can no longer be read.
    """
    return FeatureReport.decode(body)


class FeatureContents:
    """Features of versions of tiles, by hash; those used last are remembered. Safe in several threads.

    Args:
        store: that holds them.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._lock = Lock()
        self._held: OrderedDict[tuple[str, TileId, bytes], tuple[Feature, ...]] = OrderedDict()

    def content(self, layer: str, tile: TileId, sha: bytes) -> tuple[Feature, ...] | None:
        """The features of a tile by content hash, () for no hash; None: the store does not hold them.

        Raises:
            SchemaError: they cannot be decoded, or are not what the hash says.
        """
        if not sha:
            return ()
        place = layer, tile, sha
        with self._lock:
            if place in self._held:
                self._held.move_to_end(place)
                return self._held[place]
        stored = self._store.by_sha(layer, tile, sha)
        if stored is None:
            return None
        features = stored.decode_features().features
        with self._lock:
            self._held[place] = features
            while len(self._held) > REMEMBERED_TILES:
                self._held.popitem(last=False)
        return features


class FeatureInbox:
    """What becomes of a report about features. Safe in several threads.

    Args:
        store: of the map.
        parameters: of the merge.
        layers: that are declared.
        reach_tiles: a tile that no layer holds may be this many tiles away from one that a layer holds.
    """

    def __init__(
        self, store: Store, parameters: FeatureMergeParameters, layers: Iterable[LayerParameters], reach_tiles: int
    ) -> None:
        self._store, self._parameters, self._reach_tiles = store, parameters, reach_tiles
        self._layers = {layer.name: layer for layer in layers}
        self._contents = FeatureContents(store)

    def check(self, key: str, report: FeatureReport) -> None:
        """Refuse what cannot be a true statement about this map.

        Raises:
            BadReport: with numbers.
        """
        layer, district = parse_change_key(key)
        if (report.layer, report.district) != (layer, district):
            raise BadReport(f"report for {report.layer} {report.district} came on the key of {layer} {district}")
        check_feature_report(report, lambda tile, sha: self._ids(layer, tile, sha), self._layers.get(layer))
        for change in report.tiles:
            if not change.base_sha or self._contents.content(layer, change.tile, change.base_sha) is None:
                self._check_reach(change.tile)

    def rows(self, report: FeatureReport, received_ns: int) -> list[ReportRow]:
        """What the store is to keep: one row for each tile that is to hear of it."""
        parameters = self._parameters.of_layer(self._layers.get(report.layer))
        bases = {change.tile: change.base_sha for change in report.tiles}
        return [
            ReportRow(
                report.report_id,
                report.layer,
                tile,
                report.vehicle,
                received_ns,
                part.encode(),
                base_sha=bases.get(tile, _NO_BASE),
            )
            for tile, part in spread(report, parameters.reach_m).items()
        ]

    def _ids(self, layer: str, tile: TileId, sha: bytes) -> frozenset[int] | None:
        features = self._contents.content(layer, tile, sha)
        return None if features is None else frozenset(feature.feature_id for feature in features)

    def _check_reach(self, tile: TileId) -> None:
        """Refuse a tile that is far from all that any layer holds: a new layer begins on the map that there is."""
        near = set(square(tile, self._reach_tiles))
        districts = districts_of(near)
        for layer in self._store.layers():
            held = (head.tile for district in districts for head in self._store.heads(layer, district.path))
            if not near.isdisjoint(held):
                return
        raise BadReport(
            f"tile {tile} is not on the map, nor is any of any layer within {self._reach_tiles} tiles of it"
        )


def square(tile: TileId, reach: int) -> list[TileId]:
    """The tiles at most `reach` away in each direction."""
    steps = range(-reach, reach + 1)
    lon, lat = tile.lon_index, tile.lat_index
    return [
        TileId.from_indices((lon + i) % LON_TILES, lat + j) for j in steps if 0 <= lat + j < LAT_TILES for i in steps
    ]


def districts_of(tiles: set[TileId]) -> list[District]:
    """The districts of some tiles, sorted."""
    return sorted({tile.district for tile in tiles})
