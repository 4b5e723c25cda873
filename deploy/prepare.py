"""What must exist before a fleet can run: the drives, and a store that holds the base map."""

import itertools
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from rich.progress import Progress

from deploy.errors import DeployError
from deploy.fleet_config import FleetConfig
from deploy.run_folder import RunFolder
from fleet_sim.prepare import prepare_fleet_run
from schemas.drive_mcap import read_header
from tile_store.build import build_map
from tile_store.sqlite_store import SqliteStore


@dataclass(frozen=True, slots=True)
class PreparedRun:
    """The input of a run.

    Attributes:
        agent_drives: one recorded or simulated drive (MCAP) a vehicle.
        truth: the truth of a simulated world, None for recorded drives.
    """

    agent_drives: tuple[Path, ...]
    truth: Path | None


def prepare_simulated(config: FleetConfig, folder: RunFolder, progress: Progress) -> PreparedRun:
    """Simulate the world and its drives, and build the base map from the mapping drives of the state before.

    Args:
        config: number of agents and world seed.
        folder: where drives, truth and store are written.
        progress: shows how far the work is.

    Returns:
        One drive an agent, and the truth.
    """
    world = prepare_fleet_run(config.world_seed, config.agents, folder.world, progress, processes=os.cpu_count() or 1)
    with SqliteStore(folder.store) as store:
        build_map(list(world.base_drives), store, progress=progress)
    return PreparedRun(tuple(world.agent_drives), world.truth_path)


def prepare_recorded(
    config: FleetConfig, folder: RunFolder, drives: tuple[Path, ...], base_map: Path | None, agents: int | None
) -> PreparedRun:
    """Take recorded drives and, where one is given, a store that already holds a map.

    Args:
        config: link and modes; its number of agents is not used.
        folder: where the store is copied to.
        drives: MCAP files or folders of them.
        base_map: a store made by `gnd map build`, or None to start without a map.
        agents: number of vehicles; recordings are driven again by further vehicles where there are fewer of them.

    Returns:
        One drive an agent, without truth.

    Raises:
        DeployError: no drive was found, or the map does not exist.
        DriveError: a drive cannot be read.
    """
    found = find_drives(drives)
    for drive in found:
        read_header(drive)  # a broken file is refused before any process starts
    if base_map is not None:
        copy_store(base_map, folder.store)
    count = len(found) if agents is None else config.agents
    return PreparedRun(tuple(itertools.islice(itertools.cycle(found), count)), None)


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
