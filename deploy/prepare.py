"""What must exist before a fleet can run: the drives, and a store that holds the base map."""

import hashlib
import importlib.resources
import itertools
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from rich.progress import Progress, TaskID

from gnd.deploy.errors import DeployError
from gnd.deploy.features import put_base_layers
from gnd.deploy.fleet_config import FleetConfig
from gnd.deploy.made_up import MadeUp, with_made_up_boxes
from gnd.deploy.mounts import with_wrong_mounts
from gnd.deploy.run_folder import RunFolder
from gnd.deploy.source import Source
from gnd.fleet_sim.prepare import prepare_fleet_run
from gnd.fleet_sim.street import StreetOptions
from gnd.schemas.drive_mcap import read_header
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore


@dataclass(frozen=True, slots=True)
class PreparedRun:
    """The input of a run.

    Attributes:
        agent_drives: one recorded or simulated drive (MCAP) a vehicle.
        truth: the truth of a simulated world, None for recorded drives.
        starts_s: when each starts, in a time that is common to all; empty: each drives in a time of its own.
        world: the simulated world itself, None for recorded drives.
        made_up: boxes that were put into the recorded drives, None where none were.
        identities: folder of the processes' identities, None in a plain fleet.
        repeats: whether several vehicles drive the same recording.
    """

    agent_drives: tuple[Path, ...]
    truth: Path | None
    starts_s: tuple[float, ...] = ()
    world: Path | None = None
    made_up: MadeUp | None = None
    identities: Path | None = None
    repeats: bool = False


def prepare(config: FleetConfig, folder: RunFolder, source: Source, progress: Progress) -> PreparedRun:
    """Make drives and store ready, from recordings or by simulation; see the two functions below."""
    if source.drives:
        prepared = prepare_recorded(config, folder, source)
    else:
        prepared = prepare_simulated(config, folder, source.worlds, progress)
    if source.made_up:
        boxed, made_up = with_made_up_boxes(prepared.agent_drives, source.made_up, folder.world / "drives" / "made-up")
        prepared = replace(prepared, agent_drives=boxed, made_up=made_up)
    folder_of_copies = folder.world / "drives" / "wrong-mounts"
    drives = with_wrong_mounts(prepared.agent_drives, config.wrong_mounts_rad, folder_of_copies)
    return replace(prepared, agent_drives=drives)


def prepare_simulated(config: FleetConfig, folder: RunFolder, worlds: Path | None, progress: Progress) -> PreparedRun:
    """Simulate the world and its drives, and build the base map from the mapping drives of the state before.

    Args:
        config: number of agents and world seed.
        folder: where the store is written, and drives and truth where no folder of worlds is given.
        worlds: folder that keeps worlds, drives and base maps by seed for further runs.
        progress: shows how far the work is.

    Returns:
        One drive an agent, and the truth.
    """
    street = StreetOptions(family=config.family, parking=config.parking)
    home = folder.world if worlds is None else worlds / _world_name(config)
    forget_if_stale(home)
    forget_other_headways(home, config.headway_s)
    processes, headway_s = os.cpu_count() or 1, config.headway_s
    world = prepare_fleet_run(
        config.world_seed, config.agents, home, progress, processes, reuse=True, headway_s=headway_s, street=street
    )
    base_map = home / "base.sqlite"
    if not base_map.exists():
        _build_base(base_map, world.base_drives, progress)
    copy_store(base_map, folder.store)
    if config.feature_layers:
        put_base_layers(folder.store, world.features_path, config.feature_layers)
    starts_s = starts_of(config.agents, headway_s)
    return PreparedRun(tuple(world.agent_drives), world.truth_path, starts_s, world.world_path)


def _world_name(config: FleetConfig) -> str:
    """Name of a kept world: all that decides it but the programs."""
    family = "" if config.family == "street" else f"-{config.family}"
    parking = "" if config.parking is None else f"-parking{100 * config.parking:g}"
    return f"seed-{config.world_seed}{family}{parking}"


