"""B' : the drive or the map B, moved onto A."""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.codec import snap
from gnd.gnd_map.gaussian import Gaussians, full_matrices
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame, VoxelGrid, zones
from gnd.gnd_map.se3 import T_inverse, transform
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import GnssFix, ReferencePose
from gnd.schemas.drive_mcap import DriveWriter, read_drive, read_header
from gnd.tile_store.cli import store_to_fill
from gnd.tile_store.values import DEFAULT_CODEC, lattice_named
from gnd.vehicle_agent.importers.rigid import orthonormal
from gnd.vehicle_agent.map_align.sources import AlignError, Side

_POINTS: Final = 600
"""Samples of a Gaussian at most; its count, where that is less."""


def moved_drive(source: Path, target: Path, frame: LocalFrame, T_a_b: F64, why: str) -> None:
    """Write a drive again with its reference poses and GNSS fixes moved; scans and motion are the vehicle's own.

    Args:
        source: MCAP.
        target: appears complete or not at all.
        frame: in which the motion is given.
        T_a_b: (4, 4) moves B onto A.
        why: goes into the header's source.

    Raises:
        AlignError: the target is the source.
        DriveError: a drive cannot be read or written.
    """
    if target.exists() and target.samefile(source):
        raise AlignError(f"{target} is the drive that is moved; name another file")
    header = read_header(source)
    T_frame_map = frame.T_self_other(header.anchor)
    T_map = T_inverse(T_frame_map) @ T_a_b @ T_frame_map
    header = replace(header, source=f"{header.source}; {why}".lstrip("; "))
    with DriveWriter(target, header) as writer:
        for item in read_drive(source):
            match item:
                case ReferencePose():
                    moved, _ = orthonormal((T_map @ item.T_map_vehicle)[None, :3], str(source))
                    writer.reference(ReferencePose(item.t_ns, moved[0]))
                case GnssFix():
                    writer.gnss(_moved_fix(item, frame, T_a_b))
                case _:
                    writer.add(item)


def write_moved(side: Side, target: Path, frame: LocalFrame, T_a_b: F64, codec: str, layer: str) -> None:
    """Write a map, moved, into a new store."""
    tiles = moved_tiles(side, frame, T_a_b, codec)
    with store_to_fill(target) as store:
        store.put_tiles(tiles, layer=layer, surveyed_ns=side.surveyed_ns)


def _moved_fix(fix: GnssFix, frame: LocalFrame, T: F64) -> GnssFix:
    p = frame.enu_from_geodetic(fix.lat_rad, fix.lon_rad, fix.height_m)
    lat, lon, height = frame.geodetic_from_enu(transform(T, p[None])[0])
    return GnssFix(fix.t_ns, float(lat), float(lon), float(height), fix.sigma_m)


def moved_tiles(side: Side, frame: LocalFrame, T_a_b: F64, codec: str = DEFAULT_CODEC) -> list[Tile]:
    """The map B in the voxels of where it belongs.

    Each Gaussian is spread into points, evenly over its extent, which fall into the new voxels. What a voxel cut off
    is not known any more: a map that is built from the moved drives is sharper (docs/decisions/0130).
    """
    clouds = [(tile, _samples(tile, frame, T_a_b)) for tile in side.tiles]
    reached = set[TileId]()
    for tile, _ in clouds:
        reached |= {tile.tile_id, *tile.tile_id.neighbours()}
    found: dict[TileId, Gaussians] = {}
    for group in zones(reached).values():
        accumulator = VoxelAccumulator(GridFrame.around(frame, group))
        for _, points_m in clouds:
            accumulator.add(points_m)
        found.update(accumulator.finish())
    lattice = lattice_named(codec)
    return [
        Tile(tile, 1, found[tile] if lattice is None else snap(found[tile], lattice, new_map=True))
        for tile in sorted(found)
    ]


def _samples(tile: Tile, frame: LocalFrame, T_a_b: F64) -> F64:
    """(N, 3) points of the Gaussians of a tile, moved, in the frame."""
    held = tile.gaussians.take(tile.gaussians.exists)
    T = T_a_b @ frame.T_self_other(LocalFrame.of_tile(tile.tile_id))
    means = transform(T, VoxelGrid.of(tile.tile_id).centre_m(held.voxel_id) + held.mean_m)
    spreads = T[:3, :3] @ full_matrices(held.cov_m2) @ T[:3, :3].T
    values, axes = np.linalg.eigh(spreads)
    half = axes * np.sqrt(3.0 * np.maximum(values, 0.0))[:, None, :]  # of a box with this covariance
    number = np.clip(held.count, 1, _POINTS)
    owner = np.repeat(np.arange(len(held)), number)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(number) - number, number)
    return np.asarray(means[owner] + np.einsum("nij,nj->ni", half[owner], _even(within)))


def _even(k: I64) -> F64:
    """(N, 3) the points number k of a sequence that fills -1 ... 1 evenly (R3, Roberts 2018)."""
    root = 1.2207440846057596
    return np.asarray(2.0 * ((0.5 + np.outer(k, [1 / root, 1 / root**2, 1 / root**3])) % 1.0) - 1.0)
