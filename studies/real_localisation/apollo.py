"""Apollo's two scans: each localised on the map of the other, and both on Apollo's own NDT map.

The poses are Apollo's own, in UTM, turned into our map frame (east, north, up at the first pose). Apollo lays metric
scans into the grid without its scale (0.9997 there), so its map is rigid about the vehicle and not about the Earth: it
is compared as it is, turned by the convergence about the first pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.gaussian import full_matrices
from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3
from gnd.gnd_map.utm import convergence_rad, utm_from_geodetic
from gnd.vehicle_agent.importers.apollo import utm_zone
from gnd.vehicle_agent.importers.apollo_map import NdtCells, read_ndt_map
from gnd.vehicle_agent.importers.recording import GNSS_SIGMA_M
from gnd.vehicle_agent.localise.initialise import initialise
from gnd.vehicle_agent.localise.match_map import MatchMap, MatchMapCache
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.localise.sampling import sample_scan
from studies.real.scene import RecordedScene
from studies.real_localisation.convergence import Aligner, convergence_of, on_map, pose_error, vehicle_points
from studies.real_localisation.halves import Half

F64 = NDArray[np.float64]

MIN_POINTS: Final = 20
"""Of a cell of Apollo's that takes part: about what a voxel of ours needs."""
AROUND_M: Final = 80.0
OFFSETS: Final = ((0.3, 1.0), (1.0, 3.0))
FLAT_M2: Final = 0.003
"""Largest variance across, of Gaussians that are compared."""
STRETCHED_M2: Final = 0.02
TRIALS: Final = 12
SEARCHES: Final = 10


@dataclass(frozen=True, slots=True, eq=False)
class ApolloMap:
    """Apollo's cells in our map frame: ready for registration, and as Gaussians (mean (M, 3), covariance (M, 3, 3))."""

    match_map: MatchMap
    mean_m: F64
    cov_m2: F64


def apollo_map(folder: Path, scene: RecordedScene) -> ApolloMap:
    """The NDT map of a recording around its first pose."""
    cells, T_utm_map = read_ndt_map(folder), _T_utm_map(folder, scene)
    near = np.linalg.norm(cells.mean_utm_m[:, :2] - T_utm_map[:2, 3], axis=1) < AROUND_M
    keep = np.flatnonzero(near & (cells.count >= MIN_POINTS))
    R, t = T_utm_map[:3, :3], T_utm_map[:3, 3]
    mean = (cells.mean_utm_m[keep] - t) @ R
    cov = R.T @ cells.cov_m2[keep] @ R
    return ApolloMap(_match_map(cells, keep, mean, cov, R, t), mean, cov)


def _T_utm_map(folder: Path, scene: RecordedScene) -> F64:
    """(4, 4) grid coordinates of our map frame, by the convergence at its origin."""
    zone, southern = utm_zone(folder)
    frame = scene.grid_frame.frame
    east, north = utm_from_geodetic(frame.lat_rad, frame.lon_rad, zone, southern=southern)
    turn = float(convergence_rad(frame.lat_rad, frame.lon_rad, zone))
    return T_from_R_t(exp_so3([0.0, 0.0, turn]), np.array([float(east), float(north), frame.height_m]))


