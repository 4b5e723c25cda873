"""Posts: what a LiDAR map and a vector HD map have in common.

Of a LiDAR map they are upright columns of Gaussians that are thin both ways; of an HD map its poles, lamps, signs and
traffic lights. Both hold posts that the other does not: trunks and corners of walls, and signs on walls.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Final

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.tile_store.feature_io.errors import UnknownFormat
from gnd.tile_store.feature_io.formats import format_of, read_features
from gnd.tile_store.feature_io.values import ImportOptions, MapFeature
from gnd.vehicle_agent.map_align.cloud import GaussianCloud

KINDS: Final = frozenset({"pole", "streetlight", "traffic_sign", "traffic_light", "trunk", "tree"})
UPRIGHT: Final = 0.9
"""Cosine of the long axis of a post's Gaussian against the vertical."""
COLUMN_M: Final = 0.35
"""Gaussians of one post lie so near each other, seen from above."""
HIGH_M: Final = 0.8
"""From the lower end of the lowest to the upper end of the highest. A voxel of 1 m that holds nothing but a part of a
post is enough: near the ground and beside a plate the same post does not look like one."""
WIDE_M: Final = 0.25
"""Standard deviation of their places, at most; edges of hedges and cars are wider."""
ONE_POST_M: Final = 0.7
"""Signs on one post, and a lamp with a sign, are one."""


def is_vector_map(path: Path) -> bool:
    """Whether a file is an HD map of a format that is read."""
    try:
        format_of(path)
    except UnknownFormat:
        return False
    return path.is_file()


def features_of(path: Path) -> tuple[MapFeature, ...]:
    """The features of an HD map that stand on a post.

    Raises:
        FeatureFileError: it cannot be read.
    """
    layers = dict.fromkeys(KINDS, "poles")
    read = read_features(path, path.stem[:200] or "map", ImportOptions(layers=layers))
    return tuple(one for one in read.features if one.kind in KINDS)


def posts_of_features(features: Iterable[MapFeature], frame: LocalFrame) -> F64:
    """(N, 2) where the posts stand in a frame; several features on one post are one."""
    return _merged(np.array([one.enu_m(frame)[:, :2].mean(axis=0) for one in features]).reshape(-1, 2), ONE_POST_M)


def posts_of_cloud(cloud: GaussianCloud) -> F64:
    """(N, 2) of the upright columns of a LiDAR map."""
    upright = cloud.take(cloud.is_post & (np.abs(cloud.axes[:, 2, 2]) > UPRIGHT))
    if not len(upright):
        return np.zeros((0, 2))
    column = _groups(upright.mean_m[:, :2], COLUMN_M)
    found = []
    for rows in np.split(np.argsort(column, kind="stable"), np.cumsum(np.bincount(column))[:-1]):
        places, half_m = upright.mean_m[rows], np.sqrt(3.0 * upright.variance_m2[rows, 2])
        high_m = (places[:, 2] + half_m).max() - (places[:, 2] - half_m).min()
        if high_m >= HIGH_M and places[:, :2].std(axis=0).max() <= WIDE_M:
            found.append(places[:, :2].mean(axis=0))
    return np.array(found).reshape(-1, 2)


def _merged(points: F64, apart_m: float) -> F64:
    """Points (N, 2) with those that lie together replaced by their middle."""
    if not len(points):
        return points
    group = _groups(points, apart_m)
    return np.stack([np.bincount(group, axis) for axis in points.T], axis=1) / np.bincount(group)[:, None]


def _groups(points: F64, apart_m: float) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """(N,) number of the group of each point: those that steps of `apart_m` connect."""
    pairs = cKDTree(points).query_pairs(apart_m, output_type="ndarray")
    links = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(points), len(points)))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)
