"""The analysis of errors of a finished run, from its folder."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.simulation.errors import OptionError
from benchmarks.simulation.folder import RunFolder
from benchmarks.simulation.losses import Case, Loss, fleet_losses, mean_losses, plain, single_losses
from benchmarks.simulation.method import MethodParameters
from benchmarks.simulation.result import read_result
from benchmarks.simulation.worlds import WorldFiles, read_world_base
from fleet_sim.truth import Level, read_truth
from gnd_map.config import from_mapping


def analyse(out: Path, stages: Sequence[str], levels: Sequence[Level], changes: Sequence[str] = ()) -> dict[str, Any]:
    """Return the losses by stage and level, means over the run's worlds (and over the vehicles of a sensor).

    Args:
        out: folder of the run.
        stages: "single", "single.<sensor>" or a number of vehicles; by default all that the run reports.
        levels: of the truth.
        changes: replaced parameters of the merge.

    Raises:
        FolderError: no finished run is in the folder.
        OptionError: no such stage.
    """
    mark = RunFolder(out).finished()
    method = from_mapping(MethodParameters, mark["options"]["method"]).with_changes(changes)
    cases = [_case(out, world, mark["options"]["base"], method) for world in mark["worlds"]]
    sensors = sorted({vehicle.sensor for case in cases for vehicle in case.vehicles})
    wanted = list(stages) or [*(f"single.{sensor}" for sensor in sensors), *map(str, mark["options"]["vehicles"])]
    return {stage: {level: plain(_losses(cases, stage, level, sensors)) for level in levels} for stage in wanted}


def _case(out: Path, world: dict[str, Any], base: str, method: MethodParameters) -> Case:
    files = WorldFiles(out / world["folder"], base)
    vehicles = [read_result(out / v["file"], v["key"]) for v in world["vehicles"]]
    return Case(read_truth(files.truth), read_world_base(files), vehicles, method)


def _losses(cases: Sequence[Case], stage: str, level: Level, sensors: Sequence[str]) -> list[Loss]:
    kind, _, sensor = stage.partition(".")
    if kind == "single" and (not sensor or sensor in sensors):
        return mean_losses([single_losses(c, v, level) for c in cases for v in c.vehicles if sensor in ("", v.sensor)])
    most = min(len(case.vehicles) for case in cases)
    if stage.isdecimal() and 1 <= int(stage) <= most:
        return mean_losses([fleet_losses(case, int(stage), level) for case in cases])
    raise OptionError(f"unknown stage {stage!r}: single, single.<{'|'.join(sensors)}>, or 1 … {most} vehicles")
