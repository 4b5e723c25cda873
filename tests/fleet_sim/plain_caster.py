"""A plain ray caster: every ray against every primitive, each formulated in another way than the kernels."""

import math

import numpy as np

from gnd.fleet_sim.lidar import Hits, Lidar
from gnd.fleet_sim.shapes import Ball, Block, Post, Shape


def _planes(block: Block) -> list[tuple[np.ndarray, float]]:
    """Outward normals n and offsets d of the faces, n·p <= d inside, in the frame of the scene."""
    c, s = math.cos(block.yaw_rad), math.sin(block.yaw_rad)
    first, second, up = np.array([c, s, 0.0]), np.array([-s, c, 0.0]), np.array([0.0, 0.0, 1.0])
    centre = np.array([block.x_m, block.y_m, 0.0])
    lid = up - block.rise_x * first - block.rise_y * second
    return [
        (first, first @ centre + block.half_x_m),
        (-first, -first @ centre + block.half_x_m),
        (second, second @ centre + block.half_y_m),
        (-second, -second @ centre + block.half_y_m),
        (-up, -block.bottom_m),
        (lid, lid @ centre + block.top_m),
    ]


def _through_convex(planes: list[tuple[np.ndarray, float]], o: np.ndarray, d: np.ndarray) -> tuple[float, float]:
    entry, leave = -math.inf, math.inf
    for n, offset in planes:
        speed, distance = float(n @ d), float(n @ o - offset)
        if abs(speed) < 1e-12:
            if distance > 0:
                return math.inf, -math.inf
        elif speed < 0:
            entry = max(entry, -distance / speed)
        else:
            leave = min(leave, -distance / speed)
    return entry, leave


def _through_post(post: Post, o: np.ndarray, d: np.ndarray) -> tuple[float, float]:
    slab = _through_convex([(np.array([0, 0, 1.0]), post.top_m), (np.array([0, 0, -1.0]), -post.bottom_m)], o, d)
    flat = math.hypot(d[0], d[1])
    to_axis = np.array([post.x_m, post.y_m]) - o[:2]
    if flat < 1e-12:
        return slab if np.linalg.norm(to_axis) < post.radius_m else (math.inf, -math.inf)
    unit = d[:2] / flat
    along, aside = float(unit @ to_axis), float(unit[0] * to_axis[1] - unit[1] * to_axis[0])
    if abs(aside) >= post.radius_m:
        return math.inf, -math.inf
    half = math.sqrt(post.radius_m**2 - aside**2)
    return max(slab[0], (along - half) / flat), min(slab[1], (along + half) / flat)


def _through_ball(ball: Ball, o: np.ndarray, d: np.ndarray) -> tuple[float, float]:
    length = float(np.linalg.norm(d))
    to_centre = np.array([ball.x_m, ball.y_m, ball.z_m]) - o
    along = float(to_centre @ d) / length
    miss = float(np.linalg.norm(to_centre - along * d / length))
    if miss >= ball.radius_m:
        return math.inf, -math.inf
    half = math.sqrt(ball.radius_m**2 - miss**2)
    return (along - half) / length, (along + half) / length


def plain_range(shapes: list[Shape], o: np.ndarray, d: np.ndarray, range_m: float) -> float:
    best = math.inf
    for shape in shapes:
        match shape:
            case Block():
                entry, leave = _through_convex(_planes(shape), o, d)
            case Post():
                entry, leave = _through_post(shape, o, d)
            case Ball():
                entry, leave = _through_ball(shape, o, d)
        if 0 < entry <= leave:
            best = min(best, entry)
    return best if best < range_m else math.inf


def plain_returns(
    lidar: Lidar, hits: Hits, packed: np.ndarray, drawn: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points, times, rings and primitives of what comes back, all shots at once: the plain twin of `fill_returns`."""
    model, (normal, even), met = lidar.model, drawn, hits.primitive >= 0
    noisy = hits.range_m + model.range_sigma_m * normal
    bright = np.where(met, packed[np.maximum(hits.primitive, 0), 12], 1.0) * hits.incidence
    limit = model.dark_m * np.sqrt(bright / 0.1)
    chance = np.clip((1.1 * limit - hits.range_m) / (0.2 * limit + 1e-9), 0.0, 1.0) * (1.0 - model.loss)
    seen = met & (even < chance) & (noisy >= model.range_min_m) & (noisy <= model.range_max_m)
    step = model.range_step_m
    given = np.round(noisy[seen] / step) * step if step else noisy[seen]
    points = np.round(model.directions()[seen] * given[:, None] * 512.0) / 512.0
    rings = np.broadcast_to(model.rings, met.shape)
    return points.astype(np.float32), model.shot_times_ns()[seen], rings[seen], hits.primitive[seen]
