"""The analysis of errors of a finished run, from its folder."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gnd.fleet_sim.truth import Level, read_truth
from gnd.gnd_map.config import from_mapping
from studies.simulation.errors import OptionError
from studies.simulation.folder import RunFolder
from studies.simulation.losses import Case, Loss, fleet_losses, mean_losses, plain, single_losses
from studies.simulation.method import MethodParameters
from studies.simulation.result import read_result
from studies.simulation.worlds import WorldFiles, read_world_base


def analyse(
    out: Path, stages: Sequence[str], levels: Sequence[Level], changes: Sequence[str] = (), exact: Path | None = None
) -> dict[str, Any]:
    """Return the losses by stage and level, means over the run's worlds (and over the vehicles of a sensor).

    Args:
        out: folder of the run.
        stages: "single", "single.<sensor>" or a number of vehicles; by default all that the run reports.
        levels: of the truth.
        changes: replaced parameters of the merge.
        exact: folder of the same run with true poses, which tells what the poses cost.

    Raises:
        FolderError: no finished run is in the folder.
        OptionError: no such stage.
    """
    mark = RunFolder(out).finished()
    cases = _cases(out, mark, changes)
    if exact is not None:
        cases = _beside(cases, mark, exact, changes)
    sensors = sorted({vehicle.sensor for case in cases for vehicle in case.vehicles})
    wanted = list(stages) or [*(f"single.{sensor}" for sensor in sensors), *map(str, mark["options"]["vehicles"])]
    return {stage: {level: plain(_losses(cases, stage, level, sensors)) for level in levels} for stage in wanted}


def _cases(out: Path, mark: dict[str, Any], changes: Sequence[str]) -> list[Case]:
    method = from_mapping(MethodParameters, mark["options"]["method"]).with_changes(changes)
    return [_case(out, world, mark["options"]["base"], method) for world in mark["worlds"]]


def _beside(cases: Sequence[Case], mark: dict[str, Any], exact: Path, changes: Sequence[str]) -> list[Case]:
    """The cases with those of the run with true poses beside them."""
    other = RunFolder(exact).finished()
    ignored = ("poses", "method", "pcd")
    differ = [k for k, v in mark["options"].items() if k not in ignored and other["options"].get(k) != v]
    if differ or other["options"]["poses"] != "true":
        raise OptionError(f"{exact} is not the same run with --poses true: {', '.join(differ) or 'poses'} differ")
    return [replace(a, exact=b) for a, b in zip(cases, _cases(exact, other, changes), strict=True)]


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
