"""A walled yard that looks different from everywhere: points of its surfaces, its map, and what a LiDAR in it sees."""

import numpy as np

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3, transform
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import covering_circle
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.match_map import MatchMap, MatchMapCache

FRAME = LocalFrame(np.radians(37.5597), np.radians(127.0364), 30.0)
GRID_FRAME = GridFrame.around(FRAME, covering_circle(FRAME.lat_rad, FRAME.lon_rad, 90.0))
GROUND_M = 0.4  # height of the ground in the map frame: off the floor between two voxels
NOISE_M = 0.02


def rectangle(rng, corner, side_a, side_b, per_m2):
    """Random points on a parallelogram."""
    a, b = np.asarray(side_a, float), np.asarray(side_b, float)
    n = int(per_m2 * np.linalg.norm(np.cross(a, b)))
    return np.asarray(corner, float) + rng.uniform(size=(n, 1)) * a + rng.uniform(size=(n, 1)) * b


def yard(rng, per_m2=60.0, turn_rad=0.3):
    """(N, 3) points without noise: ground 70 x 44 m, walls with gaps and corners, sheds, poles."""
    wall = lambda x, y, dx, dy, h: rectangle(rng, (x, y, GROUND_M), (dx, dy, 0), (0, 0, h), per_m2)  # noqa: E731
    parts = [
        rectangle(rng, (-35, -22, GROUND_M), (70, 0, 0), (0, 44, 0), per_m2),
        wall(-35, 21.7, 40, 0, 6),
        wall(9, 21.7, 26, 0, 4),
        wall(5, 17.3, 0, 4.4, 6),
        wall(-33, -21.6, 22, 0, 5),
        wall(-6, -19.2, 40, 0, 5),
        wall(34.4, -19, 0, 30, 5),
        wall(-34.6, -15, 0, 30, 7),
    ]
    for x, y, a, b, h in (
        (14.3, 8.2, 4, 6, 3),
        (-17.6, -9.7, 7, 3, 2.5),
        (-12.4, 11.8, 3, 3, 4),
        (22.7, -9.4, 2, 5, 2),
    ):
        parts += [wall(x, y, a, 0, h), wall(x, y + b, a, 0, h), wall(x, y, 0, b, h), wall(x + a, y, 0, b, h)]
    for x, y in ((3.2, 9.7), (-5.1, -8.3), (9.4, -11.9), (-24.3, 5.4), (27.8, 3.3), (-2.6, 14.6)):
        angle, z = rng.uniform(0, 2 * np.pi, 900), rng.uniform(0, 5, 900)
        parts.append(np.column_stack([x + 0.12 * np.cos(angle), y + 0.12 * np.sin(angle), GROUND_M + z]))
    return np.concatenate(parts) @ exp_so3([0.0, 0.0, turn_rad]).T


def corridor(rng, per_m2=60.0):
    """(N, 3) two long walls and the ground between them: nothing tells where along it one is."""
    wall = lambda y: rectangle(rng, (-80, y, GROUND_M), (160, 0, 0), (0, 0, 5), per_m2)  # noqa: E731
    return np.concatenate([rectangle(rng, (-80, -5, GROUND_M), (160, 0, 0), (0, 10, 0), per_m2), wall(-5.3), wall(5.6)])


def local_map_of(points_map_m):
    accumulator, local_map = VoxelAccumulator(GRID_FRAME), LocalMap(GRID_FRAME)
    accumulator.add(points_map_m)
    for tile_id, gaussians in accumulator.finish().items():
        local_map.set_tile(Tile(tile_id, 1, gaussians))
    return local_map


def match_map_of(local_map, near=(0.0, 0.0, 0.0), noise_m=0.04) -> MatchMap:
    return MatchMapCache(local_map, noise_m).near(np.asarray(near, float))


def pose(x, y, yaw_deg, roll_deg=0.0, pitch_deg=0.0, z=GROUND_M):
    """(4, 4) T_map_vehicle, the vehicle's origin on the ground."""
    R = exp_so3([0.0, 0.0, np.radians(yaw_deg)]) @ exp_so3([np.radians(roll_deg), np.radians(pitch_deg), 0.0])
    return T_from_R_t(R, [x, y, z])


def seen_from(rng, surfaces, T_map_vehicle, n=12_000, reach_m=30.0):
    """(N, 3) noisy points of `surfaces` around the vehicle, in its frame, in random order; nothing hides anything."""
    points = transform(T_inverse(T_map_vehicle), surfaces)
    distance = np.linalg.norm(points, axis=1)
    near = np.flatnonzero((distance > 3.0) & (distance < reach_m))
    weight = 1.0 / distance[near]
    chosen = rng.choice(near, size=min(n, len(near)), replace=False, p=weight / weight.sum())
    return points[chosen] + rng.normal(0.0, NOISE_M, (len(chosen), 3))


def offset(T_true, T):
    """(metres, degrees) between two poses."""
    error = T_inverse(T_true) @ T
    angle = np.arccos(np.clip((np.trace(error[:3, :3]) - 1.0) / 2.0, -1.0, 1.0))
    return float(np.linalg.norm(error[:3, 3])), float(np.degrees(angle))


def moved(rng, T, metres, degrees):
    """A pose shifted by `metres` and turned about the vertical by `degrees`, in a random direction."""
    direction = rng.normal(size=3) * [1.0, 1.0, 0.3]
    shift = metres * direction / np.linalg.norm(direction)
    turn = exp_so3([0.0, 0.0, np.radians(degrees) * rng.choice([-1.0, 1.0])])
    return T @ T_from_R_t(turn, shift)
