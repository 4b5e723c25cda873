"""The plain twin of the ray kernel: one ray, one voxel at a time, written for reading and sharing no code with it.

The voxels of a ray come from sorting the parameters at which it crosses integer planes, not from stepping.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np

from gnd.vehicle_agent.detect import kernel, records
from gnd.vehicle_agent.detect.parameters import INCLUDED_M


@dataclass
class PlainMap:
    """Gaussians by voxel in window coordinates; everything else that is `known` is empty."""

    shape: tuple[int, int, int]
    mean: np.ndarray
    cov: np.ndarray
    index: np.ndarray  # >= 0 Gaussian, -1 empty, UNKNOWN

    def r2(self, row: int, point: np.ndarray, noise_m: float) -> float:
        d = point - self.mean[row]
        return float(d @ np.linalg.solve(self.cov[row] + np.eye(3) * noise_m**2, d))


def voxels_of_segment(start: np.ndarray, end: np.ndarray) -> list[tuple[tuple[int, ...], float, float]]:
    """(voxel, t_in, t_out) of every voxel that the segment has a stretch of positive length in, in order."""
    cuts = {0.0, 1.0}
    for axis in range(3):
        low, high = sorted((start[axis], end[axis]))
        for plane in range(math.ceil(low), math.floor(high) + 1):
            if high > low:
                t = (plane - start[axis]) / (end[axis] - start[axis])
                cuts.add(min(max(t, 0.0), 1.0))
    ordered = sorted(cuts)
    pieces = []
    for t_in, t_out in itertools.pairwise(ordered):
        middle = start + (end - start) * (t_in + t_out) / 2
        pieces.append((tuple(math.floor(x) for x in middle), t_in, t_out))
    return pieces


def is_inside_window(voxel: tuple[int, ...], shape: tuple[int, int, int]) -> bool:
    return all(0 <= i < n for i, n in zip(voxel, shape, strict=True))


class PlainDetector:
    """Counts the six cases of GND 4.2 with the meaning of `DetectParameters`, one after the other."""

    def __init__(self, world: PlainMap, p, quantile, A: np.ndarray, b: np.ndarray, pose=None) -> None:
        self.world, self.p, self.quantile, self.A, self.b, self.pose = world, p, quantile, A, b, pose
        n = len(world.mean)
        self.bi, self.bo, self.pi, self.po = (np.zeros(n, int) for _ in range(4))
        self.pe = np.zeros(world.shape, int)
        self.kept: list[bool] = []

    def ray(self, origin: np.ndarray, point: np.ndarray, moving: bool = False) -> None:
        length = float(np.linalg.norm(point - origin))
        self.kept.append(False)
        s2 = self._variance_beyond_what_is_included(length)
        if not length > self.p.range_min_m:
            return
        reach = min(1.0, self.p.range_max_m / length)
        start, full = self.A @ origin + self.b, self.A @ (point - origin)
        pieces = [
            (voxel, t_in * reach, t_out * reach)
            for voxel, t_in, t_out in voxels_of_segment(start, start + full * reach)
            if is_inside_window(voxel, self.world.shape)
        ]
        if not pieces:
            return
        ends_inside = reach == 1.0 and is_inside_window(tuple(np.floor(start + full).astype(int)), self.world.shape)
        for voxel, t_in, t_out in pieces[:-1]:
            self._pass(voxel, origin, point, t_in, t_out, length, s2)
        if ends_inside and not moving:
            self._block(pieces[-1][0], point, start + full, s2)

    def _variance_beyond_what_is_included(self, length: float) -> float:
        if self.pose is None:
            return 0.0
        end = self.pose.sigma_m**2 + (self.pose.sigma_rad * length) ** 2
        return max(end - INCLUDED_M**2, 0.0)

    def _pass(self, voxel, origin, point, t_in, t_out, length, s2) -> None:
        row = self.world.index[voxel]
        if row == -1:
            self.pe[voxel] += 1
        elif row >= 0:
            counter = self.pi if self._passes(row, origin, point, t_in, t_out, length, s2) else self.po
            counter[row] += 1

    def _passes(self, row, origin, point, t_in, t_out, length, s2) -> bool:
        v, mean = point - origin, self.world.mean[row]
        cov = self.world.cov[row] + np.eye(3) * records._PASS_NOISE_M**2
        values, vectors = np.linalg.eigh(cov)
        if self.p.rules.passing_rule == "plane" and values[1] >= records._PLANAR_RATIO * values[0]:
            normal = vectors[:, 0]
            t = normal @ (mean - origin) / (normal @ v)
            behind = math.hypot(kernel._BEYOND_M, kernel._BEYOND_SIGMAS * math.sqrt(s2) if self.p.rules.soft else 0.0)
            if not t_in <= t <= t_out or (1 - t) * abs(normal @ v) <= behind:
                return False
            return self.world.r2(row, origin + t * v, records._PASS_NOISE_M) <= self.quantile(kernel._ETA_PLANE)
        information = np.linalg.inv(cov)
        t = min(max(v @ information @ (mean - origin) / (v @ information @ v), t_in), t_out)
        if self.p.rules.passing_rule != "ml" and (1 - t) * length < kernel._AHEAD_M:
            return False
        return self.world.r2(row, origin + t * v, records._PASS_NOISE_M) <= self.quantile(self.p.rules.eta_pass)

    def _block(self, voxel, point, g, s2) -> None:
        row = self.world.index[voxel]
        if row < -1:
            return
        noise2 = self.p.rules.block_noise_m**2
        limit = self.quantile(kernel.ETA_BLOCK) * (noise2 + (s2 if self.p.rules.soft else 0.0)) / noise2
        if row >= 0 and self.world.r2(row, point, self.p.rules.block_noise_m) <= limit:
            self.bi[row] += 1
        elif self._explained(voxel, point, g):
            return
        elif row >= 0:
            self.bo[row] += 1
        self.kept[-1] = True

    def _explained(self, voxel, point, g) -> bool:
        for axis in range(3):
            face = self.p.rules.face_m * np.linalg.norm(self.A[axis])
            fraction = g[axis] - voxel[axis]
            step = -1 if fraction < face else 1 if fraction > 1 - face else 0
            beside = list(voxel)
            beside[axis] += step
            if step == 0 or not is_inside_window(tuple(beside), self.world.shape):
                continue
            row = self.world.index[tuple(beside)]
            if row >= 0 and self.world.r2(row, point, self.p.rules.block_noise_m) <= kernel._FACE_SIGMA**2:
                return True
        return False
