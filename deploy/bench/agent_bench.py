"""What a vehicle costs: real drives against a real router, tile server and shard, each vehicle alone in its process."""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.progress import Progress

from gnd.deploy.errors import DeployError
from gnd.deploy.fleet import agent_config, cloud_processes, supervised
from gnd.deploy.fleet_config import FleetConfig
from gnd.deploy.live import FleetState
from gnd.deploy.prepare import copy_store, prepare_simulated
from gnd.deploy.processes import start_fork_server
from gnd.deploy.run_folder import RunFolder
from gnd.deploy.site import SiteFrame, loopback_site
from gnd.fleet_sim.drives import simulate_drive
from gnd.fleet_sim.prepare import agent_configs
from gnd.fleet_sim.sensors import SHORT_NAMES
from gnd.fleet_sim.world import read_world
from gnd.gnd_map.settings import plain_settings
from gnd.schemas.drive_mcap import read_header
from gnd.tile_store.sqlite_store import SqliteStore

SENSORS: Final = ("vlp16", "hdl32e", "hdl64e")
WARM_UP_SCANS: Final = 20
"""Of a drive, that count for no stage: kernels are loaded, the first pose is found."""
DEADLINE_S: Final = 1800.0
_SETTLE_S: Final = 1.0


@dataclass(frozen=True, slots=True)
class AgentFigures:
    """One drive of one vehicle.

    Attributes:
        drive: name of the recording.
        real_time: seconds driven a second of CPU, reading of the recording, all threads and the end of the drive
            included.
        ms: CPU of the agent's thread a scan [ms] by stage: mean, p50, p99; "whole scan" is their sum.
        memory_mb: resident memory when the first item is asked for, and the most.
        holders_mb: resident memory by holder after the last scan.
        start_s: CPU of each step until the first scan is worked on.
        compiling_s: CPU of compiling kernels, 0 where the disk holds them: in all, and after the first scan.
        end_s: CPU of the end of the drive: what waits in the lags is judged and reported.
        localisation: errors against the recording's reference, as `result.json` has them.
    """

    drive: str
    real_time: float
    ms: dict[str, dict[str, float]]
    memory_mb: dict[str, float]
    holders_mb: dict[str, float]
    start_s: dict[str, float]
    compiling_s: tuple[float, float]
    end_s: float
    localisation: dict[str, Any]

    @classmethod
    def of(cls, drive: str, told: dict[str, Any]) -> "AgentFigures":
        """From what a vehicle's process has told."""
        laps = told["scans"][WARM_UP_SCANS:] or told["scans"]
        stages = sorted({stage for lap in laps for stage in lap})
        by_stage = {stage: np.array([lap.get(stage, 0.0) for lap in laps]) * 1e3 for stage in stages}
        by_stage["whole scan"] = np.sum(list(by_stage.values()), axis=0)
        return cls(
            drive,
            told["drive_s"] / told["cpu_s"],
            {stage: _spread(ms) for stage, ms in by_stage.items()},
            told["memory_mb"],
            told["holders_mb"],
            told["start_s"],
            (told["compiling_s"]["all"], told["compiling_s"]["later"]),
            sum(told["end"].values()),
            told["localisation"],
        )

    @property
    def ready_s(self) -> float:
        """CPU of all that is done once: until the first scan is worked on, and kernels compiled later."""
        return sum(self.start_s.values()) + self.compiling_s[1]


def _spread(ms: "np.ndarray[Any, np.dtype[np.float64]]") -> dict[str, float]:
    return {"mean": float(ms.mean()), "p50": float(np.median(ms)), "p99": float(np.quantile(ms, 0.99))}


@dataclass(frozen=True, slots=True)
class AgentBench:
    """All that was measured.

    Attributes:
        warm: by sensor, or by recording: kernels are on the disk.
        first: the first start ever: no kernel is; None: not asked for.
    """

    warm: dict[str, AgentFigures]
    first: AgentFigures | None

    def as_json(self, ratio: dict[str, float]) -> dict[str, Any]:
        """Plain values; what stands for all drives is that of the last, the densest sensor."""
        last = list(self.warm.values())[-1]
        return {
            "real_time": {name: one.real_time for name, one in self.warm.items()},
            "ms": last.ms,
            "memory_mb": last.memory_mb,
            "start_s": {
                "warm": next(iter(self.warm.values())).ready_s,
                "first": None if self.first is None else self.first.ready_s,
            },
            "ratio": ratio,
            "drives": {name: asdict(one) for name, one in self.warm.items()},
        }


