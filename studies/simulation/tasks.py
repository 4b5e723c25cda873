"""The work of each vehicle, with the key under which its result is kept."""

from pathlib import Path

from gnd.fleet_sim.drives import DriveConfig
from gnd.fleet_sim.truth import read_truth
from gnd.gnd_map.config import to_mapping
from studies.simulation.fleet import fleet_configs, fleet_sensors
from studies.simulation.masses import Watch, choose
from studies.simulation.options import RunOptions
from studies.simulation.sources import PCD, SIMULATOR, VEHICLE, key_of, sources_sha
from studies.simulation.vehicle import VehicleTask
from studies.simulation.worlds import WorldFiles, read_world_base


def vehicle_tasks(options: RunOptions, seed: int, files: WorldFiles, keep_drives: bool = False) -> list[VehicleTask]:
    """Return the work of each vehicle of a world, in the order in which the fleet grows."""
    base_sha, watch = read_world_base(files).sha, choose(read_truth(files.truth))
    sensors = fleet_sensors(options, seed)
    tasks = []
    for index, (sensor, drive) in enumerate(zip(sensors, fleet_configs(options, seed), strict=True)):
        watched = watch if index == _watching(sensors) else None
        key = _key(options, files, base_sha, drive, watched)
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
                watch=watched,
                recording=_recording(files, name) if keep_drives else None,
                cloud=files.cloud if options.pcd else None,
                rounded=options.upload != "float",
            )
        )
    return tasks


def _key(options: RunOptions, files: WorldFiles, base_sha: str, drive: DriveConfig, watched: Watch | None) -> str:
    """A hash of everything that decides what the vehicle reports. How reports are merged is not among it."""
    method = options.method
    return key_of(
        sources=sources_sha(VEHICLE),
        world=files.home.name,
        base=base_sha,
        truth=sources_sha(SIMULATOR),
        drive=to_mapping(drive),
        poses=str(options.poses),
        watch=watched,
        rounded=options.upload != "float",
        pcd=sources_sha(PCD) if options.pcd else None,
        method={name: to_mapping(getattr(method, name)) for name in ("localise", "segment", "detect", "report")},
    )


def _recording(files: WorldFiles, name: str) -> Path:
    folder = files.home / "drives"
    folder.mkdir(exist_ok=True)
    return folder / f"{name}.mcap"


def _watching(sensors: tuple[str, ...]) -> int:
    """The vehicle whose masses are drawn: the first with an HDL-32E, else the first."""
    return sensors.index("hdl32e") if "hdl32e" in sensors else 0


def shots_a_second(task: VehicleTask) -> float:
    """What a drive costs."""
    model = task.drive.model
    return len(model.elevations_rad) / model.cycle_ns
