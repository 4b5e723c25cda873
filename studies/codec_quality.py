"""What a codec does to a map: how far its Gaussians move, and how far it moves the vehicles that match against it."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.errors import ShapeError
from gnd.gnd_map.gaussian import Gaussians, full_matrices
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.match_map import MatchMapCache
from gnd.vehicle_agent.localise.parameters import LocaliserParameters, RegistrationParameters
from gnd.vehicle_agent.localise.registration import register
from gnd.vehicle_agent.localise.sampling import sample_scan
from studies.short_drives import local_map_of

Tiles = Mapping[TileId, Gaussians]
PosedScan = tuple[F64, F64]
"""Points (N, 3) in the vehicle frame, sweep motion removed, and T_map_vehicle (4, 4) near which the scan lies."""

FLOOR_M = 0.001
"""Added to every axis of both Gaussians, so that a plane without thickness has a finite divergence from itself."""
EXACT = replace(RegistrationParameters(), stop_m=1e-6, stop_rad=1e-7, max_iterations=60)
"""To the optimum: the vehicle's own steps stop at 0.05 cm, about what is measured here."""


def kl_nats(original: Gaussians, decoded: Gaussians) -> F64:
    """(N,) Kullback-Leibler divergence KL(original || decoded) of each voxel's Gaussian, nats.

    Raises:
        ShapeError: the voxels are not the same ones.
    """
    if not np.array_equal(original.voxel_id, decoded.voxel_id):
        raise ShapeError(f"{len(original)} voxels and {len(decoded)} voxels are not the same ones")
    floor = FLOOR_M**2 * np.eye(3)
    cov_0, cov_1 = full_matrices(original.cov_m2) + floor, full_matrices(decoded.cov_m2) + floor
    off = decoded.mean_m.astype(np.float64) - original.mean_m
    trace = np.trace(np.linalg.solve(cov_1, cov_0), axis1=1, axis2=2)
    distance = np.einsum("ni,ni->n", off, np.linalg.solve(cov_1, off[..., None])[..., 0])
    log_ratio = np.linalg.slogdet(cov_1)[1] - np.linalg.slogdet(cov_0)[1]
    return np.asarray(0.5 * (trace + distance - 3.0 + log_ratio))


def kl_median(original: Tiles, decoded: Tiles) -> float:
    """Median of `kl_nats` over all voxels of a map."""
    return float(np.median(np.concatenate([kl_nats(original[tile_id], decoded[tile_id]) for tile_id in original])))


def pose_shift_cm(grid_frame: GridFrame, original: Tiles, decoded: Tiles, scans: Sequence[PosedScan]) -> F64:
    """(K,) distance, centimetres, between the poses that scans find on the original and on the decoded map.

    Each scan is registered twice from the same start by the vehicle's own registration, run to its optimum; scans that
    match neither map are left out.
    """
    found = zip(
        *(registered_poses(local_map_of(grid_frame, tiles), scans) for tiles in (original, decoded)), strict=True
    )
    pairs = [(a, b) for a, b in found if a is not None and b is not None]
    return np.array([100.0 * np.linalg.norm(a[:3, 3] - b[:3, 3]) for a, b in pairs])


def registered_poses(local_map: LocalMap, scans: Iterable[PosedScan]) -> list[F64 | None]:
    """T_map_vehicle of each scan on the map, None where too little matches."""
    cache, sampling = MatchMapCache(local_map, EXACT.noise_m), LocaliserParameters().sampling
    return [_registered(cache, points[sample_scan(points, sampling)], T) for points, T in scans]


def _registered(cache: MatchMapCache, points: F64, T_start: F64) -> F64 | None:
    try:
        return register(points, T_start, cache.near(T_start[:3, 3]), EXACT).T_map_vehicle
    except RegistrationError:
        return None
