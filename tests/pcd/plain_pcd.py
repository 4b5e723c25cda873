"""The plain twin of the point kernel: one ray, one leaf cell at a time, written for reading.

Cells of a ray come from sorting the parameters at which it crosses integer planes, not from stepping.
"""

import itertools
import math
from collections import defaultdict

import numpy as np

from studies.pcd import points as rules

SIDE = 5


def stretches(start: np.ndarray, end: np.ndarray, t_first: float, t_last: float, scale: float):
    """(cell, t_in, t_out) of every cell of size `scale` that start + t (end - start) crosses between the two t."""
    cuts = {t_first, t_last}
    for axis in range(3):
        d = end[axis] - start[axis]
        low, high = sorted((start[axis], end[axis]))
        for plane in range(math.ceil(low / scale), math.floor(high / scale) + 1):
            if d != 0.0 and t_first < (t := (plane * scale - start[axis]) / d) < t_last:
                cuts.add(t)
    for t_in, t_out in itertools.pairwise(sorted(cuts)):
        middle = start + (end - start) * (t_in + t_out) / 2
        yield tuple(math.floor(c / scale) for c in middle), t_in, t_out


class PlainPcd:
    """Counts as `PcdDetector` does, with the meaning of its parameters."""

    def __init__(self, detector) -> None:
        self.index = detector.index
        base = self.index.base
        self.shape = np.array(base.shape)
        self.points, self.normals = base.point_m.astype(float), base.normal.astype(float)
        self.cell = {tuple(c): u for u, c in enumerate(self.index.cells.tolist())}
        self.map_blocks = {tuple(x // SIDE for x in c) for c in self.cell}
        self.hits, self.passes = np.zeros(len(self.points), int), np.zeros(len(self.points), int)
        self.block_passes = defaultdict(int)
        self.new_blocks: set[tuple[int, ...]] = set()
        self.new_hits, self.new_passes = defaultdict(int), defaultdict(int)

    def scan(self, points: np.ndarray, origins: np.ndarray, moving: np.ndarray) -> None:
        A, b = self.index.window_affine(0.5 * (origins[0] + origins[-1]))
        anchor = self.index.anchor_m
        for point, origin, moves in zip(points - anchor, origins - anchor, moving, strict=True):
            self.ray(origin, point, A @ origin + b, A @ point + b, bool(moves))

    def ray(self, o, p, g0, g1, moves) -> None:
        length = float(np.linalg.norm(p - o))
        if length <= rules.RANGE_M[0]:
            return
        first, last = self._clip(g0, g1 - g0, min(1.0, rules.RANGE_M[1] / length))
        if first >= last:
            return
        blocks = list(stretches(g0, g1, first, last, SIDE))
        for block, _, _ in blocks[:-1]:
            if block not in self.map_blocks and block not in self.new_blocks:
                self.block_passes[block] += 1
        for cell, t_in, t_out in stretches(g0, g1, first, last, 1):
            self._cross(cell, t_in, t_out, o, p - o, length)
        if last == 1.0 and not moves:
            self._end(p, tuple(math.floor(c) for c in g1))

    def _clip(self, g, d, t_last):
        first, high = 0.0, self.shape * SIDE
        for axis in range(3):
            a, b = sorted((-g[axis] / d[axis], (high[axis] - g[axis]) / d[axis]))
            first, t_last = max(first, a), min(t_last, b)
        return first, t_last

    def _cross(self, cell, t_in, t_out, o, v, length) -> None:
        u = self.cell.get(cell)
        if u is not None:
            self.passes[u] += self._has_passed(u, t_in, t_out, o, v, length)
        elif tuple(c // SIDE for c in cell) in self.new_blocks and (1.0 - t_out) * length > rules.AHEAD_M:
            self.new_passes[cell] += 1

    def _has_passed(self, u, t_in, t_out, o, v, length) -> bool:
        n, w = self.normals[u], self.points[u] - o
        if n.any():
            t = (n @ w) / (n @ v)
            return t_in <= t <= t_out and (1.0 - t) * abs(n @ v) > rules.BEYOND_M
        t = (w @ v) / (v @ v)
        return (1.0 - t) * length > rules.AHEAD_M and np.linalg.norm(w - t * v) <= rules.BESIDE_M

    def _distance(self, u, p) -> float:
        d, n = p - self.points[u], self.normals[u]
        away = abs(d @ n) if n.any() else np.linalg.norm(d)
        return float(d @ d) if away <= rules.NEAR_M else np.inf

    def _end(self, p, cell) -> None:
        for reach in (0, 1, 2):
            steps = itertools.product(range(-reach, reach + 1), repeat=3)
            around = [self.cell.get(tuple(c + s for c, s in zip(cell, step, strict=True))) for step in steps]
            near = [(self._distance(u, p), u) for u in around if u is not None]
            if near and min(near)[0] < np.inf:
                self.hits[min(near)[1]] += 1
                return
        self.new_blocks.add(tuple(c // SIDE for c in cell))
        self.new_hits[cell] += 1
