"""A yard in which a pose error can be told from a change: ground, walls to all sides, posts."""

from collections.abc import Sequence

import numpy as np
from vehicle_scene import FIGURE_2, GRID_FRAME, GROUND_M

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.se3 import T_inverse, exp_so3, transform
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.estimates import PoseEstimate, RefinedScan
from gnd.vehicle_agent.localise.match_map import MatchMapCache
from gnd.vehicle_agent.packed_rays import PlacedRays
from gnd.vehicle_agent.segment import SegmentedScan

START_NS = 1_570_838_400_000_000_000
EYE_M = np.array([0.0, 0.0, GROUND_M + 1.9])
POSE = np.eye(4)
POSE[:3, 3] = 0.0, 0.0, GROUND_M

Wall = tuple[tuple[float, float], tuple[float, float]]
WALLS: tuple[Wall, ...] = (
    ((-18.3, -12.2), (18.3, -12.2)), ((-18.3, 12.3), (-2.0, 12.3)), ((4.0, 14.2), (18.3, 14.2)),
    ((18.3, -12.2), (18.3, -3.0)), ((17.2, 3.0), (17.2, 12.0)), ((-18.3, -12.2), (-18.3, 12.3)),
    ((6.2, -6.1), (9.1, -6.1)), ((6.2, -8.0), (6.2, -6.1)), ((-9.3, 5.2), (-6.1, 5.2)), ((-6.1, 5.2), (-6.1, 7.3)),
)  # fmt: skip
CORRIDOR: tuple[Wall, ...] = (((-23.0, -6.2), (23.0, -6.2)), ((-23.0, 6.3), (23.0, 6.3)))


def shift(x_m: float = 0.0, y_m: float = 0.0, yaw_deg: float = 0.0, z_m: float = 0.0) -> np.ndarray:
    """(4, 4) an error of a pose, in the vehicle's axes."""
    T = np.eye(4)
    T[:3, :3] = exp_so3(np.array([0.0, 0.0, np.radians(yaw_deg)]))
    T[:3, 3] = x_m, y_m, z_m
    return T


def surfaces(walls: Sequence[Wall], rng: np.random.Generator, per_m2: float, noise_m: float) -> np.ndarray:
    """Points on the ground and on walls 3 m high, map frame."""
    n = int(48 * 40 * per_m2)
    parts = [np.column_stack([rng.uniform(-24, 24, n), rng.uniform(-20, 20, n), np.full(n, GROUND_M)])]
    for a, b in walls:
        m = int(np.hypot(b[0] - a[0], b[1] - a[1]) * 3.0 * per_m2 * 2)
        along = rng.random((m, 1))
        xy = np.asarray(a) * (1 - along) + np.asarray(b) * along
        parts.append(np.column_stack([xy, GROUND_M + rng.uniform(0.2, 3.2, m)]))
    points = np.concatenate(parts)
    return points + rng.normal(0.0, noise_m, points.shape)


def map_of(walls: Sequence[Wall] = WALLS, per_m2: float = 150.0, noise_m: float = 0.01) -> LocalMap:
    """The map of the yard as it was."""
    accumulator = VoxelAccumulator(GRID_FRAME)
    accumulator.add(surfaces(walls, np.random.default_rng(1), per_m2, noise_m))
    local_map = LocalMap(GRID_FRAME)
    for tile_id, gaussians in accumulator.finish().items():
        local_map.set_tile(Tile(tile_id, 1, gaussians))
    for tile_id in FIGURE_2:
        if local_map.tile(TileId(tile_id.morton)) is None:
            local_map.set_absent(tile_id)
    return local_map


def match_maps(local_map: LocalMap) -> MatchMapCache:
    return MatchMapCache(local_map, 0.04)


def seen(walls: Sequence[Wall], seed: int, per_m2: float = 4.0) -> np.ndarray:
    """What is measured of the yard as it is now, map frame, 2 cm of noise."""
    return surfaces(walls, np.random.default_rng(seed), per_m2, 0.02)


def scan(
    points: np.ndarray, number: int, error: np.ndarray | None = None, health: str = "good", sigma_m: float = 0.01
) -> SegmentedScan:
    """A scan every 0.1 s from the middle of the yard, placed with an error of its pose."""
    T = POSE @ (np.eye(4) if error is None else error)
    moved = transform(T @ T_inverse(POSE), points)
    eye = transform(T @ T_inverse(POSE), EYE_M[None])
    pose = PoseEstimate(START_NS + number * 100_000_000, T, sigma_m, 0.0005, 0.9, health)  # type: ignore[arg-type]
    refined = RefinedScan(pose.t_ns, PlacedRays(moved, np.repeat(eye, len(points), axis=0)), pose)
    return SegmentedScan(refined, np.zeros(len(points), np.bool_))
