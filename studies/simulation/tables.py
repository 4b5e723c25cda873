"""A reproduction as tables, the paper's figures and our targets beside ours."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from gnd.fleet_sim.truth import LEVELS
from studies.frame.tables import Sheet, fixed, sheet, sheet_of
from studies.simulation import scores as reference
from studies.simulation.scores import rows_of, target_single

Found = Mapping[str, Any]
PCD_CODEC: Final = "points"
"""The baseline's upload as the paper counts it: every new and every deleted point with its coordinates."""


def sheets_of(found: Found, asked: Sequence[int]) -> list[Sheet]:
    """Return the scores, the classes of the largest fleet, and its confusion matrix."""
    largest, classes = str(max(asked)), {name: f"{{{name}:.2f}}" for name in ("precision", "recall", "f1")}
    title = f"Classes of the merged map, {largest} vehicles, observable voxels"
    of_classes = sheet_of(title, classes, found["fleet"][largest]["classes"]["observable"])
    names = found["confusion"]["classes"]
    confusion = sheet(f"Confusion, {largest} vehicles, observable voxels (rows: truth)", "", *names)
    for name, row in zip(names, found["confusion"]["fleet"][largest]["observable"], strict=True):
        confusion.add(name, *(f"{value:,}" for value in row))
    confusion.notes += notes_of(found)
    return [_scores(found, asked), of_classes, confusion]


def comparison_sheets(compared: Found, asked: Sequence[int]) -> list[Sheet]:
    """Return the scores of runs with poses of several sources beside each other, what each loses, and its poses."""
    sheets = []
    for name in compared["loss"]:
        sheets += [_losses(compared, name, asked), _poses(compared["poses"][name], name)]
        worst = compared["worst"][name]
        verdict = "met" if worst["met"] else "missed"
        line = f"Poses {name}: at most {worst['loss']:.2f} points lost ({worst['row']}), {worst['must']:g} allowed"
        sheets[-1].notes.append(f"{line}: {verdict}.")
    return sheets


def _losses(compared: Found, name: str, asked: Sequence[int]) -> Sheet:
    against = compared["against"]
    exact, other = rows_of(compared["poses"][against]), rows_of(compared["poses"][name])
    seeds = ", ".join(map(str, compared["poses"][name]["seeds"]))
    columns = [f"{level} {what}" for level in ("observable", "all") for what in (against, name, "loss")]
    table = sheet(f"Macro F1 in percent, world seed {seeds}: poses {against} and {name}", "", *columns)
    for row, loss in compared["loss"][name].items():
        kind, _, number = row.partition(".")
        if kind != "fleet" or int(number) in asked:
            values = [
                value
                for level in ("observable", "all")
                for value in (exact[row][level], other[row][level], loss[level])
            ]
            table.add(_vehicles(int(number)) if kind == "fleet" else f"one drive, {number or '16/32 layers'}",
                      *map(fixed, values))  # fmt: skip
    return table


def _vehicles(n: int) -> str:
    return f"{n} vehicle{'s' * (n > 1)}"


def _poses(found: Found, name: str) -> Sheet:
    """What the localisation of each sensor's drives came to."""
    errors = ("longitudinal_p95_m", "lateral_p95_m", "heading_p95_deg")
    columns = {"scans": "{scans:.0f}", "used": "{scans_used:.0f}", **{key: f"{{poses.{key}:.4f}}" for key in errors}}
    rows = {sensor: {"poses": None} | drive for sensor, drive in found["drives"].items()}
    return sheet_of(f"Poses {name}, mean over the drives of a sensor", columns, rows)


def _scores(found: Found, asked: Sequence[int]) -> Sheet:
    seeds, options = ", ".join(map(str, found["seeds"])), found["parameters"]
    title = f"Macro F1 in percent, world seed {seeds}: {options['mode']}, poses {options['poses']}"
    columns = (*LEVELS, "changes", "paper", "must", "aim", "upload kB")
    table, up = sheet(title, "", *columns), found["upload_bytes"]
    must, aim = reference.MUST, reference.AIM
    table.add("stale map", *_f1(found["stale"]), reference.PAPER_STALE)
    for sensor, stage in found["single"].items():
        table.add(f"one drive, {sensor}", *_f1(stage), "", "", "", _kb(up["single"][sensor]))
    target = target_single(found)
    if target:
        single = (reference.SINGLE, must["single"], aim["single"])
        table.add(
            "one drive, 16/32 layers", *map(fixed, (target[level] for level in LEVELS)), "", *single, style="bold"
        )
    for n in asked:
        name, paper = f"fleet.{n}", {**reference.FLEET, **reference.FLEET_READ_OFF}.get(n, "")
        limits = (paper, must.get(name, ""), aim.get(name, ""))
        style = "bold" if name in must else ""
        table.add(_vehicles(n), *_f1(found["fleet"][str(n)]), *limits, _kb(up["fleet"][str(n)]), style=style)
    for n in asked if "pcd" in found else ():
        size = _kb(found["pcd"]["upload_bytes"]["fleet"][str(n)][PCD_CODEC])
        table.add(f"point clouds, {n}", *_f1(found["pcd"]["fleet"][str(n)]), "", "", "", size, style="dim")
    return table


def _where(found: Found) -> str:
    words = ("new on parking lanes", "by the season", "new where nothing is")
    counts = (found[name] for name in reference.FALSE_WHERE)
    return ", ".join(f"{count:g} {what}" for count, what in zip(counts, words, strict=True))


def kept_line(kept: Found) -> str:
    """Return what the levels leave out of the true changes, which every F1 beside them needs."""
    left = {level: ", ".join(f"{100 - share:.0f} % of {name}" for name, share in kept[level].items()) for level in kept}
    return "Of the true changes " + "; ".join(f"{level} leaves out {what}" for level, what in left.items()) + "."


def notes_of(found: Found) -> list[str]:
    """Return a line each on movers and on upload against the baseline."""
    counts = [drive["segmentation"] for drive in found["drives"].values() if drive.get("segmentation")]
    lines = [kept_line(found["kept"])]
    false = ", ".join(f"{count:.2f} {name}" for name, count in found["false_per_1000"].items())
    lines.append(f"False changes of 1,000 observable voxels: {false}; {_where(found)}.")
    total = {name: sum(count[name] for count in counts) for name in (counts[0] if counts else ())}
    if total and total["movers"]:
        left, lost = 100 * total["movers_left"] / total["movers"], 100 * total["static_lost"] / total["static"]
        lines.append(
            f"Movers: {left:.2f} % of their points are left as static; {lost:.3f} % of static points are lost."
        )
    if "pcd" in found:
        ours, theirs = found["upload_bytes"]["single"], found["pcd"]["upload_bytes"]["single"]
        share = 100 * sum(ours.values()) / sum(one[PCD_CODEC] for one in theirs.values())
        lines.append(f"Upload of one drive: {share:.2f} % of the point-cloud baseline's (at most 4 %).")
    return lines


def _f1(stage: Found) -> list[str]:
    """F1 at the levels, and over the three classes of change among observable voxels."""
    return [*(fixed(stage["f1"][level]) for level in LEVELS), fixed(stage["changes_f1"]["observable"])]


def _kb(size: float) -> str:
    return f"{size / 1000:,.1f}"
