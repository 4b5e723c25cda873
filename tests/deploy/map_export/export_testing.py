"""Localising on an exported map as Autoware does, and on the tiles that it was made of."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import small_gicp
from scipy.spatial import cKDTree

from gnd.deploy.map_export.autoware import CLOUDS, PROJECTOR, read_metadata
from gnd.deploy.map_export.projection import Projection, projection_in
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame, VoxelGrid
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import exp_so3
from gnd.gnd_map.tile import Tile
from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import load_track, read_drive, read_header
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.match_map import MatchMapCache
from gnd.vehicle_agent.localise.parameters import WITHOUT_WHEELS, LocaliserParameters
from gnd.vehicle_agent.localise.registration import register
from gnd.vehicle_agent.localise.sampling import sample_scan


def read_cell(path: Path) -> np.ndarray:
    """(N, 3) float64 points of a PCD file by the letter of its header."""
    head, _, body = path.read_bytes().partition(b"DATA binary\n")
    header = dict(line.split(" ", 1) for line in head.decode().splitlines() if not line.startswith("#"))
    assert (header["FIELDS"], header["SIZE"], header["TYPE"], header["COUNT"]) == ("x y z", "4 4 4", "F F F", "1 1 1")
    points = np.frombuffer(body, "<f4").reshape(-1, 3)
    assert int(header["POINTS"]) == int(header["WIDTH"]) == len(points)
    return points.astype(np.float64)


def read_export(folder: Path) -> tuple[Projection, np.ndarray]:
    """The projection and all points of an export in TransverseMercator, from its files alone."""
    projection = projection_in((folder / PROJECTOR).read_text())
    assert projection is not None
    return projection, np.concatenate([read_cell(folder / CLOUDS / name) for name in read_metadata(folder)])


@dataclass(frozen=True)
class PlaneFrame:
    """Poses between an ENU frame and the plane of an export."""

    frame: LocalFrame
    projection: Projection

    def forward(self, p_m: np.ndarray) -> np.ndarray:
        lat, lon, height = self.frame.geodetic_from_enu(p_m)
        return np.stack([*self.projection.forward(lat, lon), height], axis=-1)

    def pose(self, T_frame: np.ndarray) -> np.ndarray:
        """A pose in the plane; the rotation is that of the map's tangent there."""
        p = T_frame[:3, 3]
        tangent = (self.forward(p + np.eye(3)) - self.forward(p - np.eye(3))).T / 2.0
        u, _, vt = np.linalg.svd(tangent)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = u @ vt @ T_frame[:3, :3], self.forward(p)
        return T


def scans_of(drive: Path, every: int) -> Iterator[tuple[np.ndarray, np.ndarray, LocalFrame]]:
    """Points (N, 3) in the vehicle frame, sweep motion removed, the reference pose, and its frame."""
    header, track = read_header(drive), load_track(drive)
    poses = Trajectory(track.reference.t_ns, track.reference.T_map_vehicle)
    scans = [item for item in read_drive(drive) if isinstance(item, Scan)][2:-2]
    for scan in scans[::every]:
        range_m = np.linalg.norm(scan.points_m, axis=1)
        kept = (range_m > 3.0) & (range_m < 60.0)
        points = deskew(
            scan.points_m[kept], scan.t_offset_ns[kept], scan.t_ns, poses, header.T_vehicle_lidar, scan.t_ns
        )
        yield points, poses.at(scan.t_ns), header.anchor