def bench_agent(
    folder: RunFolder, drive: Path | None, base_map: Path | None, world_seed: int, *, first: bool, progress: Progress
) -> AgentBench:
    """Drive, and measure.

    Args:
        folder: of the run; worlds and drives stay in it.
        drive: a recording instead of the simulated street.
        base_map: its map.
        world_seed: of the simulated street.
        first: measure the first start ever, too: all kernels are compiled once more.
        progress: shows the work.

    Raises:
        GndError: drives cannot be made or driven; a vehicle's process has failed.
    """
    start_fork_server()
    config = FleetConfig(agents=1, shards=1, link="none", headway_s=0.0, world_seed=world_seed)
    drives = _simulated(config, folder, progress) if drive is None else _recorded(drive, base_map, folder)
    with _cloud(config, folder) as site:
        bench = _Vehicles(config, folder, site, progress)
        warm_name, warm_drive = next(iter(drives.items()))
        bench.run("warm-up", warm_drive)  # kernels that this machine does not have yet are compiled here
        warm = {name: bench.run(name, path) for name, path in drives.items()}
        return AgentBench(warm, bench.run(f"first-start-{warm_name}", warm_drive, compile_all=True) if first else None)


def _simulated(config: FleetConfig, folder: RunFolder, progress: Progress) -> dict[str, Path]:
    """One drive a sensor through the same street after it changed, and the map of before in the store."""
    prepared = prepare_simulated(config, folder, None, progress)
    assert prepared.world is not None
    world, (like,) = read_world(prepared.world), agent_configs(config.world_seed, 1)
    drives = {}
    for name in progress.track(SENSORS, description="drives"):
        drives[name] = folder.world / "drives" / f"{name}.mcap"
        simulate_drive(world, replace(like, sensor=SHORT_NAMES[name], camera=None), drives[name])
    return drives


def _recorded(drive: Path, base_map: Path | None, folder: RunFolder) -> dict[str, Path]:
    read_header(drive).check_placed()  # a broken file is refused before any process starts
    if base_map is None:
        SqliteStore(folder.store).close()  # an empty map: tile server and shard open no store that is not there
    else:
        copy_store(base_map, folder.store)
    return {drive.stem: drive}


@contextmanager
def _cloud(config: FleetConfig, folder: RunFolder) -> Iterator[SiteFrame]:
    """Router, tile server and one shard, as processes of their own."""
    site = loopback_site(config, 1)
    with supervised(folder, FleetState()) as supervisor:
        for spec in cloud_processes(config, folder, site):
            if spec.name != "watcher":
                supervisor.start(spec)
        time.sleep(_SETTLE_S)
        yield site


@dataclass(frozen=True, slots=True)
class _Vehicles:
    """Starts vehicles, one after the other."""

    config: FleetConfig
    folder: RunFolder
    site: SiteFrame
    progress: Progress

    def run(self, name: str, drive: Path, *, compile_all: bool = False) -> AgentFigures:
        """One vehicle drives a recording alone, with an empty cache of tiles.

        Raises:
            DeployError: its process failed; the message names its log.
        """
        task = self.progress.add_task(f"{name}: {drive.stem}", total=None)
        work = self.folder.agents / name
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        agent = agent_config(self.config, name, drive, self.folder, self.site.vehicles[0])
        asked = {"settings": plain_settings(replace(agent, work_dir=work)), "out": str(work / "measured.json")}
        (work / "asked.json").write_text(json.dumps(asked), encoding="utf-8")
        kernels = {"NUMBA_CACHE_DIR": str(work / "kernels")} if compile_all else {}
        _run_process(work, {**os.environ, **kernels}, self.folder.logs / f"{name}.log")
        self.progress.remove_task(task)
        told = json.loads((work / "measured.json").read_text(encoding="utf-8"))
        if compile_all:
            shutil.rmtree(work / "kernels", ignore_errors=True)
        return AgentFigures.of(drive.stem, told)


def _run_process(work: Path, environment: dict[str, str], log: Path) -> None:
    command = [sys.executable, "-m", "gnd.deploy.bench.vehicle_process", str(work / "asked.json")]
    with log.open("wb") as out:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, env=environment)  # noqa: S603 - ours
        try:
            code = process.wait(DEADLINE_S)
        except BaseException:
            process.kill()
            process.wait()
            raise
    if code:
        raise DeployError(f"the vehicle's process ended with code {code}: read {log}")


def flame_graph(work: Path, out: Path, log: Path) -> None:
    """Drive once more under py-spy, and write a speedscope file.

    Raises:
        DeployError: py-spy is not installed, or may not look at its own child here.
    """
    py_spy = shutil.which(
        "py-spy", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    )
    if py_spy is None:
        raise DeployError("there is no py-spy: pip install py-spy")
    command = [py_spy, "record", "--format", "speedscope", "--output", str(out), "--rate", "250", "--"]
    command += [sys.executable, "-m", "gnd.deploy.bench.vehicle_process", str(work / "asked.json")]
    with log.open("wb") as stream:
        code = subprocess.run(command, stdout=stream, stderr=subprocess.STDOUT, check=False).returncode  # noqa: S603
    if code or not out.exists():
        raise DeployError(f"py-spy ended with code {code}: read {log}")
