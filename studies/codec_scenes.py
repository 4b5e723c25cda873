"""What a codec does to a map: divergence of its Gaussians, shift of the poses found on it; the plain message beside."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, Literal

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.errors import ShapeError
from gnd.gnd_map.gaussian import Gaussians, full_matrices
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.match_map import MatchMapCache
from gnd.vehicle_agent.localise.parameters import ON_MAP, LocaliserParameters, RegistrationParameters
from gnd.vehicle_agent.localise.registration import register
from gnd.vehicle_agent.localise.sampling import sample_scan
from studies.frame.scans import local_map_of

Tiles = Mapping[TileId, Gaussians]
PosedScan = tuple[F64, F64]
"""Points (N, 3) in the vehicle frame, sweep motion removed, and T_map_vehicle (4, 4) near which the scan lies."""

FLOOR_M = 0.001
"""Added to every axis of both Gaussians, so that a plane without thickness has a finite divergence from itself."""
EXACT = RegistrationParameters(rules=replace(ON_MAP, stop_m=1e-6, stop_rad=1e-7, max_iterations=60))
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


Number = Literal["double", "float"]
_FIELD = descriptor_pb2.FieldDescriptorProto
_KINDS = {"double": _FIELD.TYPE_DOUBLE, "float": _FIELD.TYPE_FLOAT}


def plain_protobuf(tile_id: TileId, gaussians: Gaussians, number: Number) -> bytes:
    """A tile as `message Tile {uint64 id; repeated Voxel voxels;}` with `message Voxel {sint32 id; uint32 count;
    repeated NUMBER mean; repeated NUMBER covariance;}`, three and six numbers, packed.
    """
    tile = _tile_class(number)(id=tile_id.morton)
    rows = zip(*(column.tolist() for column in gaussians.columns), strict=True)
    for voxel_id, count, _, mean, covariance in rows:
        tile.voxels.add(id=voxel_id, count=count, mean=mean, covariance=covariance)
    return bytes(tile.SerializeToString())


@cache
def _tile_class(number: Number) -> Any:
    file = descriptor_pb2.FileDescriptorProto(name=f"plain_{number}.proto", package=f"plain.{number}s", syntax="proto3")
    voxel, tile = file.message_type.add(name="Voxel"), file.message_type.add(name="Tile")
    one, many = _FIELD.LABEL_OPTIONAL, _FIELD.LABEL_REPEATED
    voxel.field.add(name="id", number=1, type=_FIELD.TYPE_SINT32, label=one)
    voxel.field.add(name="count", number=2, type=_FIELD.TYPE_UINT32, label=one)
    voxel.field.add(name="mean", number=3, type=_KINDS[number], label=many)
    voxel.field.add(name="covariance", number=4, type=_KINDS[number], label=many)
    tile.field.add(name="id", number=1, type=_FIELD.TYPE_UINT64, label=one)
    tile.field.add(name="voxels", number=2, type=_FIELD.TYPE_MESSAGE, type_name=f".{file.package}.Voxel", label=many)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{file.package}.Tile"))
