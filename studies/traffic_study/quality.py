"""What the lattices weigh on this street, what they do to Gaussians and poses, and how long coding takes."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.fleet_sim.drives import EPOCH_NS, DriveConfig, DriveSimulation
from gnd.fleet_sim.sensors import MODELS
from gnd.fleet_sim.traffic import Traffic
from gnd.fleet_sim.world import World
from gnd.gnd_map.codec import (
    CODEC_ARCHIVE_ZSTD,
    CODEC_COMPACT_ZSTD,
    CODEC_STANDARD_ZSTD,
    LATTICES,
    PREFERRED,
    Codec,
    Lattice,
    codec_of,
    lattice_of,
    snap,
)
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.tile_id import TileId, covering_circle
from gnd.schemas.drive import Scan
from studies.codec_scenes import PosedScan, kl_median, plain_protobuf, pose_shift_cm
from studies.frame.measure import core_s
from studies.frame.scans import posed

TILE_VOXELS: Final = 2_500
_SCANS: Final = 40
_MARGIN_M: Final = 100.0
_EDGE_S: Final = 0.2
ZSTD_OF: Final = {"archive": CODEC_ARCHIVE_ZSTD, "standard": CODEC_STANDARD_ZSTD, "compact": CODEC_COMPACT_ZSTD}

Tiles = Mapping[TileId, Gaussians]


@dataclass(frozen=True, slots=True)
class CodecMeasures:
    """What the range codec of one lattice does.

    Attributes:
        bytes_per_voxel: of tile bodies.
        zstd_bytes_per_voxel: of the second codec's bodies.
        kl_median: divergence of the decoded Gaussians from the original ones, nats.
        pose_shift_cm_median: how far apart the poses are that scans find on the original and on the decoded map.
        encode_ms, decode_ms: a tile of `TILE_VOXELS`, one core.
    """

    bytes_per_voxel: float
    zstd_bytes_per_voxel: float
    kl_median: float
    pose_shift_cm_median: float
    encode_ms: float
    decode_ms: float


def codec_measures(world: World, tiles: Tiles, sensor_model: str) -> dict[str, CodecMeasures]:
    """Return the measures of every lattice on a map that is on none.

    Args:
        world: the street; scans are taken in its state before.
        tiles: its map.
        sensor_model: of the scans.
    """
    circle = covering_circle(world.lat_rad, world.lon_rad, world.half_length_m + _MARGIN_M)
    grid_frame, scans = GridFrame.around(world.frame, circle), scans_before(world, sensor_model)
    found = {}
    for name, lattice in LATTICES.items():
        snapped = {tile: snap(gaussians, lattice, new_map=True) for tile, gaussians in tiles.items()}
        first, second = codec_of(best_of(lattice)), codec_of(ZSTD_OF[name])
        encode_ms, decode_ms = _times_ms(first, snapped)
        shift = pose_shift_cm(grid_frame, tiles, snapped, scans)
        found[name] = CodecMeasures(
            bytes_per_voxel=_bytes_per_voxel(first, snapped),
            zstd_bytes_per_voxel=_bytes_per_voxel(second, snapped),
            kl_median=kl_median(tiles, snapped),
            pose_shift_cm_median=float(np.median(shift)),
            encode_ms=encode_ms,
            decode_ms=decode_ms,
        )
    return found


def best_of(lattice: Lattice) -> int:
    """Return the id of the codec that writes a lattice shortest."""
    return next(codec_id for codec_id in PREFERRED if lattice_of(codec_id) is lattice)


def protobuf_bytes(tiles: Tiles) -> int:
    """Return the size of the tiles as the paper writes them: protobuf, a message a voxel, doubles."""
    return sum(len(plain_protobuf(tile, gaussians, "double")) for tile, gaussians in tiles.items())


def _bytes_per_voxel(codec: Codec, tiles: Tiles) -> float:
    size = sum(len(codec.encode(tile, gaussians)) for tile, gaussians in tiles.items())
    return size / sum(map(len, tiles.values()))


def _times_ms(codec: Codec, tiles: Tiles) -> tuple[float, float]:
    """Of the largest tile, brought to `TILE_VOXELS`; the processor's time, so that other work does not count."""
    tile, gaussians = max(tiles.items(), key=lambda item: len(item[1]))
    body, scale = codec.encode(tile, gaussians), 1e3 * TILE_VOXELS / len(gaussians)
    encode_s, decode_s = core_s(lambda: codec.encode(tile, gaussians)), core_s(lambda: codec.decode(tile, body))
    return encode_s * scale, decode_s * scale


def scans_before(world: World, sensor_model: str) -> list[PosedScan]:
    """Scans evenly along a drive before the changes, sweep motion removed, with their true poses."""
    traffic = Traffic.urban()
    drive = DriveSimulation(
        world, DriveConfig("car", sensor_model, "before", seed=world.seed, car_share=0.2, traffic=traffic)
    )
    t_s = np.arange(-_EDGE_S, drive.scans / MODELS[sensor_model].rate_hz + _EDGE_S, 0.01)
    t_ns = EPOCH_NS + np.round(t_s * 1e9).astype(np.int64)
    truth = Trajectory(t_ns, np.asarray(drive.motion.T_map_vehicle(t_s)))
    scans = [item for item in drive.items() if isinstance(item, Scan)]
    every = max(1, len(scans) // _SCANS)
    return [posed(scan, truth, drive.header().T_vehicle_lidar) for scan in scans[every::every]]
