"""The hard cases from options to figures; what is done is kept, and a second start continues."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from rich.progress import Progress

from gnd.fleet_sim.sensors import SHORT_NAMES
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from studies.hard_cases.cases import CASES
from studies.hard_cases.localising import CaseRun, ClockOffset
from studies.hard_cases.scores import joined, row_of
from studies.hard_cases.work import CaseResult, make_map, read_result, run_task, task_of
from studies.simulation.errors import OptionError
from studies.simulation.pool import Job, run_jobs

FORMAT: Final = "gnd.hard-cases"
_QUANTITIES: Final = ("longitudinal_m", "lateral_m", "heading_deg")


@dataclass(frozen=True, slots=True)
class HardOptions:
    """What to run.

    Attributes:
        seeds: of places and drives.
        sensors: short names.
        cases: names.
        localise: parameters of the localiser.
        shorter: share of the usual length of the places, for a quick look.
    """

    seeds: tuple[int, ...]
    sensors: tuple[str, ...]
    cases: tuple[str, ...] = tuple(CASES)
    localise: LocaliserParameters = field(default_factory=LocaliserParameters)
    shorter: float = 1.0

    def __post_init__(self) -> None:
        for option, chosen, known in (("sensors", self.sensors, SHORT_NAMES), ("cases", self.cases, CASES)):
            wrong = [name for name in chosen if name not in known]
            if wrong or not chosen or len(set(chosen)) != len(chosen):
                named = ", ".join(wrong) or ", ".join(chosen) or "(none)"
                raise OptionError(f"--{option}: need some of {', '.join(known)}, each once, got {named}")
        if not self.seeds or min(self.seeds) < 0 or len(set(self.seeds)) != len(self.seeds):
            raise OptionError(f"--seeds: need numbers >= 0, each once, got {self.seeds}")
        if not 0.65 <= self.shorter <= 1.0:
            raise OptionError(f"--shorter must be in 0.65 … 1, got {self.shorter}")


def study(
    options: HardOptions, root: Path, processes: int, progress: Progress, *, keep_drives: bool = False
) -> dict[str, Any]:
    """Run what is not yet in the folder and return the figures; with `keep_drives` its drives stay as MCAP, too.

    Raises:
        GndError: something cannot be made as asked.
    """
    tasks = [
        task_of(root, case, sensor, seed, options.localise, options.shorter)
        for seed in options.seeds
        for case in options.cases
        for sensor in options.sensors
    ]
    if keep_drives:
        drives = root / "drives"
        tasks = [replace(t, recording=drives / f"{t.case}-{t.sensor}-{t.seed}.mcap") for t in tasks]
    missing = [t for t in tasks if not t.kept.done or (t.recording is not None and not t.recording.is_file())]
    maps = {task.base: task for task in missing if not task.base.is_file()}
    run_jobs([Job(f"map {path.stem}", make_map, (task,)) for path, task in maps.items()], processes, progress, "maps")
    run_jobs([Job(task.name, run_task, (task,)) for task in missing], processes, progress, "drives")
    return figures_of(options, {(t.case, t.sensor, t.seed): read_result(t.kept) for t in tasks})


def figures_of(options: HardOptions, results: Mapping[tuple[str, str, int], CaseResult]) -> dict[str, Any]:
    """Return all figures as plain values, by case and sensor."""
    cases: dict[str, dict[str, Any]] = {}
    for case in options.cases:
        cases[case] = {}
        for sensor in options.sensors:
            found = {seed: results[case, sensor, seed] for seed in options.seeds}
            cases[case][sensor] = _sensor_figures(found)
    return {
        "format": FORMAT,
        "version": 1,
        "seeds": list(options.seeds),
        "sensors": list(options.sensors),
        "about": {case: CASES[case].about for case in options.cases},
        "cases": cases,
    }


def _sensor_figures(results: Mapping[int, CaseResult]) -> dict[str, Any]:
    whole = _rows([result.with_submaps for result in results.values()])
    without = _rows([result.without_submaps for result in results.values()])
    seeds = [{"seed": seed, **_seed_figures(result)} for seed, result in results.items()]
    return {
        **whole,
        "without_submaps": without,
        "submaps_worse_by": _worse_by(whole["refined"], without["refined"]),
        "worst_seed": max(seeds, key=_badness)["seed"],
        "seeds": seeds,
        "cpu_s": sum(sum(result.seconds.values()) for result in results.values()) / len(results),
    }


def _seed_figures(result: CaseResult) -> dict[str, Any]:
    return {
        **_rows([result.with_submaps]),
        "without_submaps": _rows([result.without_submaps]),
        "time_offset": _clock(result.with_submaps.clock),
        "cpu_s": result.seconds,
    }


def _rows(runs: Sequence[CaseRun]) -> dict[str, Any]:
    scans = sum(run.scans for run in runs)
    return {
        "refined": row_of(joined([run.refined for run in runs]), scans),
        "online": row_of(joined([run.online for run in runs]), scans),
    }


def _clock(clock: ClockOffset | None) -> dict[str, float] | None:
    return None if clock is None else {"offset_s": clock.offset_s, "sigma_s": clock.sigma_s}


def _worse_by(with_submaps: Mapping[str, Any], without: Mapping[str, Any]) -> dict[str, float] | None:
    """By how much the 95 % error with submaps is larger than without; None where either has no pose."""
    if with_submaps[_QUANTITIES[0]] is None or without[_QUANTITIES[0]] is None:
        return None
    return {name: with_submaps[name]["p95"] - without[name]["p95"] for name in _QUANTITIES}


def _badness(row: Mapping[str, Any]) -> tuple[float, ...]:
    """What makes a seed the worst: wrong poses called good first, then errors."""
    wrong = row["refined"]["wrong_called_good"] + row["online"]["wrong_called_good"]
    refined = row["refined"]
    error = max((refined[name]["p95"] for name in _QUANTITIES if refined[name] is not None), default=float("inf"))
    return float(wrong), float(refined["right_called_bad"]), error
