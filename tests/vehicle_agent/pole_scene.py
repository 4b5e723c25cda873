"""Small scenes for the pole detector: what a simulated LiDAR that stands on a level road sees of some shapes."""

from collections.abc import Sequence

import numpy as np

from gnd.fleet_sim import parts
from gnd.fleet_sim.lidar import Lidar
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.sensors import MODELS
from gnd.fleet_sim.shapes import Block, Post, Shape
from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.poles.detector import Rays

LIDAR_M = 1.9
GROUND = Block(0.0, 0.0, 150.0, 150.0, -1.0, 0.0)


def rays_of(
    shapes: Sequence[Shape], sensor: str = "VLP-16", seed: int = 0, place_m: tuple[float, float] = (0, 0)
) -> Rays:
    """One sweep of a sensor that stands above a place of the road, looking along x; frame of the shapes."""
    model = MODELS[sensor]
    T = np.eye(4)
    T[:3, 3] = *place_m, LIDAR_M
    poses = np.broadcast_to(T, (model.columns + 1, 4, 4)).copy()
    scene = Scene.build((GROUND, *shapes))
    points = Lidar(model).sweep(scene, poses, np.random.default_rng(seed)).points_lidar_m
    return Rays(points.astype(np.float64) + T[:3, 3], T[:3, 3].copy())


def post(x_m: float, y_m: float, radius_m: float = 0.1, top_m: float = 4.0, bottom_m: float = 0.0) -> tuple[Shape, ...]:
    """One upright cylinder."""
    return (Post(x_m, y_m, radius_m, bottom_m - (0.2 if bottom_m == 0.0 else 0.0), top_m),)


def lamp(x_m: float, y_m: float) -> tuple[Shape, ...]:
    return parts.lamp(x_m, y_m, 0.0, 1)


def sign(x_m: float, y_m: float) -> tuple[Shape, ...]:
    return parts.sign(x_m, y_m, 0.0, 0.8, 2.5, 0.0)


def tree(x_m: float, y_m: float) -> tuple[Shape, ...]:
    return parts.tree(x_m, y_m, 0.0, 3)


def origin() -> F64:
    return np.array([0.0, 0.0, LIDAR_M])
