"""Small tiles, features and reports for the tests of the merge of feature layers."""

from collections.abc import Sequence

import numpy as np

from gnd.cloud_merger.features import FeatureMergeParameters
from gnd.cloud_merger.features.merge import MergedFeatures, merge_features
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import Existence, Feature, FeatureTile, hit, miss, prior
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.features import FeatureChange, FeatureReport, Found, Seen
from gnd.schemas.report_id import deterministic_report_id

TILE = TileId(497353963154)
EAST = TileId.from_indices(TILE.lon_index + 1, TILE.lat_index)
NO_HEIGHT = 1e4
EXIST, ABSENT = hit(0.97), miss(0.97)


def cov_of(sigma_m: float = 0.3, height_m2: float = NO_HEIGHT) -> F64:
    """(6,) round in the plane."""
    return np.array([sigma_m**2, 0.0, 0.0, sigma_m**2, 0.0, height_m2])


def feature(
    feature_id: int,
    east_m: float,
    north_m: float,
    *,
    sigma_m: float = 0.15,
    existence: Existence | None = None,
    kind: str = "traffic_sign",
    attributes: tuple[tuple[str, str], ...] = (("code", "274-60"),),
) -> Feature:
    """A sign of the map."""
    place = np.array([[east_m, north_m, 0.0]])
    return Feature(feature_id, kind, place, cov_of(sigma_m), existence or prior(0.95), attributes)


def found(
    east_m: float,
    north_m: float,
    *,
    sigma_m: float = 0.3,
    existence: Existence = EXIST,
    kind: str = "traffic_sign",
    attributes: tuple[tuple[str, str], ...] = (),
    height_m: float = 0.0,
    height_m2: float = NO_HEIGHT,
) -> Found:
    """A sign that the map has not."""
    return Found(kind, np.array([[east_m, north_m, height_m]]), cov_of(sigma_m, height_m2), existence, 4, attributes)


def line(*points: tuple[float, float], sigma_m: float = 0.1) -> Found:
    """A boundary of a lane."""
    points_m = np.column_stack([np.array(points, np.float64), np.zeros(len(points))])
    return Found("lane_boundary", points_m, cov_of(sigma_m), EXIST, 4)


def seen(
    feature_id: int, existence: Existence = EXIST, at_m: tuple[float, float] | None = None, sigma_m: float = 0.3
) -> Seen:
    """A verdict on a map feature, with where it was measured."""
    if at_m is None:
        return Seen(feature_id, existence, 3)
    return Seen(feature_id, existence, 3, np.array([*at_m, 0.0]), cov_of(sigma_m))


def change(
    *said: Seen | Found, base: Sequence[Feature] | None = None, viewed: int = 0, tile: TileId = TILE
) -> FeatureChange:
    """One report's part about a tile; `base` None: the vehicle had no map of it."""
    has_base = base is not None
    return FeatureChange(
        tile,
        1 if has_base else 0,
        sha_of(base, tile) if base is not None else b"",
        viewed,
        tuple(sorted((one for one in said if isinstance(one, Seen)), key=lambda one: one.feature_id)),
        tuple(one for one in said if isinstance(one, Found)),
    )


def sha_of(features: Sequence[Feature], tile: TileId = TILE) -> bytes:
    """The hash by which a report names its base; thousands of reports in turn name the same."""
    named = (tile, tuple(map(id, features)))
    if named not in _LAST_SHA:
        _LAST_SHA.clear()
        _LAST_SHA[named] = (FeatureTile.of(tile, 1, features).sha, tuple(features))  # held: no id comes twice
    return _LAST_SHA[named][0]


_LAST_SHA: dict[tuple[TileId, tuple[int, ...]], tuple[bytes, tuple[Feature, ...]]] = {}


def report_id(number: int) -> str:
    """Ids that sort as their numbers."""
    return deterministic_report_id(1_700_000_000_000 + number, "features")


def report(number: int, *changes: FeatureChange, vehicle: str = "", layer: str = "signs") -> FeatureReport:
    """A whole report, of tiles of one district."""
    return FeatureReport(
        report_id(number),
        vehicle or f"car-{number}",
        "camera",
        "test 1",
        layer,
        changes[0].tile.district,
        1_700_000_000_000_000_000 + number,
        1_700_000_001_000_000_000 + number,
        tuple(sorted(changes, key=lambda one: one.tile)),
    )


def merge(
    epoch: Sequence[Feature],
    reports: Sequence[FeatureReport],
    parameters: FeatureMergeParameters | None = None,
    tile: TileId = TILE,
) -> MergedFeatures:
    """The merge of a tile."""
    return merge_features(tile, epoch, reports, parameters)


def published(features: Sequence[Feature]) -> tuple[Feature, ...]:
    """As a tile holds them."""
    return FeatureTile.of(TILE, 1, features).features


def places(features: Sequence[Feature]) -> F64:
    """(N, 2) where points are."""
    return np.array([one.points_m[0, :2] for one in features]).reshape(-1, 2)
