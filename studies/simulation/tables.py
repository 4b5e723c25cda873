"""A reproduction as tables for people, the paper's figures and our targets beside ours."""

from collections.abc import Mapping
from typing import Any, Final

from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from gnd.fleet_sim.truth import LEVELS
from studies.simulation import reference
from studies.simulation.comparison import rows_of
from studies.simulation.targets import target_single

PCD_CODEC: Final = "points"
"""The baseline's upload as the paper counts it: every new and every deleted point with its coordinates."""
_PLAIN_WIDTH: Final = 120


def tables_of(found: Mapping[str, Any], asked: "list[int]") -> Group:
    """Return the scores, the classes of the largest fleet, and its confusion matrix."""
    largest = str(max(asked))
    return Group(
        _scores(found, asked),
        Text(),
        _classes("merged map", largest, found["fleet"][largest]["classes"]["scored"]),
        Text(),
        _confusion(found, largest),
        Text(),
        notes_of(found),
    )


def print_tables(tables: Group) -> None:
    """Print tables on standard output."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=_PLAIN_WIDTH)
    console.print(tables)


def comparison_tables(compared: Mapping[str, Any], asked: "list[int]") -> Group:
    """Return the scores of runs with poses of several sources beside each other, what each loses, and its poses."""
    parts: list[Table | Text] = []
    for name in compared["loss"]:
        parts += [_losses(compared, name, asked), Text(), _poses(compared["poses"][name], name), Text()]
        worst = compared["worst"][name]
        verdict = "met" if worst["met"] else "missed"
        line = f"Poses {name}: at most {worst['loss']:.2f} points lost ({worst['row']}), {worst['must']:g} allowed"
        parts += [Text(f"{line}: {verdict}.", style="bold"), Text()]
    return Group(*parts[:-1])


def _losses(compared: Mapping[str, Any], name: str, asked: "list[int]") -> Table:
    against = compared["against"]
    exact, other = rows_of(compared["poses"][against]), rows_of(compared["poses"][name])
    seeds = ", ".join(map(str, compared["poses"][name]["seeds"]))
    columns = [f"{level} {what}" for level in ("scored", "all") for what in (against, name, "loss")]
    table = _table(f"Macro F1 in percent, world seed {seeds}: poses {against} and {name}", "", *columns)
    for row, loss in compared["loss"][name].items():
        kind, _, number = row.partition(".")
        if kind == "fleet" and int(number) not in asked:
            continue
        values = [(exact[row][level], other[row][level], loss[level]) for level in ("scored", "all")]
        table.add_row(_row_name(row), *(f"{value:.2f}" for three in values for value in three))
    return table


def _row_name(row: str) -> str:
    kind, _, which = row.partition(".")
    if kind == "fleet":
        return f"{which} vehicle{'s' * (which != '1')}"
    return f"one drive, {which or '16/32 layers'}"


def _poses(found: Mapping[str, Any], name: str) -> Table:
    """What the localisation of each sensor's drives came to."""
    errors = ("longitudinal_p95_m", "lateral_p95_m", "heading_p95_deg")
    table = _table(f"Poses {name}, mean over the drives of a sensor", "", "scans", "used", *errors)
    for sensor, drive in found["drives"].items():
        poses = drive.get("poses", {})
        values = [f"{poses[key]:.4f}" if key in poses else "" for key in errors]
        table.add_row(sensor, f"{drive['scans']:.0f}", f"{drive['scans_used']:.0f}", *values)
    return table


def _scores(found: Mapping[str, Any], asked: "list[int]") -> Table:
    seeds = ", ".join(map(str, found["seeds"]))
    title = (
        f"Macro F1 in percent, world seed {seeds}: {found['parameters']['mode']}, poses {found['parameters']['poses']}"
    )
    table = _table(title, "", *LEVELS, "paper", "must", "aim", "upload kB")
    table.add_row("stale map", *_f1(found["stale"]), f"{reference.STALE}", "", "", "")
    for sensor, stage in found["single"].items():
        table.add_row(f"one drive, {sensor}", *_f1(stage), "", "", "", _kb(found["upload_bytes"]["single"][sensor]))
    target = target_single(found)
    if target:
        must, aim = reference.MUST["single"], reference.AIM["single"]
        values = [f"{target[level]:.2f}" for level in LEVELS]
        table.add_row("one drive, 16/32 layers", *values, f"{reference.SINGLE}", f"{must}", f"{aim}", "", style="bold")
    for n in asked:
        stage, name = found["fleet"][str(n)], f"fleet.{n}"
        paper = {**reference.FLEET, **reference.FLEET_READ_OFF}.get(n, "")
        row = [str(paper), str(reference.MUST.get(name, "")), str(reference.AIM.get(name, ""))]
        size = _kb(found["upload_bytes"]["fleet"][str(n)])
        style = "bold" if name in reference.MUST else ""
        table.add_row(f"{n} vehicle{'s' * (n > 1)}", *_f1(stage), *row, size, style=style)
    for n in asked:
        if "pcd" in found:
            size = _kb(found["pcd"]["upload_bytes"]["fleet"][str(n)][PCD_CODEC])
            table.add_row(f"point clouds, {n}", *_f1(found["pcd"]["fleet"][str(n)]), "", "", "", size, style="dim")
    return table


def notes_of(found: Mapping[str, Any]) -> Text:
    """Return a line each on movers and on upload against the baseline."""
    counts = [drive["segmentation"] for drive in found["drives"].values() if drive.get("segmentation")]
    lines = []
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
    return Text("\n".join(lines))


def _classes(title: str, n: str, classes: Mapping[str, Mapping[str, float]]) -> Table:
    table = _table(f"Classes of the {title}, {n} vehicles, scored voxels", "", "precision", "recall", "F1")
    for name, score in classes.items():
        table.add_row(name, *(f"{score[key]:.2f}" for key in ("precision", "recall", "f1")))
    return table


def _confusion(found: Mapping[str, Any], n: str) -> Table:
    names = found["confusion"]["classes"]
    table = _table(f"Confusion, {n} vehicles, scored voxels (rows: truth)", "", *names)
    for name, row in zip(names, found["confusion"]["fleet"][n]["scored"], strict=True):
        table.add_row(name, *(f"{value:,}" for value in row))
    return table


def _table(title: str, *columns: str) -> Table:
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for column in columns:
        table.add_column(column.replace("_", " "), justify="right" if column else "left")
    return table


def _f1(stage: Mapping[str, Any]) -> list[str]:
    return [f"{stage['f1'][level]:.2f}" for level in LEVELS]


def _kb(size: float) -> str:
    return f"{size / 1000:,.1f}"
