"""A study of SLAMCU as tables, for the terminal; the paper's numbers beside."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from rich.table import Table

from studies.feature_study.targets import plain_table, targets_table
from studies.slamcu_study import reference
from studies.slamcu_study.options import VARIANTS

Found = Mapping[str, Any]
MOST_NAMED: Final = 8


def tables_of(found: Found) -> list[Table]:
    """Return all tables."""
    return [_confusion(found), _positions(found), _ablation(found), _facts(found), _targets(found)]


def _confusion(found: Found) -> Table:
    """Table 1 in the paper's layout, the paper's numbers in brackets."""
    title = f"Table 1, mean of {_seeds(found)}; in brackets the paper's"
    columns = (*(name.capitalize() for name in reference.PREDICTED), "Accuracy", "Of those ever in free view")
    table = plain_table(title, "true \\ predicted", *columns)
    ours = found["slamcu"]
    for i, name in enumerate(reference.TRUE_CLASSES):
        pairs = zip(ours["confusion"][i], reference.PAPER_CONFUSION[i], strict=True)
        cells = [f"{number:.4g} ({paper})" for number, paper in pairs]
        table.add_row(name.capitalize(), *cells, _accuracy(ours, name), percent(ours["accuracy_visible"][name]))
    everything = (_accuracy(ours, "overall"), percent(ours["accuracy_visible"]["overall"]))
    table.add_row("all", *[""] * len(reference.PREDICTED), *everything)
    return table


def _accuracy(ours: Found, name: str) -> str:
    return f"{percent(ours['accuracy'][name])} ({reference.PAPER_ACCURACY[name]:g} %)"


def _positions(found: Found) -> Table:
    """Figure 9 as numbers."""
    radius = f"pairs within {found['matching_radius_m']:g} m"
    table = plain_table(
        f"position error of new signs, m; {radius}", "", "mean", "± std", "p95", "found", "missed", "false"
    )
    paper = reference.PAPER_POSITION_M
    table.add_row("paper, one drive", f"{paper['mean']:g}", f"{paper['std']:g}", "", "36", "3", "", style="dim")
    ours = found["slamcu"]
    table.add_row("one drive", *_errors(ours["position_error_m"]))
    for vehicles in merged_counts(found):
        table.add_row(f"{vehicles} vehicles, merged", *_errors(ours[f"position_error_{vehicles}_m"]))
    return table


def _errors(row: Found) -> Sequence[str]:
    return [metres(row[name]) for name in ("mean", "std", "p95")] + [
        f"{row[name]:.4g}" for name in ("found", "missed", "false")
    ]


def _ablation(found: Found) -> Table:
    title = "what matters: the first drive once more"
    columns = ("normal %", "deleted %", "new %", "overall %", "new signs, m", "of the pose", "missed", "false")
    table = plain_table(title, "", *columns, "pose along / across, m")
    for name, row in found["slamcu"]["ablation"].items():
        errors, pose = row["position_error_m"], row["pose_rmse"]
        table.add_row(
            VARIANTS[name],
            *(percent(row["accuracy"][one], "") for one in (*reference.TRUE_CLASSES, "overall")),
            metres(errors["mean"]),
            metres(errors["pose_part"]),
            f"{errors['missed']:.4g}",
            f"{errors['false']:.4g}",
            f"{pose['longitudinal_m']:.2f} / {pose['lateral_m']:.2f}",
        )
    return table


def _facts(found: Found) -> Table:
    ours, table = found["slamcu"], plain_table("beside", "", "")
    worst = found["worst"]
    table.add_row("worst first drive", f"{percent(worst['accuracy'])} (seed {worst['seed']})")
    table.add_row("drives that found they had been lost", f"{found['lost']} of {found['drives']}")
    table.add_row("drives lost without knowing", f"{found['lost_without_knowing']} of {found['drives']}")
    table.add_row("verdicts taken back a drive", f"{ours['lost']['taken_back']:.2f}")
    table.add_row("NEES of the place (2 expected)", f"{ours['pose_nees']:.2f}")
    looks, conflict, nees = ours["looks"], ours["conflict"], ours["position_error_m"].get("nees")
    table.add_row("one step: median / 95 %", f"{ours['step_ms_median']:.2f} / {ours['step_ms_p95']:.2f} ms")
    table.add_row("looks at signs: visible / hidden", f"{looks['visible']:.0f} / {looks['occluded']:.0f}")
    table.add_row("looks at signs of the map that gave no evidence", f"{looks['no_evidence']:.0f}")
    table.add_row(
        "signs never visible / new ones of them",
        f"{looks['signs_never_visible']:.4g} / {looks['new_signs_never_visible']:.4g}",
    )
    if conflict:
        table.add_row(
            "conflict: mean / 95 % / largest", " / ".join(f"{conflict[k]:.3f}" for k in ("mean", "p95", "max"))
        )
    if nees:
        table.add_row(
            "NEES of new signs (2 expected) / within their 95 %",
            f"{nees['mean']:.2f} / {100 * nees['within_95']:.0f} %",
        )
    return table


def _targets(found: Found) -> Table:
    return targets_table(found["targets"], f"targets, mean of {_seeds(found)}")


def merged_counts(found: Found) -> list[int]:
    """Return the numbers of vehicles whose reports were merged."""
    names = [name.split("_") for name in found["slamcu"] if name.startswith("position_error_")]
    return sorted(int(parts[2]) for parts in names if parts[2] != "m")


def percent(value: float | None, unit: str = " %") -> str:
    """Return a share for a table; a dash for none."""
    return "–" if value is None else f"{value:.2f}{unit}"


def metres(value: float | None) -> str:
    """Return metres for a table; a dash for none."""
    return "–" if value is None else f"{value:.3f}"


def _seeds(found: Found) -> str:
    seeds = list(found["seeds"])
    if len(seeds) > MOST_NAMED:
        return f"{len(seeds)} seeds, {seeds[0]} … {seeds[-1]}"
    return f"seed {seeds[0]}" if len(seeds) == 1 else f"seeds {', '.join(seeds)}"
