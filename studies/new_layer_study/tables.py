"""A study of new feature layers as tables, for the terminal; the paper's numbers beside."""

from collections.abc import Mapping
from typing import Any, Final

from rich.table import Table

from studies.feature_study.targets import plain_table, targets_table
from studies.new_layer_study import reference
from studies.new_layer_study.reference import CASES, DIRECTIONS, PAPER_TABLE2, PAPER_TABLE3

Found = Mapping[str, Any]
CASE_LABELS: Final = {"without_map": "without HD map", "with_map": "with HD map", "integration": "integration"}


def tables_of(found: Found) -> list[Table]:
    """Return all tables."""
    ours = found["nfl"]
    tables = [_single(found), _integrated(ours)]
    if ours["noise"]:
        tables.append(_noise(found))
    tables += [_motorway(ours["motorway"], "motorway"), _localisation(ours["localisation"], "motorway")]
    if "straight" in ours:
        straight, seeds = ours["straight"], ", ".join(seed for seed, one in found["seeds"].items() if "straight" in one)
        tables += [_motorway(straight["motorway"], f"straight motorway, seeds {seeds}")]
        tables += [_localisation(straight["localisation"], "straight motorway")]
    return [*tables, targets_table(found["targets"], f"targets, mean of {_seeds(found)}")]


def _single(found: Found) -> Table:
    ours, radius = found["nfl"], found["matching_radius_m"]["track"]
    title = f"Figure 6: test track, single drives, m; {ours['beacons']:.0f} beacons, pairs within {radius:g} m"
    table = plain_table(title, "", "mean ± std", "paper", "missed", "false", "NEES (2)", "within 95 %")
    for case, (mean, std) in reference.PAPER_SINGLE_M.items():
        row = ours["single"][case]
        table.add_row(CASE_LABELS[case], _pair(row["euclidean"]), f"{mean:g} ± {std:g}", *_counts(row))
    return table


def _integrated(ours: Found) -> Table:
    columns = ("drives", "mean ± std, m", "paper", "missed", "false", "NEES (2)", "within 95 %")
    table = plain_table("Figure 7: test track, drives integrated", *columns)
    for n, row in ours["integrated_more"].items():
        paper = reference.PAPER_INTEGRATED_M.get(int(n))
        table.add_row(n, _pair(row["euclidean"]), "" if paper is None else f"{paper:g}", *_counts(row))
    return table


def _noise(found: Found) -> Table:
    ours, seeds = found["nfl"], ", ".join(seed for seed, one in found["seeds"].items() if one["noise"])
    sensors = list(ours["noise"])
    columns = [f"{sensor}: {what}" for sensor in sensors for what in ("integrated, m", "one drive, m")]
    table = plain_table(f"Figure 8: noise levels, the other sensor at 1; seeds {seeds}", "level", *columns)
    for level in ours["noise"][sensors[0]]:
        rows = [ours["noise"][sensor][level] for sensor in sensors]
        table.add_row(level, *(metres(row[what]) for row in rows for what in ("integrated", "single_with_map")))
    return table


def _motorway(motorway: Found, name: str) -> Table:
    title = f"Table 2: {name}, mean ± standard deviation, m; {motorway['lights']:.0f} lights"
    table = plain_table(title, "", *(CASE_LABELS[case] for case in CASES))
    rows = motorway["table2"]
    for direction in DIRECTIONS:
        table.add_row(direction, *(_pair(rows[case][direction]) for case in CASES))
        paper = (PAPER_TABLE2[case][direction] for case in CASES)
        table.add_row("  paper", *(f"{mean:.4f} ± {std:.4f}" for mean, std in paper), style="dim")
    table.add_row("missed / false", *(f"{rows[case]['missed']:.3g} / {rows[case]['false']:.3g}" for case in CASES))
    table.add_row("NEES (2) / within 95 %", *(" / ".join(_counts(rows[case])[2:]) for case in CASES))
    return table


def _localisation(row: Found, name: str) -> Table:
    table = plain_table(f"Table 3: localisation on the {name}, RMSE, m", "", "without layer", "with layer", "paper")
    ours = {"longitudinal": (row["without"], row["with"]), "lateral": (row["lateral_without"], row["lateral_with"])}
    for direction, (without, with_layer) in ours.items():
        paper = " / ".join(f"{PAPER_TABLE3[case][direction]:.4f}" for case in ("without", "with"))
        table.add_row(direction, metres(without), metres(with_layer), paper)
    return table


def _pair(row: Found) -> str:
    return "–" if row["mean"] is None else f"{row['mean']:.3f} ± {row['std']:.3f}"


def _counts(row: Found) -> list[str]:
    """Missed and false features, NEES, share within the ellipses."""
    nees = row["nees"]
    honest = ["–", "–"] if nees is None else [f"{nees['mean']:.2f}", f"{100 * nees['within_95']:.0f} %"]
    return [f"{row['missed']:.3g}", f"{row['false']:.3g}", *honest]


def metres(value: float | None) -> str:
    """Return metres for a table; a dash for none."""
    return "–" if value is None else f"{value:.3f}"


def _seeds(found: Found) -> str:
    seeds = list(found["seeds"])
    return f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {', '.join(seeds)}"
