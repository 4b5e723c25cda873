"""The figures of a report: the map against the truth, localisation, health."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from gnd.deploy.html_page import picture, text_table
from gnd.deploy.report.finished_run import FinishedRun
from gnd.deploy.report.pictures import errors_picture
from gnd.fleet_sim.evaluate import CLASSES, Evaluation, Score, evaluate_maps
from gnd.fleet_sim.truth import LEVELS
from gnd.gnd_map.arrays import F64

HEALTHS: Final = ("good", "degraded", "lost")
_NS_PER_S: Final = 1e9
_MEANT: Final = {
    "observable": "voxels near the road that could be seen after the changes; this level leads",
    "all": "every voxel that a ray touched",
    "scored": "observable voxels whose class no hair decides",
}


def against_truth(run: FinishedRun) -> str:
    """F1 by level and stage, and the confusion of the leading level; says so where there is no truth."""
    told = run.summary.get("f1")
    levels = told.get("levels") if isinstance(told, dict) else None
    stages = levels if isinstance(levels, dict) else {}
    after = None
    if run.truth is not None:
        base, final = ({one.tile.tile: getattr(one, state) for one in run.tiles} for state in ("before", "after"))
        before, after = evaluate_maps(run.truth, base, base), evaluate_maps(run.truth, base, final)
        own = {level: {"before": before.f1(level), "after": after.f1(level)} for level in LEVELS}
        stages = {level: _stage_values(stages.get(level)) | own[level] for level in LEVELS}
    if not stages:
        return '<p class="note">There is no truth: real drives, or a run that did not end. So there is no F1.</p>'
    rows = [(level, *_stages(stages.get(level)), _MEANT[level]) for level in LEVELS]
    table = text_table(("voxels", "before", "one vehicle alone", "after", "which"), rows)
    text = (
        "<p>Macro F1 in percent: the mean over the classes normal, new, modified, deleted and empty. "
        "<b>Observable</b> voxels lead. One vehicle alone: the mean over vehicles that drove on the map before.</p>"
    )
    return text + table + _confusion(after)


def _stages(stages: Any) -> tuple[str, ...]:
    found = _stage_values(stages)
    return tuple(_percent(found.get(name)) for name in ("before", "single", "after"))


def _stage_values(stages: Any) -> dict[str, Any]:
    return dict(stages) if isinstance(stages, dict) else {}


def _percent(value: Any) -> str:
    return f"{value:.1f} %" if isinstance(value, int | float) else "–"


def _confusion(after: Evaluation | None) -> str:
    if after is None:
        return '<p class="note">The truth is not at hand, so there is no confusion matrix.</p>'
    score = after.scores["observable"]
    text = "<p>Observable voxels of the map after the run: rows are what is true, columns what the map says.</p>"
    return text + _matrix(score) + _of_classes(score)


def _matrix(score: Score) -> str:
    names = [one.name.lower() for one in CLASSES]
    rows = [
        (f"true {name}", *(f"{count:,}" for count in row))
        for name, row in zip(names, score.confusion.tolist(), strict=True)
    ]
    return text_table(("", *names), rows)


def _of_classes(score: Score) -> str:
    rows = [
        (name, f"{one.precision:.1f} %", f"{one.recall:.1f} %", f"{one.f1:.1f} %")
        for name, one in score.classes.items()
    ]
    return text_table(("class", "precision", "recall", "F1"), rows)


def localisation(run: FinishedRun) -> str:
    """Errors against the reference of the recordings, a row a vehicle, and over time."""
    known = [(one["vehicle"], found) for one in run.results if (found := _errors_of(one)) is not None]
    if not run.results:
        return '<p class="note">No vehicle left a result.</p>'
    if not known:
        return '<p class="note">The recordings hold no reference poses: errors of localisation are not known.</p>'
    rows = [(name, str(len(along)), *_quantiles(along, across, turn)) for name, (_, along, across, turn) in known]
    every = [np.concatenate(column) for column in zip(*(found[1:] for _, found in known), strict=True)]
    if len(known) > 1:
        rows.append(("all", str(len(every[0])), *_quantiles(*every)))
    header = ("vehicle", "scans", "along, 95 %", "largest", "across, 95 %", "largest", "heading, 95 %", "largest")
    curves = errors_picture([found[:3] for _, found in known])
    return text_table(header, rows) + picture(curves, "Errors of all vehicles along their drives")


def _errors_of(result: dict[str, Any]) -> tuple[F64, F64, F64, F64] | None:
    """Time of the drive (s), errors along (m), across (m) and of heading (deg); None where they are not known."""
    told = result.get("localisation")
    if not isinstance(told, dict):
        return None
    names = ("t_ns", "longitudinal_m", "lateral_m", "heading_deg")
    try:
        t_ns, along, across, turn = (np.asarray(told[name], dtype=np.float64) for name in names)
    except (KeyError, TypeError, ValueError):
        return None
    if not len(t_ns) or not t_ns.shape == along.shape == across.shape == turn.shape:
        return None
    return (t_ns - t_ns[0]) / _NS_PER_S, along, across, turn


def _quantiles(along_m: F64, across_m: F64, turn_deg: F64) -> tuple[str, ...]:
    cells: list[str] = []
    for error_m in (along_m, across_m):
        cells += [f"{100 * np.quantile(np.abs(error_m), 0.95):.1f} cm", f"{100 * np.abs(error_m).max():.1f} cm"]
    return (*cells, f"{np.quantile(np.abs(turn_deg), 0.95):.3f}°", f"{np.abs(turn_deg).max():.3f}°")


def health(run: FinishedRun) -> str:
    """How well vehicles knew where they were, and what they made of it."""
    if not run.results:
        return '<p class="note">No vehicle left a result.</p>'
    rows = [_health_row(one) for one in run.results]
    header = ("vehicle", "sensor", "way", "ended", *HEALTHS, "scans left out", "tiles doubted", "last error")
    return text_table(header, rows, left=2)


def _health_row(result: dict[str, Any]) -> tuple[str, ...]:
    shares, doubts = health_shares(result), result.get("doubts")
    finished = result.get("finished")
    bad = result.get("scans_bad")
    return (
        str(result["vehicle"]),
        str(result.get("sensor_model", "")),
        f"{1000 * _number(result.get('distance_km')):.0f} m",
        "–" if finished is None else "yes" if finished else "no",
        *("–" if shares is None else f"{100 * shares[name]:.1f} %" for name in HEALTHS),
        str(sum(int(_number(one)) for one in bad.values()) if isinstance(bad, dict) else 0),
        str(
            int(_number(result.get("tiles_doubtful", doubts.get("tiles_doubtful") if isinstance(doubts, dict) else 0)))
        ),
        str(result.get("last_error") or "none"),
    )


def health_shares(result: dict[str, Any]) -> dict[str, float] | None:
    """Share of the drive, up to its last refined scan, in each health; None where nothing is known of it."""
    changes, told = result.get("health"), result.get("localisation")
    if not isinstance(changes, list) or not all(isinstance(one, dict) for one in changes) or not changes:
        return None
    ends = told.get("t_ns", []) if isinstance(told, dict) else []
    times = [_number(one.get("t_ns")) for one in changes]
    times.append(max([times[-1], *(_number(one) for one in ends[-1:])]))
    spans = np.maximum(np.diff(times), 0.0)
    if not spans.sum():
        return None
    of = dict.fromkeys(HEALTHS, 0.0)
    for change, span in zip(changes, spans.tolist(), strict=True):
        name = change.get("health")
        if name in of:
            of[name] += span / float(spans.sum())
    return of


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else 0.0


def classes_in_words() -> Sequence[str]:
    """What the colours of the pictures mean."""
    return ("grey: as before", "vermilion: new", "yellow: modified", "blue: deleted")