def forget_if_stale(home: Path) -> None:
    """Remove drives and base map that another state of the programs has made, and note who makes what follows."""
    made_by, now = home / "made_by.txt", sources_sha()
    if not made_by.exists() or made_by.read_text(encoding="utf-8") != now:
        shutil.rmtree(home / "drives", ignore_errors=True)
        (home / "base.sqlite").unlink(missing_ok=True)
    home.mkdir(parents=True, exist_ok=True)
    made_by.write_text(now, encoding="utf-8")


def forget_other_headways(home: Path, headway_s: float) -> None:
    """Remove the vehicles' drives that are stamped for another headway, and note which they are stamped for."""
    noted, now = home / "headway_s.txt", f"{headway_s:g}"
    if not noted.exists() or noted.read_text(encoding="utf-8") != now:
        for drive in (home / "drives").glob("vehicle-*.mcap"):
            drive.unlink()
    noted.write_text(now, encoding="utf-8")


def starts_of(agents: int, headway_s: float) -> tuple[float, ...]:
    """Return when each vehicle starts; nothing where all start at once."""
    return tuple(number * headway_s for number in range(agents)) if headway_s > 0 else ()


def sources_sha() -> str:
    """Return a hash over the programs that decide what a simulated world, its drives and its base map are."""
    names = ("fleet_sim", "gnd_map", "schemas", "tile_store")
    folders = [Path(str(importlib.resources.files(f"gnd.{name}"))) for name in names]
    files = sorted(file for folder in folders for file in folder.rglob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def _build_base(path: Path, drives: tuple[Path, ...], progress: Progress) -> None:
    partial = path.with_suffix(".partial")
    partial.unlink(missing_ok=True)
    with SqliteStore(partial) as store:
        build_map(list(drives), store, progress=_bar(progress, "base map"))
        store.backup(path)
    for leftover in path.parent.glob(f"{partial.name}*"):
        leftover.unlink()


def _bar(progress: Progress, title: str) -> Callable[[Path, int, int], None]:
    """Return a callback that shows the scans done of each drive as a bar."""
    tasks: dict[Path, TaskID] = {}

    def show(drive: Path, done: int, total: int) -> None:
        if drive not in tasks:
            tasks[drive] = progress.add_task(f"{title}: {drive.stem}", total=total)
        progress.update(tasks[drive], completed=done)

    return show


def prepare_recorded(config: FleetConfig, folder: RunFolder, source: Source) -> PreparedRun:
    """Take recorded drives and, where one is given, a store that already holds a map.

    Args:
        config: gives the number of agents where one was asked for.
        folder: where the store is copied to.
        source: drives, map and number of agents; recordings are driven again by further vehicles where there are
            fewer of them than agents.

    Returns:
        One drive an agent, without truth.

    Raises:
        DeployError: no drive was found, or the map does not exist.
        DriveError: a drive cannot be read.
    """
    found = find_drives(source.drives)
    for drive in found:
        read_header(drive).check_placed()  # a broken file is refused before any process starts
    if source.base_map is not None:
        copy_store(source.base_map, folder.store)
    count = len(found) if source.agents is None else config.agents
    drives = tuple(itertools.islice(itertools.cycle(found), count))
    return PreparedRun(drives, None, starts_of(count, config.headway_s), repeats=len(set(drives)) < len(drives))


def find_drives(paths: tuple[Path, ...]) -> list[Path]:
    """Return the MCAP files among files and folders, sorted within each folder.

    Raises:
        DeployError: a path does not exist, or no drive was found.
    """
    missing = [path for path in paths if not path.exists()]
    if missing:
        raise DeployError(f"no such drive or folder: {', '.join(map(str, missing))}")
    found = [drive for path in paths for drive in (sorted(path.glob("*.mcap")) if path.is_dir() else [path])]
    if not found:
        raise DeployError(f"no *.mcap in {', '.join(map(str, paths))}: make drives from a recording with `gnd import`")
    return found


def copy_store(source: Path, target: Path) -> None:
    """Copy a store as one consistent file, whatever other processes do with it.

    Raises:
        DeployError: there is no such store.
    """
    if not source.is_file():
        raise DeployError(f"no map at {source}: make one with `gnd map build`")
    with SqliteStore(source) as store:
        store.backup(target)


def remove_drives(folder: RunFolder) -> None:
    """Remove the simulated drives of a finished run, by far its largest part."""
    shutil.rmtree(folder.world / "drives", ignore_errors=True)
