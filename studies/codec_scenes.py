"""What codecs are measured on: maps with scans that lie on them, of a simulated street and of real recordings."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.world import World
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.motion import deskew
from gnd.gnd_map.se3 import T_inverse, transform
from gnd.schemas.drive import Scan
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.importer import open_recording
from gnd.vehicle_agent.importers.detect_format import format_of
from gnd.vehicle_agent.importers.lidar_odometry import Progress
from gnd.vehicle_agent.importers.recording import NOMINAL
from studies.codec_quality import PosedScan, Tiles
from studies.real.scene import Scene, load, place
from studies.short_drives import Street
from studies.simulation.base_map import BaseMap, driven, read_base

SEED, LENGTH_M, REACH_M = 101, 300.0, 160.0
SENSORS = ("VLP-16", "HDL-32E")
EVERY = 8
AT_MOST = 80


@dataclass(frozen=True, slots=True, eq=False)
class CodecScene:
    """A map, and scans with the poses near which they lie on it (none where only the map is at hand)."""

    name: str
    tiles: Tiles
    grid_frame: GridFrame | None = None
    scans: Sequence[PosedScan] = ()

    @property
    def voxels(self) -> int:
        """Number of Gaussians."""
        return sum(map(len, self.tiles.values()))


def simulated(seed: int = SEED, base: Path | None = None) -> CodecScene:
    """A street of the simulator: its map as the mapping vehicle makes it, and scans of other sensors at true poses.

    Args:
        seed: of the world.
        base: the map of that world in a file of `write_base`, None to simulate the mapping drives.

    Raises:
        FolderError: the file cannot be read.
    """
    world = street(seed, StreetOptions(length_m=LENGTH_M, site="wangsimni"))
    base_map = driven(world) if base is None else read_base(base)
    scene = Street(world, REACH_M)
    return CodecScene(f"street {seed}", _filled(base_map), scene.grid_frame, list(_driven_scans(scene, world)))


def _filled(base: BaseMap) -> Tiles:
    return {tile_id: gaussians for tile_id, gaussians in base.tiles.items() if len(gaussians)}


def _driven_scans(scene: Street, world: World) -> Iterator[PosedScan]:
    for sensor in SENSORS:
        drive = scene.drive(sensor, "before", 1, world.seed)
        found = [item for item in drive.items() if isinstance(item, Scan)]
        for scan in found[EVERY::EVERY]:
            points = deskew(
                scan.points_m,
                scan.t_offset_ns,
                scan.t_ns,
                drive.truth,
                drive.simulation.header().T_vehicle_lidar,
                scan.t_ns,
            )
            yield points, drive.truth.at(scan.t_ns)


def recorded(folder: Path, progress: Progress = lambda *_: None) -> CodecScene:
    """A real recording: all scans are the map, and all lie on it where the track has them.

    Raises:
        RealDataError, ImportDriveError: too few scans, or files that cannot be read.
    """
    kind = format_of(folder)
    recording = open_recording(kind, folder, NOMINAL if kind == "pcd" else None)
    scene = place(load(recording, AT_MOST, progress), 0)
    tiles = scene.accumulated(scene.refined(scan) for scan in scene.scans).finish()
    filled = {tile_id: gaussians for tile_id, gaussians in tiles.items() if len(gaussians)}
    return CodecScene(folder.name, filled, scene.grid_frame, [_posed(scene, scan) for scan in scene.scans])


def _posed(scene: Scene, scan: Scan) -> PosedScan:
    refined = scene.refined(scan)
    T = refined.estimate.T_map_vehicle
    return np.ascontiguousarray(transform(T_inverse(T), refined.points_map_m)), T


def stored(path: Path, layer: str = "ndt") -> CodecScene:
    """The newest tiles of a store; there are no scans beside them.

    Raises:
        StoreError: the store cannot be read.
    """
    with SqliteStore(path, create=False) as store:
        found = (store.get(layer, entry.tile) for entry in store.heads(layer))
        tiles = [tile.decode_gaussians() for tile in found if tile is not None]
    return CodecScene(path.name, {tile.tile_id: tile.gaussians for tile in tiles if len(tile.gaussians)})
