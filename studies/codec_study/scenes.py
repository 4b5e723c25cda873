"""Maps that codecs are measured on and that tables are learnt from: recordings and simulated places, with scans."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from gnd.fleet_sim.families.names import FAMILY_NAMES, RESERVED
from gnd.fleet_sim.street import StreetOptions, street
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.se3 import T_inverse, transform
from gnd.gnd_map.tile_id import TileId, covering_circle
from gnd.schemas.drive import Scan
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importer import open_recording
from gnd.vehicle_agent.importers.detect_format import format_of
from gnd.vehicle_agent.importers.recording import NOMINAL, Recording
from studies.codec_scenes import PosedScan
from studies.real.scene import RecordedScans, RecordedScene, load, place
from studies.simulation.base_map import driven
from studies.traffic_study.quality import scans_before

Maps = Mapping[TileId, Gaussians]
Progress = Callable[[str, int, int], None]

LENGTH_M, MARGIN_M = 300.0, 100.0
AT_MOST: Final = 200
SCANS: Final = 40
LEARNT_SEED: Final = 101
LEARNT_FAMILIES: Final = tuple(name for name in FAMILY_NAMES if name not in RESERVED)
SEGMENT: Final = 32
_RANDOM_WAYS: Final = {"kitti_raw_0027": (1, 2, 3, 4), "7fab2350": (0, 1, 2, 3, 4, 5)}


@dataclass(frozen=True, slots=True)
class SceneSource:
    """A recording.

    Attributes:
        path: below the folder of recordings.
        sensor: LiDAR.
        learnt: whether the tables have seen it.
    """

    path: str
    sensor: str
    learnt: bool = False

    @property
    def name(self) -> str:
        """In tables."""
        return Path(self.path).stem


SOURCES: Final = (
    SceneSource("kitti_raw_0027", "HDL-64E", learnt=True),
    SceneSource("av2_pit_overlap/7fab2350", "2 x VLP-32C", learnt=True),
    SceneSource("kitti00_start16", "HDL-64E"),
    SceneSource("kitti_raw_0060", "HDL-64E"),
    SceneSource("radiate_fog", "HDL-32E"),
    SceneSource("apollo_ndt", "HDL-64E"),
    SceneSource("captures_a/sample_velodyne_hdl32.pcap", "HDL-32E"),
)
"""Those not learnt from: other days, places and vehicles; of the sensors the HDL-32E was never learnt from."""


@dataclass(frozen=True, slots=True, eq=False)
class CodecScene:
    """A map as it was measured, and scans with the poses near which they lie on it."""

    name: str
    kind: str
    tiles: Maps
    grid_frame: GridFrame
    scans: tuple[PosedScan, ...]

    @property
    def voxels(self) -> int:
        """Number of Gaussians."""
        return sum(map(len, self.tiles.values()))


def recorded(source: SceneSource, folder: Path, progress: Progress) -> CodecScene:
    """A recording: all its scans are the map, and up to `SCANS` of them lie on it where the track has them.

    Raises:
        RealDataError, ImportDriveError: too few scans, or files that cannot be read.
    """
    scene = place(_loaded(source, folder, progress), 0)
    scans = scene.scans[:: max(1, len(scene.scans) // SCANS)]
    kind = "real, learnt from" if source.learnt else "real"
    posed = tuple(_posed(scene, scan) for scan in scans)
    return CodecScene(f"{source.name} ({source.sensor})", kind, _map_of(scene, scene.scans), scene.grid_frame, posed)


def simulated(family: str, seed: int, sensor_model: str = "VLP-16") -> CodecScene:
    """A simulated place: its map as the mapping vehicle makes it, scans of another sensor at true poses."""
    world = street(seed, StreetOptions(length_m=LENGTH_M, site="wangsimni", family=family))
    grid_frame = GridFrame.around(
        world.frame, covering_circle(world.lat_rad, world.lon_rad, world.half_length_m + MARGIN_M)
    )
    kind = "simulated" if family in LEARNT_FAMILIES else "simulated, family never used"
    return CodecScene(
        f"{family} {seed}", kind, _filled(driven(world).tiles), grid_frame, tuple(scans_before(world, sensor_model))
    )


def training_maps(folder: Path, progress: Progress = lambda *_: None) -> Iterator[tuple[TileId, Gaussians]]:
    """The tiles that the tables learn from: simulated places, and recordings laid on the grid in several ways, the long
    one in pieces of many and of few scans.

    Raises:
        RealDataError, ImportDriveError: recordings that are missing or cannot be read.
    """
    for family in LEARNT_FAMILIES:
        world = street(LEARNT_SEED, StreetOptions(length_m=LENGTH_M, site="wangsimni", family=family))
        yield from _filled(driven(world).tiles).items()
    for source in SOURCES:
        if source.learnt:
            recording = _loaded(source, folder, progress)
            for number in _RANDOM_WAYS[source.name]:
                yield from _pieces(place(recording, number), number)


def _pieces(scene: RecordedScene, number: int) -> Iterator[tuple[TileId, Gaussians]]:
    """The tiles of a recording; of a long one, of each piece."""
    n = len(scene.scans)
    taken = SEGMENT // 2 if number % 2 else 3
    for begin in range(0, n - SEGMENT // 2, SEGMENT) if n > SEGMENT else (0,):
        yield from _map_of(scene, scene.scans[begin : begin + taken]).items()


def _loaded(source: SceneSource, folder: Path, progress: Progress) -> RecordedScans:
    return load(_opened(folder / source.path), AT_MOST, progress, fewest=2)


def _opened(path: Path) -> Recording:
    """Anchored where it says, else anywhere."""
    kind = format_of(path)
    try:
        return open_recording(kind, path, None)
    except ImportDriveError:
        return open_recording(kind, path, NOMINAL)


def _map_of(scene: RecordedScene, scans: tuple[Scan, ...]) -> Maps:
    return _filled(scene.accumulated(scene.refined(scan) for scan in scans).finish())


def _filled(tiles: Maps) -> Maps:
    return {tile_id: gaussians for tile_id, gaussians in tiles.items() if len(gaussians)}


def _posed(scene: RecordedScene, scan: Scan) -> PosedScan:
    refined = scene.refined(scan)
    T = refined.estimate.T_map_vehicle
    return np.ascontiguousarray(transform(T_inverse(T), refined.points_map_m)), T
