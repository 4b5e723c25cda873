"""Which reports about features are refused, beyond what `schemas` accepts of any: those that cannot be true.

Every refusal names the tile, the feature and the numbers; the report goes to quarantine as a whole.
"""

from collections.abc import Callable, Collection, Sequence
from typing import Final

import numpy as np

from gnd.cloud_merger.errors import BadReport
from gnd.cloud_merger.features.association import HEIGHT_KNOWN_M2
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.errors import FeatureError
from gnd.gnd_map.features import UNKNOWN_HEIGHT_M2, check_simple_polyline, full_covariance
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.feature_change import LANE_KINDS, FeatureChange, Found
from gnd.schemas.feature_layer import LayerParameters
from gnd.schemas.features import FeatureReport

_ROUNDING: Final = 1.01
"""Covariances travel on levels that are some per cent apart; a limit that is met before is met after."""

Numbered = tuple[int, Found]
IdsOf = Callable[[TileId, bytes], Collection[int] | None]
"""Ids of the features of a version of a tile, by hash; None: there is no such version."""

_MIN_SIGMA_M: Final = 1e-3
"""No vehicle knows a place better in any direction: below the millimetre is a mistake of units."""
_MAX_SIGMA_M: Final = 30.0
"""Horizontally; a place known no better than this is none."""
_MAX_OUTSIDE_M: Final = 25.0
"""A measured map feature may lie this far outside its tile."""
_MIN_VERDICTS: Final = 5
"""From so many judged map features on the share of deleted ones is looked at."""
_MAX_DELETED_SHARE: Final = 0.5
"""A drive that finds a larger share of the map's features gone has not looked, or lies."""
_MAX_FEATURES_OF_TILE: Final = 256
"""Found and judged features of one tile of 38 m."""
_MAX_VERTICES: Final = 512
"""Vertices of a found polyline in one tile."""
_DUPLICATE_M: Final = 0.1
"""Two found features of one kind that are nearer than this and alike are one, sent twice."""


def check_feature_report(report: FeatureReport, ids_of: IdsOf, layer: LayerParameters | None = None) -> None:
    """Refuse a report that cannot be a true statement about this map.

    Args:
        report: that came.
        ids_of: what the map holds.
        layer: its declaration; None: the layer takes any kind and geometry.

    Raises:
        BadReport: says what is wrong with it, and where, with numbers.
    """
    _check_verdicts(report)
    for change in report.tiles:
        _check_amount(change)
        _check_base(change, ids_of)
        for seen in change.seen:
            if seen.position_m is not None and seen.cov_m2 is not None:
                name = f"tile {change.tile}, map feature {seen.feature_id}"
                _check_covariance(name, seen.cov_m2)
                _check_inside(name, change.tile, seen.position_m)
        for number, found in enumerate(change.found):
            name = f"tile {change.tile}, found {found.kind} {number}"
            _check_found(name, found)
            if layer is not None:
                _check_of_layer(name, found, layer)
        _check_duplicates(change)


def _check_verdicts(report: FeatureReport) -> None:
    judged = [seen.existence.state for change in report.tiles for seen in change.seen]
    gone = judged.count("absent")
    if len(judged) >= _MIN_VERDICTS and gone > _MAX_DELETED_SHARE * len(judged):
        raise BadReport(
            f"{gone} of {len(judged)} judged features are called deleted, the limit is "
            f"{_MAX_DELETED_SHARE:g} of {_MIN_VERDICTS} or more: so much does not go at once"
        )


def _check_amount(change: FeatureChange) -> None:
    if change.n_features > _MAX_FEATURES_OF_TILE:
        raise BadReport(
            f"tile {change.tile}: {len(change.found)} features found, {len(change.seen)} judged, the limit is "
            f"{_MAX_FEATURES_OF_TILE} together"
        )


def _check_base(change: FeatureChange, ids_of: IdsOf) -> None:
    if not change.base_sha:
        return
    known = ids_of(change.tile, change.base_sha)
    if known is None:
        return  # the version has gone: what the report names speaks, and it says nothing of what it does not name
    strange = [seen.feature_id for seen in change.seen if seen.feature_id not in known]
    if strange:
        raise BadReport(
            f"tile {change.tile}: judges feature {strange[0]}, one of {len(strange)} that version "
            f"{change.base_version} with its {len(known)} features has not"
        )


