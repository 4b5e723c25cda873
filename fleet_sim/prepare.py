"""What a simulated fleet run needs before it can start: world, truth, mapping drives, one drive a vehicle."""

import multiprocessing
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Final

from rich.progress import Progress

from gnd.ending import ctrl_c_withheld
from gnd.fleet_sim.camera import SignCamera
from gnd.fleet_sim.drives import EPOCH_NS, PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.errors import SimError
from gnd.fleet_sim.feature_files import write_feature_layers
from gnd.fleet_sim.feature_truth import base_features, feature_truth
from gnd.fleet_sim.street import StreetOptions
from gnd.fleet_sim.street import street as make_street
from gnd.fleet_sim.trajectory import Direction
from gnd.fleet_sim.truth import load_or_make_truth
from gnd.fleet_sim.world import write_world

SENSORS: Final = ("VLP-16", "HDL-32E")
FEATURES_FILE: Final = "features.json"
_NS_PER_S: Final = 1_000_000_000
_DAY_NS: Final = 86_400 * _NS_PER_S
_HOUR_NS: Final = 3_600 * _NS_PER_S
_MAPPING_DAYS: Final = 72
"""The paper's map was made on 1 August 2019, its drives on 12 October (section 7.1)."""


@dataclass(frozen=True, slots=True)
class FleetWorld:
    """Files of a simulated world.

    Attributes:
        base_drives: drives of a mapping vehicle through the state before, with exact reference poses.
        agent_drives: one drive a vehicle through the state after.
        truth_path: what changed, see `gnd.fleet_sim.truth`.
        world_path: the world itself.
        features_path: the feature layers of the map before, see `gnd.fleet_sim.feature_files`.
    """

    base_drives: tuple[Path, ...]
    agent_drives: tuple[Path, ...]
    truth_path: Path
    world_path: Path
    features_path: Path


def mapping_configs(world_seed: int) -> tuple[DriveConfig, ...]:
    """Return the drives of the mapping vehicle: an HDL-32E up and down the empty street, slowly."""
    directions: tuple[Direction, Direction] = (1, -1)
    return tuple(
        DriveConfig(
            vehicle=f"mapper-{index}",
            sensor="HDL-32E",
            state="before",
            direction=direction,
            seed=1_000_003 * world_seed + 900_000 + index,
            cruise_mps=7.0,
            car_share=0.0,
            errors=PERFECT,
            start_ns=EPOCH_NS - _MAPPING_DAYS * _DAY_NS + index * _HOUR_NS,
        )
        for index, direction in enumerate(directions)
    )


def agent_configs(world_seed: int, agents: int, headway_s: float = 0.0) -> tuple[DriveConfig, ...]:
    """Return one drive a vehicle: sensors and directions mixed evenly, every drive with its own parked cars.

    Args:
        world_seed: seed of the street.
        agents: number of vehicles.
        headway_s: time between two starts, in the order of their numbers; 0: the drives have nothing to do with each
            other, and are stamped an hour apart.

    Raises:
        SimError: fewer than one vehicle.
    """
    if agents < 1:
        raise SimError(f"a fleet needs at least one vehicle, got {agents}")
    step_ns = round(headway_s * _NS_PER_S) or _HOUR_NS
    return tuple(
        DriveConfig(
            vehicle=f"vehicle-{index}",
            sensor=SENSORS[index % 2],
            direction=1 if index // 2 % 2 == 0 else -1,
            seed=1_000_003 * world_seed + index,
            start_ns=EPOCH_NS + index * step_ns,
            camera=SignCamera(),
        )
        for index in range(agents)
    )


def prepare_fleet_run(
    world_seed: int,
    agents: int,
    out_dir: Path,
    progress: Progress | None = None,
    processes: int = 2,
    scans: int | None = None,
    *,
    reuse: bool = False,
    headway_s: float = 0.0,
    street: StreetOptions | None = None,
) -> FleetWorld:
    """Make a world, its truth and all drives.

    A truth of the same world that is already in the folder is used again; drives are simulated anew unless `reuse`.

    Args:
        world_seed: seed of the street.
        agents: number of vehicles.
        out_dir: folder for world.json, features.json, truth.npz and drives/, made if need be.
        progress: gets one task that counts drives and truth.
        processes: worker processes for the drives.
        scans: at most so many scans a drive, None for the whole street.
        reuse: keep the drives that are there; the caller vouches that this simulator made them for this world.
        headway_s: time between the starts of two vehicles, see `agent_configs`.
        street: family, parking, length and place; by default the usual street.

    Returns:
        Where everything is.

    Raises:
        SimError: nonsense was asked for, or a file cannot be written.
        DriveError: a drive cannot be written.
    """
    configs = [*mapping_configs(world_seed), *agent_configs(world_seed, agents, headway_s)]
    configs = [replace(config, scans=scans) for config in configs]
    folder = out_dir / "drives"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SimError(f"cannot make the folder {folder}: {error}") from error
    world = make_street(world_seed, street)
    write_world(world, out_dir / "world.json")
    write_feature_layers(base_features(feature_truth(world)), out_dir / FEATURES_FILE)
    paths = [folder / f"{config.vehicle}.mcap" for config in configs]
    missing = [(config, path) for config, path in zip(configs, paths, strict=True) if not (reuse and path.exists())]
    jobs: list[tuple[Callable[..., object], tuple[object, ...]]] = [
        (load_or_make_truth, (world, out_dir / "truth.npz")),
        *((simulate_drive, (world, config, path)) for config, path in missing),
    ]
    _run(jobs, processes, progress)
    split = len(configs) - agents
    files = (out_dir / "truth.npz", out_dir / "world.json", out_dir / FEATURES_FILE)
    return FleetWorld(tuple(paths[:split]), tuple(paths[split:]), *files)


def _run(
    jobs: list[tuple[Callable[..., object], tuple[object, ...]]], processes: int, progress: Progress | None
) -> None:
    """Run jobs in worker processes.

    Spawned, not forked: the caller may have threads, and its fork server, if it has one, is warmed for other work.
    """
    task = progress.add_task("simulating", total=len(jobs)) if progress else None
    context = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())
    with ProcessPoolExecutor(max(1, min(processes, len(jobs))), mp_context=context) as pool:
        resource_tracker.ensure_running()  # where the pool starts this itself, it lets Ctrl-C through again
        with ctrl_c_withheld():  # this process ends them
            futures: list[Future[object]] = [pool.submit(function, *arguments) for function, arguments in jobs]
        try:
            for future in as_completed(futures):
                future.result()
                if progress and task is not None:
                    progress.advance(task)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in set(multiprocessing.active_children()) - others:
                worker.terminate()  # what it computes nobody wants any more: do not wait for it
            raise
