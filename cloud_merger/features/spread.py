"""What lies near a tile's border is reported to the neighbour too.

A drive may know its place to metres only, so one and the same lamp is found by one vehicle in this tile, by another in
the next. Both tiles hear of both, come to the same estimate by the same steps, and that tile alone publishes in which
it lay when it was first confirmed.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.feature_change import FeatureChange, Found
from gnd.schemas.features import FeatureReport

_SIGMAS: Final = 4.0
_LEAST_M: Final = 1.0


def spread(report: FeatureReport, reach_m: float) -> dict[TileId, FeatureReport]:
    """The parts of a report by the tile that is to hear of them, each under the same id.

    The tile's own part, and of its neighbours what was found near the border (without views and verdicts). A tile of
    another district may be among them; its part still names the district of the report.

    Args:
        report: as it came.
        reach_m: `FeatureMergeParameters.reach_m`.
    """
    parts: dict[TileId, list[FeatureChange]] = {change.tile: [change] for change in report.tiles}
    for change in report.tiles:
        for tile in around(change.tile) if change.found else ():
            near = tuple(one for one in change.found if near_border(tile, change.tile, one, reach_m))
            if near:
                parts.setdefault(tile, []).append(
                    replace(change, base_version=0, base_sha=b"", viewed=0, seen=(), found=near)
                )
    return {
        tile: replace(report, tiles=tuple(sorted(changes, key=lambda change: change.tile)))
        for tile, changes in sorted(parts.items())
    }


def near_border(tile: TileId, source: TileId, found: Found, reach_m: float) -> bool:
    """Whether what was found in the tile `source` may lie in its neighbour `tile`, or be what lies there.

    Twice the reach at most: this tile must hear of all that is associated with what it may publish. Polylines are cut
    at borders.
    """
    if len(found.points_m) > 1:
        return False
    sigma_m = float(np.sqrt(found.cov_m2[0] + found.cov_m2[3]))
    half_m = _half_extent_m(tile)
    halo_m = min(_SIGMAS * sigma_m + _LEAST_M, 2.0 * reach_m, 2.0 * float(half_m.min()))
    place_m = found.points_m[0] - between(source, tile)[:3, 3]
    return bool((np.abs(place_m[:2]) - half_m).max() <= halo_m)


@lru_cache(maxsize=4096)
def around(tile: TileId) -> tuple[TileId, ...]:
    """The tiles around a tile, remembered."""
    return tile.neighbours()


@lru_cache(maxsize=16384)
def between(tile: TileId, other: TileId) -> F64:
    """(4, 4) from the frame of `other` to that of `tile`."""
    return LocalFrame.of_tile(tile).T_self_other(LocalFrame.of_tile(other))


@lru_cache(maxsize=4096)
def _half_extent_m(tile: TileId) -> F64:
    """(2,) how far the tile reaches from its centre, east and north."""
    (south, west), (north, east) = tile.south_west_rad, tile.north_east_rad
    corners = LocalFrame.of_tile(tile).enu_from_geodetic([south, south, north, north], [west, east, west, east], 0.0)
    return np.asarray(np.abs(corners[:, :2]).max(axis=0), np.float64)
