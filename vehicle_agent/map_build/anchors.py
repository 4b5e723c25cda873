"""Places along the drives that loops are looked for at: a small cloud of what was seen there, and a map around it.

A cloud and a map are made of the samples of one pass only, as its own poses lay them, in the frame of the vehicle at
the anchor: over so short a way odometry is good to centimetres, whatever it has drifted by since.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse, transform
from gnd.vehicle_agent.localise.match_map import MatchMap
from gnd.vehicle_agent.map_build.survey import DriveSurvey

EVERY_M: Final = 10.0
CLOUD_M, MAP_M = 10.0, 35.0
"""Way before and after an anchor whose scans make its cloud and its map."""
LEAF_M, CLOUD_POINTS = 0.25, 5000
MIN_POINTS, MIN_CELLS = 10, 8
"""Of a voxel with a Gaussian: points, and 10 cm cells that they fill."""
LINE_RATIO, UPRIGHT = 0.1, 0.7
"""A Gaussian whose second variance is less than this share of its largest is a ring of one scan, unless upright."""
MAPS_KEPT: Final = 64
_NOISE_M: Final = 0.04


@dataclass(frozen=True, slots=True)
class PoseAnchor:
    """A place of a drive: number of the drive, of the scan in its survey; its time and odometer."""

    drive: int
    scan: int
    t_ns: int
    way_m: float


class PoseAnchors:
    """The anchors of all drives, N in all, in the order of the drives and of time."""

    def __init__(self, surveys: Sequence[DriveSurvey], tracks: Sequence[Trajectory], from_m: float = 0.0) -> None:
        """Anchors every `EVERY_M` of way, the first of each drive `from_m` after its start."""
        self._surveys = surveys
        self._T_scan = [track.at(survey.t_ns) for survey, track in zip(surveys, tracks, strict=True)]
        self.all = tuple(
            PoseAnchor(drive, int(k), int(survey.t_ns[k]), float(survey.way_m[k]))
            for drive, survey in enumerate(surveys)
            for k in _every(survey.way_m, from_m, EVERY_M)
        )
        self.drive = np.array([one.drive for one in self.all], np.int64)
        self.way_m = np.array([one.way_m for one in self.all], np.float64)
        self.map_of = lru_cache(MAPS_KEPT)(self._map_of)
        """The map around an anchor, in its frame, by its number; None where too little was seen."""
        self.cloud_of = lru_cache(4 * MAPS_KEPT)(self._cloud_of)
        """Points (K, 3) around an anchor, in its frame, by its number."""

    def __len__(self) -> int:
        return len(self.all)

    def poses(self) -> F64:
        """(N, 4, 4) T_map_vehicle at the anchors, by the tracks that they were made with."""
        return np.stack([self._T_scan[one.drive][one.scan] for one in self.all])

    def _around(self, number: int, reach_m: float) -> F64:
        one = self.all[number]
        survey, T = self._surveys[one.drive], self._T_scan[one.drive]
        near = np.flatnonzero(np.abs(survey.way_m - one.way_m) <= reach_m)
        T_anchor_scan = T_inverse(T[one.scan]) @ T[near]
        clouds = [
            transform(step, survey.samples[k].astype(np.float64)) for k, step in zip(near, T_anchor_scan, strict=True)
        ]
        return np.concatenate(clouds)

    def _cloud_of(self, number: int) -> F64:
        return _thinned(self._around(number, CLOUD_M), LEAF_M, CLOUD_POINTS)

    def _map_of(self, number: int) -> MatchMap | None:
        return match_map_of(self._around(number, MAP_M))


def _thinned(points_m: F64, leaf_m: float, n: int) -> F64:
    """The first of the points (N, 3) in each cube of `leaf_m`, and of these at most n, evenly through their order."""
    cubes = np.floor(points_m / leaf_m).astype(np.int64) + (1 << 20)
    key = (cubes[:, 0] << 42) | (cubes[:, 1] << 21) | cubes[:, 2]
    first = np.sort(np.unique(key, return_index=True)[1])
    if len(first) > n:
        first = first[np.linspace(0, len(first) - 1, n).astype(np.int64)]
    return np.asarray(points_m[first])


def _every(way_m: F64, from_m: float, step_m: float) -> list[int]:
    chosen: list[int] = []
    for k, at_m in enumerate(way_m):
        if at_m >= (way_m[chosen[-1]] + step_m if chosen else from_m):
            chosen.append(k)
    return chosen


def match_map_of(points_m: F64) -> MatchMap | None:
    """Gaussians of 1 m voxels over points (N, 3), ready for registration; None without any."""
    if not len(points_m):
        return None
    g = np.floor(points_m).astype(np.int64)
    origin = g.min(axis=0) - 1
    shape = g.max(axis=0) - origin + 2
    flat = np.ravel_multi_index(tuple((g - origin).T), tuple(shape))
    voxels, row = np.unique(flat, return_inverse=True)
    count = np.bincount(row)
    mean = np.stack([np.bincount(row, points_m[:, k]) for k in range(3)], axis=1) / count[:, None]
    off = points_m - mean[row]
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    cov = np.stack([np.bincount(row, off[:, i] * off[:, j]) for i, j in pairs], axis=1) / count[:, None]
    good = (count >= MIN_POINTS) & (_cells(points_m, row, len(voxels)) >= MIN_CELLS)
    good[good] = ~_lines(cov[good])
    if not good.any():
        return None
    index = np.full(int(np.prod(shape)), -1, np.int32)
    index[voxels[good]] = np.arange(int(good.sum()), dtype=np.int32)
    return MatchMap.of(index.reshape(shape), np.eye(3), -origin.astype(np.float64), mean[good], cov[good], _NOISE_M)


def _cells(points_m: F64, row: I64, voxels: int) -> I64:
    """(voxels,) number of 10 cm cells that the points of each voxel fill."""
    c = np.floor((points_m - np.floor(points_m)) * 10.0).astype(np.int64).clip(0, 9)
    taken = np.unique(row * 1000 + (c[:, 0] * 10 + c[:, 1]) * 10 + c[:, 2])
    return np.bincount(taken // 1000, minlength=voxels)


def _lines(cov: F64) -> "np.ndarray[tuple[int], np.dtype[np.bool_]]":
    full = cov[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    values, vectors = np.linalg.eigh(full)
    return np.asarray((values[:, 1] < LINE_RATIO * values[:, 2]) & (np.abs(vectors[:, 2, 2]) < UPRIGHT))
