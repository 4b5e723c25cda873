"""A small world for whole fleet runs: a stretch of the simulated street, mapped, then driven after it changed."""

import signal
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from fleet_testing import SEED, Run
from prepared import Prepared

from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.street import street
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore

SCANS = 70


@dataclass(frozen=True)
class SmallWorld:
    base_map: Path
    drives: tuple[Path, ...]


@pytest.fixture(scope="session")
def small_world(prepared: Prepared) -> SmallWorld:
    folder = prepared("small_world", make_small_world)
    return SmallWorld(folder / "base.sqlite", tuple(folder / f"car-{n}.mcap" for n in range(2)))


def make_small_world(folder: Path) -> None:
    world = street(SEED)
    mapping = DriveConfig("mapper", "VLP-16", "before", errors=PERFECT, car_share=0.0, scans=SCANS + 20, cruise_mps=7.0)
    mapped = simulate_drive(world, mapping, folder / "mapper.mcap")
    with SqliteStore(folder / "base.sqlite") as store:
        build_map([mapped], store)
    configs = [DriveConfig(f"car-{n}", "VLP-16", seed=SEED + n, scans=SCANS) for n in range(2)]
    for config in configs:
        simulate_drive(world, config, folder / f"{config.vehicle}.mcap")


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory: pytest.TempPathFactory, small_world: SmallWorld) -> Path:
    """The folder of a whole run of both drives that has ended by itself; tests copy what they change."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    drives = [word for drive in small_world.drives for word in ("--drives", str(drive))]
    Run(folder, *drives, "--map", str(small_world.base_map), "--link", "4g", timeout_s=900).finish()
    return folder


@pytest.fixture
def start_run(tmp_path: Path, small_world: SmallWorld) -> Iterator[Callable[..., Run]]:
    runs: list[Run] = []

    def start(*arguments: str, name: str = "run") -> Run:
        drives = [word for drive in small_world.drives for word in ("--drives", str(drive))]
        runs.append(Run(tmp_path / name, *drives, "--map", str(small_world.base_map), *arguments))
        return runs[-1]

    yield start
    for run in runs:
        if run.process.poll() is None:
            run.process.send_signal(signal.SIGTERM)
            try:
                run.process.communicate(timeout=30)
            except subprocess.TimeoutExpired:  # the processes of a killed launcher end by themselves
                run.process.kill()
                run.process.communicate()
                raise
