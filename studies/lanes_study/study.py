"""`gnd reproduce lanes`: borders of lanes mapped by vehicles, and what changed told as edits of a Lanelet2 map."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from studies.frame.command import Bench, StudyReport, study
from studies.frame.options import check, option, seeds
from studies.frame.pool import Job
from studies.frame.tables import Sheet, sheet_of

_FLEETS: Final = (1, 2, 3, 5, 10, 20)
_LAYER: Final = {
    "vehicles": "{vehicles}",
    "recall": "{recall:.1%}",
    "precision": "{precision:.1%}",
    "lateral 50 / 95 % m": "{lateral_m_p50:.3f} / {lateral_m_p95:.3f}",
    "type right": "{type_right:.1%}",
    "NEES (1 dof)": "{nees:.2f}",
}
_REAL: Final = {
    "way m": "{way_m}",
    "pieces of even scans": "{even}",
    "of odd scans": "{odd}",
    "in both": "{in_both}",
    "apart 50 / 95 % m": "{apart_m_p50} / {apart_m_p95}",
}
_EDITS: Final = {
    "vehicles": "{vehicles}",
    "changes": "{changes}",
    "found": "{found}",
    "edits": "{edits}",
    "right": "{right}",
    "wrong": "{wrong_n}",
    "wrong a km of unchanged border": "{false_per_km:.2f}",
}


@dataclass(frozen=True, slots=True)
class LaneOptions:
    """Streets, fleets and sensors."""

    seeds: tuple[int, ...] = seeds(1001)
    vehicles: int = option(5, "Vehicles of the largest fleet; smaller ones are told, too.", span=(1, 20))
    sensor: str = option("VLP-16", "Of all vehicles.", known=("VLP-16", "HDL-32E", "camera"))
    kitti: Path | None = option(
        None, "Recording KITTI 00 (scans with reflectance, poses): what is seen there.", of=Path
    )
    length_m: float = option(200.0, "Of each street, m.", "--length", span=(100, 1000))

    def __post_init__(self) -> None:
        check(self)


@study(LaneOptions, out="runs/lanes")
def lanes(options: LaneOptions, bench: Bench) -> StudyReport:
    """Borders of lanes mapped by vehicles, merged, and told as edits of a Lanelet2 map."""
    from studies.lanes_study.driving import LaneTask, lane_drive
    from studies.lanes_study.merging import outcome_of
    from studies.lanes_study.real import draw_real, kitti_paint, repeatability

    tasks = [LaneTask(seed, options.sensor, options.length_m) for seed in options.seeds]
    jobs = [
        Job(f"seed {task.seed}, vehicle {vehicle}", lane_drive, (task, vehicle))
        for task in tasks
        for vehicle in range(options.vehicles)
    ]
    drives = bench.run("drives", jobs)
    n = options.vehicles
    fleets = [size for size in _FLEETS if size < n] + [n]
    with bench.timed("merging"):
        found = outcome_of(tasks, [drives[k * n : (k + 1) * n] for k in range(len(tasks))], fleets)
    real = None if options.kitti is None else kitti_paint(options.kitti)
    if real is not None:
        with bench.timed("real street"):
            found["real"], even, odd = repeatability(real)
        if bench.pictures:
            draw_real(real, even, odd, bench.folder.root / "lanes_real.png")
    found = {"seeds": list(options.seeds), "sensor": options.sensor, "length_m": options.length_m, **found}
    return StudyReport(found, _sheets(found), lambda folder: _draw(tasks[0], drives[:n], folder))


def _sheets(found: dict[str, Any]) -> list[Sheet]:
    layer = {name: row | {"vehicles": name} for name, row in found["layer"].items()}
    edits = {name: row | {"vehicles": name, "wrong_n": len(row["wrong"])} for name, row in found["edits"].items()}
    title = f"Borders mapped from nothing, {found['sensor']}, tolerance 0.15 m"
    sheets = [sheet_of(title, _LAYER, layer), sheet_of("Edits of the HD map", _EDITS, edits)]
    return (
        [*sheets, sheet_of("KITTI 00: even scans against odd ones", _REAL, {"": found["real"]})]
        if "real" in found
        else sheets
    )


def _draw(task: Any, drives: list[Any], folder: Path) -> Path:
    from studies.lanes_study.figures import draw_street

    return draw_street(task, drives, folder / "lanes_street.png")
