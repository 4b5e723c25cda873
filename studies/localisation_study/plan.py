"""Everything that a study does for one seed, with the keys under which results are kept; nothing runs here."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from gnd.fleet_sim.drives import DriveConfig
from gnd.fleet_sim.street import street
from gnd.fleet_sim.truth import world_sha
from gnd.gnd_map.config import to_mapping
from studies.localisation_study.kept import Kept
from studies.localisation_study.options import StudyOptions, drive_config
from studies.localisation_study.variants import VARIANTS
from studies.simulation.fleet import fleet_configs
from studies.simulation.folder import RunFolder
from studies.simulation.sources import SIMULATOR, VEHICLE, key_of, sources_sha
from studies.simulation.worlds import WorldFiles, world_files

_STUDY: Final = tuple(
    f"studies/localisation_study/{name}.py" for name in ("localising", "variants", "series", "trials", "work")
)
_MAPS: Final = (*SIMULATOR, "studies/simulation/base_map.py")
_LOCALISER: Final = (
    *SIMULATOR,
    "vehicle_agent/localise",
    *(
        f"vehicle_agent/{name}.py"
        for name in ("local_map", "pipeline", "place", "scans", "surroundings", "tiles_at_hand")
    ),
    *(f"studies/simulation/{name}.py" for name in ("poses", "streams")),
    *_STUDY,
)
_CLOUD: Final = (*VEHICLE, "cloud_merger", "studies/simulation/cloud.py")

WITHOUT: Final = "without_submap"
OUTDATED: Final = "outdated"
UPDATED: Final = "updated"
FRESH: Final = "fresh"


@dataclass(frozen=True, slots=True)
class Run:
    """One run of the localiser.

    Attributes:
        name: `WITHOUT`, `OUTDATED`, `UPDATED`, `FRESH` or one of `VARIANTS`.
        base: file of the map.
        submaps: whether poses are refined with submaps.
        variant: what is done to the measurements, "" for nothing.
        kept: its result.
    """

    name: str
    base: Path
    submaps: bool
    variant: str
    kept: Kept


@dataclass(frozen=True, slots=True)
class SensorPlan:
    """What one sensor does.

    Attributes:
        sensor: short name.
        drive: what is simulated.
        recording: the drive as MCAP, while it is needed.
        runs: of the localiser.
        trials: result of the starts without a pose; None where there are none.
    """

    sensor: str
    drive: DriveConfig
    recording: Path
    runs: tuple[Run, ...]
    trials: Kept | None

    @property
    def done(self) -> bool:
        """Whether nothing is left to do."""
        return all(run.kept.done for run in self.runs) and (self.trials is None or self.trials.done)

    def run(self, name: str) -> Run | None:
        """Return a run by its name, None if this sensor has no such run."""
        return next((run for run in self.runs if run.name == name), None)


@dataclass(frozen=True, slots=True)
class SeedPlan:
    """What is done for one seed.

    Attributes:
        seed: the world's.
        files: world, truth, map of the state before.
        fresh: map of the state after.
        updated: map that the fleet has brought up to date.
        sensors: what each does.
    """

    seed: int
    files: WorldFiles
    fresh: Kept
    updated: Kept
    sensors: tuple[SensorPlan, ...]


def plan_of(folder: RunFolder, seed: int, options: StudyOptions) -> SeedPlan:
    """Return the plan of a seed."""
    files = world_files(folder, seed, options.of_fleet(seed))
    world = world_sha(street(seed, options.street))
    maps_by = {"world": world, "base": options.base, "sources": sources_sha(_MAPS)}
    before = key_of(state="before", **maps_by)
    maps = files.home / "maps"
    fresh = Kept(maps, FRESH, key_of(state="after", **maps_by))
    updated = Kept(maps, UPDATED, _updated_key(before, seed, options))
    paths = {OUTDATED: (files.base, before), FRESH: (fresh.path, fresh.key), UPDATED: (updated.path, updated.key)}
    sensors = tuple(_sensor_plan(files, seed, options, sensor, world, paths) for sensor in options.sensors)
    return SeedPlan(seed, files, fresh, updated, sensors)


def _updated_key(before: str, seed: int, options: StudyOptions) -> str:
    drives = [to_mapping(drive) for drive in fleet_configs(options.of_fleet(seed), seed)[: options.fleet]]
    method = to_mapping(options.method)
    return key_of(before=before, sources=sources_sha(_CLOUD), drives=drives, poses=str(options.poses), method=method)


def _sensor_plan(
    files: WorldFiles, seed: int, options: StudyOptions, sensor: str, world: str, maps: dict[str, tuple[Path, str]]
) -> SensorPlan:
    drive = drive_config(options, seed, sensor)
    drive_key = key_of(world=world, drive=to_mapping(drive), sources=sources_sha(SIMULATOR))
    decides: dict[str, Any] = {
        "drive": drive_key,
        "localise": to_mapping(options.method.localise),
        "sources": sources_sha(_LOCALISER),
    }

    def run(name: str, on: str, *, submaps: bool = True, variant: str = "") -> Run:
        path, map_key = maps[on]
        key = key_of(map=map_key, submaps=submaps, variant=variant, **decides)
        return Run(name, path, submaps, variant, Kept(files.home / "runs", f"{sensor}-{name}", key))

    runs = [run(WITHOUT, OUTDATED, submaps=False), *(run(name, name) for name in (OUTDATED, UPDATED, FRESH))]
    if sensor in options.variants_of:
        runs += [run(name, OUTDATED, variant=name) for name in VARIANTS]
    trials = Kept(
        files.home / "runs", f"{sensor}-trials", key_of(map=maps[OUTDATED][1], trials=options.trials, **decides)
    )
    recording = files.home / "drives" / f"{sensor}-{drive_key}.mcap"
    return SensorPlan(sensor, drive, recording, tuple(runs), trials if options.trials else None)
