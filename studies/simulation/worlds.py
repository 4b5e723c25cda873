"""One world of a reproduction, made once and kept in files; the work of each vehicle, with its key."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gnd.fleet_sim.drives import DriveConfig
from gnd.fleet_sim.street import StreetOptions, street
from gnd.fleet_sim.truth import Truth, load_or_make_truth, world_sha
from gnd.fleet_sim.world import World, write_world
from gnd.gnd_map.config import to_mapping
from studies.frame.errors import FolderError
from studies.frame.folder import StudyFolder
from studies.frame.kept import SIMULATOR, key_of, sources_sha
from studies.simulation.base_map import BaseMap, driven, read_base, surveyed, write_base
from studies.simulation.options import RunOptions, fleet_configs, fleet_sensors
from studies.simulation.result import VoxelRows
from studies.simulation.vehicle import VehicleTask

VEHICLE: Final = (
    *SIMULATOR,
    *(f"vehicle_agent/{name}" for name in ("detect", "localise", "segment", "report", "tracks.py")),
    "vehicle_agent/tiles_at_hand.py",
    *(f"vehicle_agent/{name}.py" for name in ("local_map", "pipeline", "place", "scans", "surroundings")),
    *(f"studies/simulation/{name}.py" for name in ("vehicle", "poses", "base_map")),
    *(f"studies/simulation/{name}.py" for name in ("streams", "result")),
)
"""What a simulated vehicle's result depends on."""
PCD: Final = ("studies/pcd", "studies/simulation/baseline.py")


@dataclass(frozen=True, slots=True)
class WorldFiles:
    """The files of one world; `name` tells seed, length and place."""

    home: Path
    base_kind: str

    @property
    def world(self) -> Path:
        """The street."""
        return self.home / "world.json"

    @property
    def truth(self) -> Path:
        """What changed."""
        return self.home / "truth.npz"

    @property
    def voxels(self) -> Path:
        """The truth's voxels, ids only."""
        return self.home / "voxels.npz"

    @property
    def base(self) -> Path:
        """The map that every vehicle starts with."""
        return self.home / f"base-{self.base_kind}.npz"

    @property
    def cloud(self) -> Path:
        """The point-cloud baseline's map of the state before."""
        return self.home / "cloud.npz"


def world_name(seed: int, options: StreetOptions) -> str:
    """Return the name of a world's folder."""
    place = options.site if options.lat_deg is None else f"{options.lat_deg:g}N{options.lon_deg:g}E"
    edits = "" if options.edit_share == 1.0 else f"-edits{100 * options.edit_share:g}"
    family = "" if options.family == "street" else f"-{options.family}"
    return f"seed-{seed}{family}-{options.length_m:g}m-{place}{edits}"


def world_files(folder: StudyFolder, seed: int, options: RunOptions) -> WorldFiles:
    """Return where a world's files lie."""
    return WorldFiles(folder.world(world_name(seed, options.street)), options.base)


def prepare_world(files: WorldFiles, seed: int, options: RunOptions) -> None:
    """Make what is missing of a world: street, truth, base map. What is there is checked and used again."""
    world = street(seed, options.street)
    write_world(world, files.world)
    truth = _truth(files, world)
    VoxelRows.of(truth).write(files.voxels)
    if options.base == "surveyed":
        write_base(surveyed(truth.before), files.base)
    elif not _usable(files, world):
        write_base(driven(world), files.base)
        _key_file(files.base).write_text(_base_key(world), encoding="utf-8")


def prepare_cloud(files: WorldFiles, seed: int, options: RunOptions) -> None:
    """Make the baseline's map, if it is not there."""
    from studies.simulation.baseline import read_cloud, write_cloud

    world = street(seed, options.street)
    key, key_file = key_of(base=_base_key(world), pcd=sources_sha(PCD)), _key_file(files.cloud)
    try:
        read_cloud(files.cloud)
        if key_file.read_text(encoding="utf-8") == key:
            return
    except (FolderError, OSError):
        pass
    write_cloud(world, files.cloud)
    key_file.write_text(key, encoding="utf-8")


def _truth(files: WorldFiles, world: World) -> Truth:
    """The truth, made again when the programs that make it have changed."""
    by, now = files.home / "truth_made_by.txt", sources_sha(SIMULATOR)
    if files.truth.exists() and not (by.exists() and by.read_text(encoding="utf-8") == now):
        files.truth.unlink()
    truth = load_or_make_truth(world, files.truth)
    by.write_text(now, encoding="utf-8")
    return truth


def _usable(files: WorldFiles, world: World) -> bool:
    try:
        read_base(files.base)
        return _key_file(files.base).read_text(encoding="utf-8") == _base_key(world)
    except (FolderError, OSError):
        return False


def _key_file(path: Path) -> Path:
    return path.with_suffix(".key")


def _base_key(world: World) -> str:
    return key_of(world=world_sha(world), sources=sources_sha(SIMULATOR))


def read_world_base(files: WorldFiles) -> BaseMap:
    """Return the map that every vehicle starts with."""
    return read_base(files.base)


def vehicle_tasks(options: RunOptions, seed: int, files: WorldFiles, keep_drives: bool = False) -> list[VehicleTask]:
    """Return the work of each vehicle of a world, in the order in which the fleet grows."""
    base_sha = read_world_base(files).sha
    sensors = fleet_sensors(options, seed)
    tasks = []
    for sensor, drive in zip(sensors, fleet_configs(options, seed), strict=True):
        key = _key(options, files, base_sha, drive)
        name = f"{drive.vehicle}-{sensor}-{key}"
        tasks.append(
            VehicleTask(
                world=files.world,
                base=files.base,
                voxels=files.voxels,
                sensor=sensor,
                drive=drive,
                poses=options.poses,
                method=options.method,
                result=files.home / "vehicles" / f"{name}.npz",
                key=key,
                recording=_recording(files, name) if keep_drives else None,
                cloud=files.cloud if options.pcd else None,
                rounded=options.upload != "float",
            )
        )
    return tasks


def _key(options: RunOptions, files: WorldFiles, base_sha: str, drive: DriveConfig) -> str:
    """A hash of everything that decides what the vehicle reports. How reports are merged is not among it."""
    method = options.method
    return key_of(
        sources=sources_sha(VEHICLE),
        world=files.home.name,
        base=base_sha,
        truth=sources_sha(SIMULATOR),
        drive=to_mapping(drive),
        poses=str(options.poses),
        rounded=options.upload != "float",
        pcd=sources_sha(PCD) if options.pcd else None,
        method={name: to_mapping(getattr(method, name)) for name in ("localise", "segment", "detect", "report")},
    )


def _recording(files: WorldFiles, name: str) -> Path:
    folder = files.home / "drives"
    folder.mkdir(exist_ok=True)
    return folder / f"{name}.mcap"


def shots_a_second(task: VehicleTask) -> float:
    """What a drive costs."""
    model = task.drive.model
    return len(model.elevations_rad) / model.cycle_ns
