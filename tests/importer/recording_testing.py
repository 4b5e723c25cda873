"""A room to scan, and what a LiDAR sees of it on a known way."""

from pathlib import Path

import numpy as np

STEP_M = 0.5
TURN_RAD = 0.01


def room(rng: np.random.Generator, n: int = 60_000) -> np.ndarray:
    """(N, 3) points on the floor, walls and boxes of a room, axes of its first scan, floor 1.73 m below."""
    u, v = rng.uniform(-1, 1, (2, n))
    kind = np.maximum(rng.integers(-3, 7, n), 0)  # most points on the floor, as a LiDAR on a car has
    floor, zero = np.full(n, -1.73), np.zeros(n)
    faces = [
        (18 * u, 11 * v, floor),
        (18 * u, 11 + zero, 2 * v),
        (18 * u, -11 + zero, 2 * v),
        (18 + zero, 11 * u, 2 * v),
        (-18 + zero, 11 * u, 2 * v),
        (8 + 2 * u, 6 + 0.4 * np.sign(v), 1.5 * v),
        (-6 + 0.3 * np.sign(v), -4 + 3 * u, 1.2 * v),
    ]
    return np.stack([np.choose(kind, [face[axis] for face in faces]) for axis in range(3)], axis=1)


def true_pose(k: int) -> np.ndarray:
    """(4, 4) of scan k before scan 0: forward and slowly to the left."""
    T = np.eye(4)
    c, s = np.cos(TURN_RAD * k), np.sin(TURN_RAD * k)
    T[:2, :2] = [[c, -s], [s, c]]
    T[:2, 3] = STEP_M * k, 0.5 * STEP_M * TURN_RAD * k * k
    return T


def scan_of(k: int, n: int = 48_000) -> np.ndarray:
    """(n, 3) what the LiDAR sees from pose k, 1 cm of noise."""
    rng = np.random.default_rng(k)
    T = true_pose(k)
    points = room(rng, n)
    return (points - T[:3, 3]) @ T[:3, :3] + rng.normal(0, 0.01, points.shape)


def write_bin(path: Path, points: np.ndarray) -> None:
    path.write_bytes(np.column_stack([points, np.ones(len(points))]).astype(np.float32).tobytes())
