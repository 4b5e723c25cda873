"""What one drive says of the features of one tile: map features that it judges, where it looked, what it found."""

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, check_array
from gnd.gnd_map.features import Existence, Feature, check_simple_polyline, snapped
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId
from gnd.schemas import limits
from gnd.schemas.errors import BadValue
from gnd.schemas.wire import check_length, check_pair, check_unsigned, refusing

GRID: Final = 8
"""Rows and columns of the cells of `FeatureChange.viewed`."""
EVERY_CELL: Final = 2 ** (GRID * GRID) - 1
LANE_KINDS: Final = ("lane", "road")
"""Polylines whose kind begins with one of these run along the ground and never cross themselves."""


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What one drive alone says of one map feature."""

    feature_id: int
    """Of the map."""
    existence: Existence
    """Masses that began vacuous, not with what the map believes."""
    hits: int = 0
    """Looks that confirmed it."""
    position_m: F64 | None = None
    """(3,) where the drive measured it, in the ENU frame of the tile, whatever the map says; None = not measured."""
    cov_m2: F64 | None = None
    """(6,) xx, xy, xz, yy, yz, zz of that position; None exactly when that is."""

    def __post_init__(self) -> None:
        if (self.position_m is None) != (self.cov_m2 is None):
            raise BadValue(f"map feature {self.feature_id}: a position and its covariance go together")
        with refusing("judged"):
            self.as_feature()

    def as_feature(self) -> Feature:
        """The measurement as a feature of the kind "seen"; at the tile's centre where nothing was measured."""
        points_m, cov_m2 = np.zeros((1, 3)), np.zeros(6)
        if self.position_m is not None and self.cov_m2 is not None:
            check_array("position", self.position_m, np.float64, (3,))
            points_m, cov_m2 = self.position_m[None], self.cov_m2
        return Feature(self.feature_id, "seen", points_m, cov_m2, self.existence, hits=self.hits)

    def snapped(self) -> "Seen":
        """As it is after a journey: whole millimetres, masses in 1/10,000, covariance on levels."""
        near = snapped(self.as_feature())
        if self.position_m is None:
            return Seen(self.feature_id, near.existence, self.hits)
        return Seen(self.feature_id, near.existence, self.hits, near.points_m[0], near.cov_m2)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Seen) or (self.position_m is None) != (other.position_m is None):
            return False
        return self.as_feature() == other.as_feature()

    __hash__ = None  # type: ignore[assignment]


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """A feature that the drive found and its map has not."""

    kind: str
    """Such as "traffic_sign"."""
    points_m: F64
    """(N, 3) in the ENU frame of the tile: one a point, more a polyline."""
    cov_m2: F64
    """(6,) xx, xy, xz, yy, yz, zz of the position (of each vertex)."""
    existence: Existence
    """What this drive alone says."""
    hits: int = 0
    """Looks that detected it."""
    attributes: tuple[tuple[str, str], ...] = ()
    """Key and value, sorted by key."""

    def __post_init__(self) -> None:
        with refusing("found feature"):
            self.as_feature(1)
            if len(self.points_m) > 2 and self.kind.startswith(LANE_KINDS):
                check_simple_polyline(f"found {self.kind}", self.points_m)

    def as_feature(self, feature_id: int) -> Feature:
        """The same with an id."""
        return Feature(
            feature_id, self.kind, self.points_m, self.cov_m2, self.existence, self.attributes, hits=self.hits
        )

    @classmethod
    def of(cls, feature: Feature) -> "Found":
        """The same without id, part and vehicles."""
        return cls(feature.kind, feature.points_m, feature.cov_m2, feature.existence, feature.hits, feature.attributes)

    def snapped(self) -> "Found":
        """As it is after a journey: whole millimetres, masses in 1/10,000, covariance on levels."""
        return Found.of(snapped(self.as_feature(1)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Found) and self.as_feature(1) == other.as_feature(1)

    __hash__ = None  # type: ignore[assignment]


@dataclass(frozen=True, slots=True)
class FeatureChange:
    """What one drive found out about the features of one tile."""

    tile: TileId
    base_version: int
    """Version that the vehicle compared with; 0 = it had no features of this tile."""
    base_sha: bytes
    """SHA-256 of that version's content; empty = it had none."""
    viewed: int
    """Where a feature would have been confirmed had there been one: bit row·8 + column of a grid of 8 x 8 cells from
    the south-west corner, by fractions of the tile's latitude and longitude (`cell_of`).
    """
    seen: tuple[Seen, ...] = ()
    """Verdicts on map features, ascending by id, none twice."""
    found: tuple[Found, ...] = ()
    """In any order."""

    def __post_init__(self) -> None:
        name = f"features of tile {self.tile}"
        with refusing(name):
            check_pair("base", self.base_version, self.base_sha)
        check_unsigned(f"viewed cells of tile {self.tile}", self.viewed, bits=GRID * GRID)
        check_length(name, len(self.seen), limits.MAX_FEATURES_OF_TILE, "map features judged")
        check_length(name, len(self.found), limits.MAX_FEATURES_OF_TILE, "features found")
        self._check_order()
        self._check_found_once()
        for seen in self.seen:
            if seen.position_m is not None:
                _check_inside(f"map feature {seen.feature_id}", self.tile, seen.position_m, limits.MAX_SEEN_OUTSIDE_M)
        for number, found in enumerate(self.found):
            _check_inside(f"found {found.kind} {number}", self.tile, found.points_m, limits.MAX_FOUND_OUTSIDE_M)

    def _check_order(self) -> None:
        for before, after in pairwise(self.seen):
            if before.feature_id >= after.feature_id:
                raise BadValue(
                    f"features of tile {self.tile}: judges feature {after.feature_id} after {before.feature_id}: "
                    "ascending, none twice"
                )
        if self.seen and not self.base_sha:
            raise BadValue(f"features of tile {self.tile}: judges {len(self.seen)} map features without a map")

    def _check_found_once(self) -> None:
        """Two things of one kind at the same millimetre are one that was said twice."""
        places: dict[tuple[str, bytes], int] = {}
        for number, found in enumerate(self.found):
            first = places.setdefault((found.kind, np.round(found.points_m * 1e3).tobytes()), number)
            if first != number:
                raise BadValue(
                    f"features of tile {self.tile}: found {found.kind} {number} is the same as {first}, at "
                    f"{found.points_m[0].round(3).tolist()} m"
                )

    @property
    def n_features(self) -> int:
        """Features judged and found."""
        return len(self.seen) + len(self.found)

    @property
    def n_points(self) -> int:
        """Points of all features found."""
        return sum(len(found.points_m) for found in self.found)

    def snapped(self) -> "FeatureChange":
        """As it is after a journey."""
        return replace(
            self, seen=tuple(one.snapped() for one in self.seen), found=tuple(one.snapped() for one in self.found)
        )


def cell_of(tile: TileId, lat_rad: float, lon_rad: float) -> int | None:
    """Number of the cell of `FeatureChange.viewed` that holds a position, row·8 + column; None: outside the tile."""
    (south, west), (north, east) = tile.south_west_rad, tile.north_east_rad
    row = int(np.floor((lat_rad - south) / (north - south) * GRID))
    column = int(np.floor((lon_rad - west) / (east - west) * GRID))
    return row * GRID + column if 0 <= row < GRID and 0 <= column < GRID else None


@lru_cache(maxsize=4096)
def _half_extent_m(tile: TileId) -> tuple[float, float]:
    """How far the tile reaches from its centre, east and north."""
    (south, west), (north, east) = tile.south_west_rad, tile.north_east_rad
    corners = LocalFrame.of_tile(tile).enu_from_geodetic([south, south, north, north], [west, east, west, east], 0.0)
    reach = np.abs(corners[:, :2]).max(axis=0)
    return float(reach[0]), float(reach[1])


def _check_inside(name: str, tile: TileId, points_m: F64, margin_m: float) -> None:
    """Refuse a position far outside the tile, deep in the Earth or high above it; `points_m` (3,) or (N, 3)."""
    points_m = np.atleast_2d(points_m)
    out_m = float((np.abs(points_m[:, :2]) - _half_extent_m(tile)).max())
    if out_m > margin_m:
        raise BadValue(f"{name} lies {out_m:.2f} m outside its tile {tile}, the limit is {margin_m:g} m")
    lowest, highest = float(points_m[:, 2].min()), float(points_m[:, 2].max())
    if lowest < limits.MIN_FLOOR or highest > limits.MAX_FLOOR:
        raise BadValue(
            f"{name} lies at heights {lowest:.0f} .. {highest:.0f} m, the Earth's surface at "
            f"{limits.MIN_FLOOR} .. {limits.MAX_FLOOR} m"
        )