def _check_of_layer(name: str, found: Found, layer: LayerParameters) -> None:
    """Refuse what a declared layer does not hold."""
    if found.kind not in layer.kinds:
        raise BadReport(f"{name}: layer {layer.name} is declared to hold {', '.join(layer.kinds)}")
    if (len(found.points_m) == 1) != (layer.geometry == "point"):
        raise BadReport(f"{name} has {len(found.points_m)} vertices, layer {layer.name} holds {layer.geometry}s")


def _check_found(name: str, found: Found) -> None:
    _check_covariance(name, found.cov_m2)
    if len(found.points_m) > _MAX_VERTICES:
        raise BadReport(f"{name} has {len(found.points_m)} vertices, the limit is {_MAX_VERTICES} a tile")
    if len(found.points_m) > 2 and found.kind.startswith(LANE_KINDS):
        try:
            check_simple_polyline(name, found.points_m)
        except FeatureError as error:
            raise BadReport(str(error)) from error


def _check_covariance(name: str, cov_m2: F64) -> None:
    cov = full_covariance(cov_m2)
    least = float(np.linalg.eigvalsh(cov)[0])
    if least * _ROUNDING < _MIN_SIGMA_M**2:
        what = "not positive" if least <= 0 else f"{least**0.5:.2g} m in one direction"
        raise BadReport(f"{name}: sigma {what}, nobody measures better than {_MIN_SIGMA_M:g} m")
    most = float(np.linalg.eigvalsh(cov[:2, :2])[-1])
    if most > _MAX_SIGMA_M**2 * _ROUNDING:
        raise BadReport(f"{name}: known to {most**0.5:.3g} m only, the limit is {_MAX_SIGMA_M:g} m")
    if cov[2, 2] > UNKNOWN_HEIGHT_M2 * _ROUNDING**2 * 1.1:
        raise BadReport(
            f"{name}: variance {cov[2, 2]:.3g} m² of its height, {UNKNOWN_HEIGHT_M2:g} m² stands for unknown"
        )


def _check_inside(name: str, tile: TileId, position_m: F64) -> None:
    (south, west), (north, east) = tile.south_west_rad, tile.north_east_rad
    corners = LocalFrame.of_tile(tile).enu_from_geodetic([south, south, north, north], [west, east, west, east], 0.0)
    outside_m = float((np.abs(position_m[:2]) - np.abs(corners[:, :2]).max(axis=0)).max())
    if outside_m > _MAX_OUTSIDE_M:
        raise BadReport(f"{name} was measured {outside_m:.1f} m outside its tile, the limit is {_MAX_OUTSIDE_M:g} m")


def _check_duplicates(change: FeatureChange) -> None:
    """Found points of one kind at the same place, within their own covariances, of which nothing tells them apart."""
    points = [(number, found) for number, found in enumerate(change.found) if len(found.points_m) == 1]
    for (i, a), (j, b) in _near(points, _DUPLICATE_M):
        if (a.kind, a.attributes) != (b.kind, b.attributes):
            continue
        apart, both = a.points_m[0] - b.points_m[0], full_covariance(a.cov_m2 + b.cov_m2)
        has_heights = both[2, 2] < HEIGHT_KNOWN_M2
        if has_heights and abs(apart[2]) > _DUPLICATE_M:
            continue
        if apart @ np.linalg.solve(both, apart) <= 1.0:
            raise BadReport(
                f"tile {change.tile}: found {a.kind} {i} and {j} lie {float(np.hypot(*apart[:2])):.3f} m apart, less "
                f"than their sigma and {_DUPLICATE_M:g} m: one feature twice"
            )


def _near(points: Sequence[Numbered], within_m: float) -> list[tuple[Numbered, Numbered]]:
    """Pairs of points that are horizontally so near, in order."""
    if len(points) < 2:
        return []
    from scipy.spatial import cKDTree  # here because the import is dear, and few shards merge features

    xy = np.array([found.points_m[0, :2] for _, found in points])
    return [(points[i], points[j]) for i, j in sorted(cKDTree(xy).query_pairs(within_m))]