def _match_map(cells: NdtCells, keep: NDArray[np.int64], mean: F64, cov: F64, R: F64, t: F64) -> MatchMap:
    """A dense window on Apollo's own grid of cells of a metre."""
    g = np.floor(cells.mean_utm_m[keep]).astype(np.int64)
    origin = g.min(axis=0) - 1
    index = np.full(g.max(axis=0) - origin + 2, -1, np.int32)
    index[tuple((g - origin).T)] = np.arange(len(g), dtype=np.int32)
    six = np.stack([cov[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], axis=1)
    return MatchMap.of(index, R, t - origin, mean, six, LocaliserParameters().registration.noise_m)


def apollo_of(folder: Path, scene: RecordedScene) -> dict[str, Any]:
    """Everything about such a recording."""
    halves = [Half.made(f"scan {a + 1} mapped, scan {b + 1} driven", scene, [a], [b]) for a, b in ((0, 1), (1, 0))]
    theirs = apollo_map(folder, scene)
    everything = Half.made("both", scene, [0, 1], [0, 1])
    return {
        "place": _place(scene),
        "searches": [_searched(half.name, half, _ours(half)) for half in halves]
        + [_searched(f"Apollo's map, {half.name.split(', ')[1]}", half, theirs.match_map) for half in halves],
        "halves": [{"name": half.name, "registration": convergence_of(half, trials=TRIALS)} for half in halves],
        "on_apollos_map": on_apollos_map(theirs, everything),
        "gaussians": gaussians_apart(theirs, everything),
    }  # fmt: skip


def _ours(half: Half) -> MatchMap:
    cache = MatchMapCache(half.local_map, LocaliserParameters().registration.noise_m)
    return cache.near(half.scene.positions_m[0])


def _place(scene: RecordedScene) -> dict[str, float]:
    """Of the second pose: what a navigation system would say."""
    T = scene.poses.T_dst_vehicle[-1]
    lat, lon, height = scene.grid_frame.frame.geodetic_from_enu(T[None, :3, 3])
    heading = np.degrees(np.arctan2(T[0, 0], T[1, 0])) % 360.0
    lat_deg, lon_deg = float(np.degrees(lat[0])), float(np.degrees(lon[0]))
    return {"lat_deg": lat_deg, "lon_deg": lon_deg, "height_m": float(height[0]), "heading_deg": float(heading)}


def _searched(name: str, half: Half, m: MatchMap) -> dict[str, Any]:
    """The search from positions 2.5 m off with any heading (one scan is no drive): how often it is sure, and what the
    poses are off by of which it is, and of all that fit best.
    """
    par = LocaliserParameters()
    points, T_true = vehicle_points(half, half.driven[0])
    chosen = points[sample_scan(points, par.sampling)]
    sure, best = list[F64](), list[F64]()
    for seed in range(SEARCHES):
        east, north = np.random.default_rng([15, seed]).normal(0.0, GNSS_SIGMA_M, 2)
        place = T_true[:3, 3] + np.array([east, north, 0.0])
        found = initialise(chosen, place, GNSS_SIGMA_M, m, registration=par.registration)
        if found is not None:
            best.append(found.registration.T_map_vehicle)
            sure += best[-1:] if found.found else []
    sizes = {"searches": SEARCHES, "sure": len(sure), "gaussians": len(m)}
    return {"name": name, **sizes, "largest_error_sure": _off(sure, T_true), "largest_error": _off(best, T_true)}


def _off(poses: Sequence[F64], T_true: F64) -> dict[str, float] | None:
    """Largest along, across and heading."""
    if not len(poses):
        return None
    off = T_inverse(T_true) @ np.stack(list(poses))
    along, across = np.abs(off[:, 0, 3]).max(), np.abs(off[:, 1, 3]).max()
    heading = np.degrees(np.abs(np.arctan2(off[:, 1, 0], off[:, 0, 0]))).max()
    return {"longitudinal_m": float(along), "lateral_m": float(across), "heading_deg": float(heading)}


def on_apollos_map(theirs: ApolloMap, half: Half) -> list[dict[str, Any]]:
    """Our registration on Apollo's Gaussians, from seeded offsets."""
    align = on_map(lambda _: theirs.match_map, "wide", LocaliserParameters())
    rows = []
    for number, scan in enumerate(half.driven):
        points, T_true = vehicle_points(half, scan)
        for off_m, off_deg in OFFSETS:
            poses = [_from(align, points, T_true, off_m, off_deg, seed) for seed in range(TRIALS)]
            errors = np.array([pose_error(T, T_true) for T in poses])
            row = {"scan": number + 1, "off_m": off_m, "off_deg": off_deg, "trials": TRIALS}
            rows.append(row | {"within_10_cm": float((errors[:, 0] < 0.1).mean())} | (_off(poses, T_true) or {}))
    return rows


def _from(align: Aligner, points: F64, T_true: F64, off_m: float, off_deg: float, seed: int) -> F64:
    direction = 2.0 * np.pi * seed / TRIALS
    start = T_from_R_t(
        exp_so3([0.0, 0.0, np.radians(off_deg if seed % 2 else -off_deg)]),
        off_m * np.array([np.cos(direction), np.sin(direction), 0.0]),
    )
    return align(points, T_true @ start, off_m)[0]


def gaussians_apart(theirs: ApolloMap, half: Half) -> dict[str, Any]:
    """Flat Gaussians of ours from both scans against theirs nearest by: along the normal, and between normals."""
    mean, cov = half.local_map.mean_map_m, full_matrices(half.local_map.cov_m2)
    ours, normals = _flat(cov), np.linalg.eigh(cov)[1][:, :, 0]
    flat_theirs = np.flatnonzero(_flat(theirs.cov_m2))
    their_normals = np.linalg.eigh(theirs.cov_m2)[1][:, :, 0]
    off, angle, along = list[float](), list[float](), list[F64]()
    for row in np.flatnonzero(ours):
        apart = np.linalg.norm(theirs.mean_m[flat_theirs] - mean[row], axis=1)
        if apart.min() < 0.5:
            at = flat_theirs[int(apart.argmin())]
            off.append(float(normals[row] @ (theirs.mean_m[at] - mean[row])))
            along.append(normals[row])
            angle.append(np.degrees(np.arccos(min(abs(normals[row] @ their_normals[at]), 1.0))))
    return {
        "ours": int(ours.sum()),
        "theirs": len(flat_theirs),
        "compared": len(off),
        "along_normal_m_p50": float(np.median(np.abs(off))),
        "along_normal_m_p95": float(np.quantile(np.abs(off), 0.95)),
        "shift_enu_m": _robust_shift(np.array(along), np.array(off)).tolist(),
        "between_normals_deg_p50": float(np.median(angle)),
    }


def _robust_shift(normals: F64, off: F64) -> F64:
    """(3,) by how much their surfaces lie shifted against ours: least squares along the normals, outliers left out."""
    keep: NDArray[np.bool_] = np.ones(len(off), np.bool_)
    shift: F64 = np.zeros(3)
    for _ in range(10):
        shift = np.asarray(np.linalg.lstsq(normals[keep], off[keep], rcond=None)[0], np.float64)
        left = np.abs(off - normals @ shift)
        keep = left <= 3.0 * max(float(np.median(left)), 1e-3)
    return shift


def _flat(cov: F64) -> NDArray[np.bool_]:
    values = np.linalg.eigvalsh(cov)
    return np.asarray((values[:, 0] < FLAT_M2) & (values[:, 1] > STRETCHED_M2))
