"""The features of a layer one by one, with where each comes from: values that print as tables and as JSON."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gnd_map.features import Feature, full_covariance, geodetic_in_tile, is_feature_layer
from gnd_map.tile_id import TileId
from tile_store.errors import StoreError
from tile_store.store import Store
from tile_store.values import StoredTile


@dataclass(frozen=True, slots=True)
class ListedFeature:
    """One feature, or the piece of a polyline that lies in one tile."""

    feature_id: int
    part: int
    kind: str
    tile: str
    """Path."""
    version: int
    """Newest of the tile."""
    lat_deg: float
    """Of the point, or of the first vertex."""
    lon_deg: float
    height_m: float
    """Above the ellipsoid; see `sigma_up_m`."""
    sigma_m: float
    """Standard deviation in the worst horizontal direction."""
    sigma_up_m: float
    """The same upwards; 100 = nobody has measured the height."""
    points: int
    state: str
    """What has the largest mass: exist, absent, unknown."""
    exist: float
    absent: float
    unknown: float
    conflict: float
    hits: int
    vehicles: int
    attributes: Mapping[str, str]
    reports: tuple[str, ...]
    """Ids of the reports that its present state comes from; empty = it is as it was imported."""

    def as_dict(self) -> dict[str, Any]:
        """JSON-able; the id as text, because many readers round numbers beyond 2^53."""
        return asdict(self) | {"feature_id": str(self.feature_id), "attributes": dict(self.attributes)}


def list_features(store: Store, layer: str, prefix: str = "") -> list[ListedFeature]:
    """The features of the newest tiles of a region, by tile, id and part.

    Raises:
        StoreError: the layer holds Gaussians, or there are no tiles.
    """
    if not is_feature_layer(layer):
        raise StoreError(f"layer {layer!r} holds Gaussians, not features; feature layers: {_feature_layers(store)}")
    entries = store.heads(layer, prefix)
    if not entries:
        raise StoreError(
            f"no tiles in layer {layer!r}, region {prefix or 'everywhere'!r}; feature layers: {_feature_layers(store)}"
        )
    stored = (store.get(layer, entry.tile, entry.version) for entry in entries)
    return [feature for one in stored if one is not None for feature in _listed(store, one)]


def _feature_layers(store: Store) -> str:
    return ", ".join(layer for layer in store.layers() if is_feature_layer(layer)) or "none"


def _listed(store: Store, stored: StoredTile) -> Iterator[ListedFeature]:
    reports = reports_of_features(store, stored.layer, stored.tile)
    for feature in stored.decode_features().features:
        yield _line(feature, stored, reports.get(feature.feature_id, ()))


def reports_of_features(store: Store, layer: str, tile: TileId) -> dict[int, tuple[str, ...]]:
    """Report ids by feature id: of each feature those that the newest version since the epoch that names it gives."""
    found: dict[int, tuple[str, ...]] = {}
    for line in reversed(store.history(layer, tile)):
        if line.kind != "merged":
            break
        found = store.voxel_provenance(layer, tile, line.version) | found
    return found


def _line(feature: Feature, stored: StoredTile, reports: tuple[str, ...]) -> ListedFeature:
    lat, lon, height = geodetic_in_tile(stored.tile, feature.points_m[:1])
    cov = full_covariance(feature.cov_m2)
    return ListedFeature(
        feature_id=feature.feature_id,
        part=feature.part,
        kind=feature.kind,
        tile=stored.tile.path,
        version=stored.version,
        lat_deg=float(np.degrees(lat[0])),
        lon_deg=float(np.degrees(lon[0])),
        height_m=float(height[0]),
        sigma_m=float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1])),
        sigma_up_m=float(np.sqrt(cov[2, 2])),
        points=len(feature.points_m),
        state=feature.existence.state,
        exist=feature.existence.exist,
        absent=feature.existence.absent,
        unknown=feature.existence.unknown,
        conflict=feature.existence.conflict,
        hits=feature.hits,
        vehicles=feature.vehicles,
        attributes=dict(feature.attributes),
        reports=reports,
    )
