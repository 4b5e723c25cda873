"""Features of tiles in a vehicle's map frame, and back."""

from collections.abc import Iterable

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import UNKNOWN_HEIGHT_M2, Feature, FeatureTile, full_covariance, six_of
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.features.look import MapFeatures


def features_in_map(frame: LocalFrame, tile: FeatureTile, kinds: Iterable[str] = ()) -> MapFeatures:
    """The point features of a tile in the map frame.

    Args:
        frame: the map frame.
        tile: any tile near it.
        kinds: only these; none named = all.
    """
    wanted = set(kinds)
    points = [one for one in tile.features if one.is_point and (not wanted or one.kind in wanted)]
    T = frame.T_self_other(LocalFrame.of_tile(tile.tile_id))
    xyz = np.array([T[:3, :3] @ one.position_m + T[:3, 3] for one in points]).reshape(len(points), 3)
    return MapFeatures(
        feature_id=np.array([one.feature_id for one in points], np.int64),
        kind=tuple(one.kind for one in points),
        xy_m=xyz[:, :2].copy(),
        z_m=np.where([knows_height(one) for one in points], xyz[:, 2], np.nan) if points else np.zeros(0),
        cov=np.array([(T[:3, :3] @ full_covariance(one.cov_m2) @ T[:3, :3].T)[:2, :2] for one in points]).reshape(
            -1, 2, 2
        ),
    )


def knows_height(feature: Feature) -> bool:
    """Whether the feature's height was ever measured."""
    return bool(feature.cov_m2[5] < 0.5 * UNKNOWN_HEIGHT_M2)


def place_in_tile(frame: LocalFrame, xyz_m: F64, cov: F64, tile: TileId | None = None) -> tuple[TileId, F64, F64]:
    """A point of the map frame in a tile.

    Args:
        frame: the map frame.
        xyz_m: (3,).
        cov: (3, 3) m².
        tile: in whose frame; None = the tile that holds the point.

    Returns:
        The tile, the point (1, 3) in its ENU frame, and its covariance as six values.
    """
    if tile is None:
        lat, lon, _ = frame.geodetic_from_enu(xyz_m[None])
        tile = TileId.from_geodetic(float(lat[0]), float(lon[0]))
    T = LocalFrame.of_tile(tile).T_self_other(frame)
    return tile, (T[:3, :3] @ xyz_m + T[:3, 3])[None], six_of(T[:3, :3] @ cov @ T[:3, :3].T)


def with_height(xy_m: F64, cov_xy: F64, z_m: float, sigma_z_m: float, unknown_z_m: float) -> tuple[F64, F64]:
    """A point (3,) and its covariance (3, 3) from a horizontal one; `unknown_z_m` stands in for a height of nan."""
    cov = np.zeros((3, 3))
    cov[:2, :2] = cov_xy
    cov[2, 2] = sigma_z_m**2 if np.isfinite(z_m) else UNKNOWN_HEIGHT_M2
    return np.array([*xy_m, z_m if np.isfinite(z_m) else unknown_z_m]), cov
