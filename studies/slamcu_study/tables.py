"""A study of SLAMCU as tables; the paper's numbers beside."""

from collections.abc import Mapping
from typing import Any, Final

from studies.frame.tables import Sheet, fixed, seeds_named, sheet, sheet_of, shown
from studies.frame.targets import targets_sheet
from studies.slamcu_study.signs import (
    PAPER_ACCURACY,
    PAPER_CONFUSION,
    PAPER_POSITION_M,
    PREDICTED,
    TRUE_CLASSES,
    VARIANTS,
)

Found = Mapping[str, Any]
_ERRORS: Final = {
    "mean": "{mean:.3f}", "± std": "{std:.3f}", "p95": "{p95:.3f}", "found": "{found:.4g}", "missed": "{missed:.4g}",
    "false": "{false:.4g}",
}  # fmt: skip
_ABLATION: Final = {
    **{f"{name} %": f"{{accuracy.{name}:.2f}}" for name in (*TRUE_CLASSES, "overall")},
    "new signs, m": "{position_error_m.mean:.3f}",
    "of the pose": "{position_error_m.pose_part:.3f}",
    "missed": "{position_error_m.missed:.4g}",
    "false": "{position_error_m.false:.4g}",
    "pose along / across, m": "{pose_rmse.longitudinal_m:.2f} / {pose_rmse.lateral_m:.2f}",
}
_FACTS: Final = {
    "verdicts taken back a drive": "{lost.taken_back:.2f}",
    "NEES of the place (2 expected)": "{pose_nees:.2f}",
    "one step: median / 95 %": "{step_ms_median:.2f} / {step_ms_p95:.2f} ms",
    "looks at signs: visible / hidden": "{looks.visible:.0f} / {looks.occluded:.0f}",
    "looks at signs of the map that gave no evidence": "{looks.no_evidence:.0f}",
    "signs never visible / new ones of them": "{looks.signs_never_visible:.4g} / {looks.new_signs_never_visible:.4g}",
    "conflict: mean / 95 % / largest": "{conflict.mean:.3f} / {conflict.p95:.3f} / {conflict.max:.3f}",
    "NEES of new signs (2 expected) / within their 95 %": (
        "{position_error_m.nees.mean:.2f} / {position_error_m.nees.within_95:.0%}"
    ),
}


def tables_of(found: Found) -> list[Sheet]:
    """Return all tables."""
    ours, seeds = found["slamcu"], seeds_named(list(found["seeds"]))
    rows = {VARIANTS[name]: row for name, row in ours["ablation"].items()}
    ablation = sheet_of("what matters: the first drive once more", _ABLATION, rows)
    targets = targets_sheet(found["targets"], f"targets, mean of {seeds}")
    return [_confusion(ours, seeds), _positions(found, ours), ablation, _facts(found, ours), targets]


def _confusion(ours: Found, seeds: str) -> Sheet:
    """Table 1 in the paper's layout, the paper's numbers in brackets."""
    heads = (*(name.capitalize() for name in PREDICTED), "Accuracy", "Of those ever in free view")
    table = sheet(f"Table 1, mean of {seeds}; in brackets the paper's", "true \\ predicted", *heads)
    for i, name in enumerate((*TRUE_CLASSES, "overall")):
        pairs = zip(ours["confusion"][i], PAPER_CONFUSION[i], strict=True) if name in TRUE_CLASSES else ()
        cells = [f"{number:.4g} ({paper})" for number, paper in pairs] or [""] * len(PREDICTED)
        accuracy = f"{fixed(ours['accuracy'][name])} % ({PAPER_ACCURACY[name]:g} %)"
        table.add(name.capitalize(), *cells, accuracy, fixed(ours["accuracy_visible"][name], 2, " %"))
    return table


def _positions(found: Found, ours: Found) -> Sheet:
    """Figure 9 as numbers."""
    counts = sorted(int(name.split("_")[1]) for name in ours if name.startswith("accuracy_") and name[9:].isdecimal())
    rows = {f"{n} vehicles, merged": ours[f"position_error_{n}_m"] for n in counts}
    title = f"position error of new signs, m; pairs within {found['matching_radius_m']:g} m"
    table = sheet_of(title, _ERRORS, {"one drive": ours["position_error_m"]} | rows)
    table.add("paper, one drive", PAPER_POSITION_M["mean"], PAPER_POSITION_M["std"], "", 36, 3, style="dim")
    return table


def _facts(found: Found, ours: Found) -> Sheet:
    table = sheet("beside", "", "")
    table.add("worst first drive", shown("{worst.accuracy:.2f} % (seed {worst.seed})", found))
    table.add("drives that found they had been lost", shown("{lost} of {drives}", found))
    table.add("drives lost without knowing", shown("{lost_without_knowing} of {drives}", found))
    for name, cell in _FACTS.items():
        if not (name.startswith("conflict") and not ours["conflict"]):
            table.add(name, shown(cell, ours))
    return table
