"""What a feature layer holds, and how two states of its tiles differ: values that print as tables and as JSON."""

from collections import Counter
from dataclasses import asdict, dataclass
from math import ceil, floor
from typing import Any

import numpy as np

from gnd.gnd_map.features import Feature, FeatureTile, diff_features
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.errors import StoreError
from gnd.tile_store.regions import bounds_deg
from gnd.tile_store.values import StoredTile


@dataclass(frozen=True, slots=True)
class FeatureMapInfo:
    """Totals of a region's newest versions of a feature layer."""

    layer: str
    prefix: str
    tiles: int
    districts: int
    features: int
    """Different ids; a polyline through several tiles is one."""
    pieces: int
    """What the tiles hold: points, and pieces of polylines."""
    points: int
    """Vertices of them all."""
    kinds: dict[str, int]
    """Features by kind."""
    states: dict[str, int]
    """Pieces by what has the largest mass: exist, absent, unknown."""
    body_bytes: int
    bytes_a_piece: float
    """Of the bodies as they lie in the store; 0 without features."""
    lowest_version: int
    highest_version: int
    updated_ns: int
    """Time of the newest version, UTC."""
    south_deg: float
    west_deg: float
    north_deg: float
    east_deg: float
    lowest_m: int
    """Height of the lowest vertex above the ellipsoid, rounded down."""
    highest_m: int

    def as_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return asdict(self)


def feature_map_info(stored: list[StoredTile], layer: str, prefix: str) -> FeatureMapInfo:
    """Totals of the newest versions of a region of a feature layer; `StoreError` when there are none."""
    if not stored:
        raise StoreError(f"no tiles in layer {layer!r}, region {prefix or 'everywhere'!r}")
    pieces = [feature for one in stored for feature in one.decode_features().features]
    body_bytes = sum(len(one.body) for one in stored)
    south, west, north, east = bounds_deg([one.tile for one in stored])
    lowest_m, highest_m = _heights_m(pieces)
    return FeatureMapInfo(
        layer=layer,
        prefix=prefix,
        tiles=len(stored),
        districts=len({one.tile.district for one in stored}),
        features=len({piece.feature_id for piece in pieces}),
        pieces=len(pieces),
        points=sum(len(piece.points_m) for piece in pieces),
        kinds=dict(sorted(Counter({piece.feature_id: piece.kind for piece in pieces}.values()).items())),
        states=dict(sorted(Counter(piece.existence.state for piece in pieces).items())),
        body_bytes=body_bytes,
        bytes_a_piece=body_bytes / len(pieces) if pieces else 0.0,
        lowest_version=min(one.version for one in stored),
        highest_version=max(one.version for one in stored),
        updated_ns=max(one.created_ns for one in stored),
        south_deg=south,
        west_deg=west,
        north_deg=north,
        east_deg=east,
        lowest_m=lowest_m,
        highest_m=highest_m,
    )


def _heights_m(pieces: list[Feature]) -> tuple[int, int]:
    """Of the vertices, in the frames of their tiles: within a tenth of a millimetre of ellipsoidal heights."""
    if not pieces:
        return 0, 0
    heights = np.concatenate([piece.points_m[:, 2] for piece in pieces])
    return floor(heights.min()), ceil(heights.max())


@dataclass(frozen=True, slots=True)
class FeatureTileDiff:
    """How many pieces of one tile differ between two states, and how far the farthest has moved."""

    new: int
    deleted: int
    modified: int
    same: int
    max_shift_m: float


def feature_tile_diff(tile: TileId, old: StoredTile | None, new: StoredTile | None) -> FeatureTileDiff:
    """How a tile of a feature layer differs between two states; None = it is not there."""
    before, after = _features(tile, old), _features(tile, new)
    delta = diff_features(before.features, after.features)
    held = {feature.key: feature for feature in before.features}
    changed = [(held[feature.key], feature) for feature in delta.put if feature.key in held]
    return FeatureTileDiff(
        new=len(delta.put) - len(changed),
        deleted=len(delta.removed),
        modified=len(changed),
        same=len(after.features) - len(delta.put),
        max_shift_m=max((_shift_m(*pair) for pair in changed), default=0.0),
    )


def _features(tile: TileId, stored: StoredTile | None) -> FeatureTile:
    return stored.decode_features() if stored else FeatureTile(tile, 0, ())


def _shift_m(before: Feature, after: Feature) -> float:
    """How far the vertex that moved most has moved; of polylines with other numbers of vertices the first one's."""
    n = len(before.points_m) if len(before.points_m) == len(after.points_m) else 1
    return float(np.linalg.norm(before.points_m[:n] - after.points_m[:n], axis=1).max())