def beside(T: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A start some 0.2 m and 0.5 degrees off."""
    off = np.eye(4)
    off[:3, :3] = exp_so3(np.array([0.0, 0.0, np.radians(rng.normal(0.0, 0.5))]))
    off[:2, 3] = rng.normal(0.0, 0.15, 2)
    return T @ off


SHARPNESS = 0.2484
"""d2 of Magnusson (6.8) for an outlier ratio of 0.55 and cells of 2 m."""


class Ndt:
    """Point to distribution (Magnusson 2009, chapter 6) with Autoware's parameters (autoware_ndt_scan_matcher): cells
    of 2 m with at least 6 points, all cells whose mean lies within 2 m of a point, outlier ratio 0.55.

    Gauss-Newton on the distances, weighted by the derivative of the score, takes the place of Newton's method: it has
    the same maxima. Eigenvalues below 0.01 of the largest are lifted to that, as in PCL.
    """

    def __init__(self, mean_m: np.ndarray, cov_m2: np.ndarray, cell_m: float) -> None:
        value, vector = np.linalg.eigh(cov_m2)
        value = np.maximum(value, 0.01 * value[:, 2:])
        self.information = np.einsum("nij,nj,nkj->nik", vector, 1.0 / value, vector)
        self.mean_m, self.cell_m = mean_m, cell_m
        self.tree = cKDTree(mean_m)

    @classmethod
    def of_moments(cls, p: np.ndarray, cov: np.ndarray, weight: np.ndarray, cell_m: float, least: float) -> "Ndt":
        """Cells of weighted Gaussians (points: covariance 0)."""
        keys, cell = np.unique(np.floor(p / cell_m).astype(int), axis=0, return_inverse=True)
        cell, n = cell.ravel(), len(keys)
        total = np.bincount(cell, weight, n)
        mean = np.stack([np.bincount(cell, weight * p[:, a], n) for a in range(3)], axis=1) / total[:, None]
        second = cov + np.einsum("ni,nj->nij", p - mean[cell], p - mean[cell])
        moments = np.zeros((n, 3, 3))
        np.add.at(moments, cell, weight[:, None, None] * second)
        enough = total >= least
        return cls(mean[enough], (moments / total[:, None, None])[enough], cell_m)

    def align(self, points: np.ndarray, T_start: np.ndarray, rounds: int = 100) -> np.ndarray:
        T = T_start.copy()
        for _ in range(rounds):
            q = points @ T[:3, :3].T + T[:3, 3]
            distance, row = self.tree.query(q, k=8, distance_upper_bound=self.cell_m)
            near = np.isfinite(distance)
            q, row = np.repeat(q, near.sum(axis=1), axis=0), row[near]
            d, B = q - self.mean_m[row], self.information[row]
            weight = np.exp(-0.5 * SHARPNESS * np.minimum(np.einsum("ni,nij,nj->n", d, B, d), 200.0))
            J = np.zeros((len(q), 3, 6))
            J[:, :, :3] = np.eye(3)
            a = q - T[:3, 3]
            J[:, 0, 4], J[:, 0, 5], J[:, 1, 3] = a[:, 2], -a[:, 1], -a[:, 2]
            J[:, 1, 5], J[:, 2, 3], J[:, 2, 4] = a[:, 0], a[:, 1], -a[:, 0]
            WB = weight[:, None, None] * B
            H = np.einsum("nia,nij,njb->ab", J, WB, J, optimize=True)
            step = -np.linalg.solve(H + 1e-6 * np.eye(6), np.einsum("nia,nij,nj->a", J, WB, d, optimize=True))
            T[:3, :3] = exp_so3(step[3:]) @ T[:3, :3]
            T[:3, 3] += step[:3]
            if np.linalg.norm(step) < 1e-4:
                break
        return T


Align = Callable[[np.ndarray, np.ndarray], np.ndarray]


def vgicp(cloud: np.ndarray) -> Align:
    """small_gicp VGICP with voxels of 1 m on a cloud."""
    target, _ = small_gicp.preprocess_points(cloud, downsampling_resolution=0.05)
    voxels = small_gicp.GaussianVoxelMap(1.0)
    voxels.set_lru(horizon=1_000_000, clear_cycle=1_000_000)
    voxels.insert(target)

    def align(points: np.ndarray, T: np.ndarray) -> np.ndarray:
        source, _ = small_gicp.preprocess_points(points, downsampling_resolution=0.3)
        return np.asarray(small_gicp.align(voxels, source, init_T_target_source=T, max_iterations=50).T_target_source)

    return align


class OnTiles:
    """Localising on the tiles themselves: our registration, and NDT with cells made of the Gaussians' moments."""

    def __init__(self, tiles: list[Tile], plane: PlaneFrame) -> None:
        self.plane = plane
        self.local_map = LocalMap(GridFrame.around(plane.frame, [tile.tile_id for tile in tiles]))
        columns = []
        for tile in tiles:
            self.local_map.set_tile(tile)
            own = PlaneFrame(LocalFrame.of_tile(tile.tile_id), plane.projection)
            R = own.pose(np.eye(4))[:3, :3]
            mean_m = VoxelGrid.of(tile.tile_id).centre_m(tile.gaussians.voxel_id) + tile.gaussians.mean_m
            columns.append((own.forward(mean_m), R @ tile.gaussians.full_cov() @ R.T, tile.gaussians.count))
        mean, cov, count = (np.concatenate(column) for column in zip(*columns, strict=True))
        self.ndt = Ndt.of_moments(mean, cov, count.astype(float), 2.0, 6)
        plain = LocaliserParameters()
        self.parameters = replace(plain, registration=replace(plain.registration, rules=WITHOUT_WHEELS))
        self.cache = MatchMapCache(self.local_map, plain.registration.noise_m)

    def ours(self, points: np.ndarray, T_frame: np.ndarray) -> np.ndarray:
        """The pose in the plane, from a start in the ENU frame."""
        chosen = sample_scan(points, self.parameters.sampling)
        near = self.cache.near(T_frame[:3, 3])
        return self.plane.pose(
            register(points[chosen], T_frame, near, self.parameters.registration, "wide").T_map_vehicle
        )


def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N, 3) how far poses a lie from poses b, along the axes of the vehicles b, m."""
    return np.asarray((np.linalg.inv(b) @ a)[:, :3, 3])
