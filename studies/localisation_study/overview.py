"""All rows of a study in one picture: 95 % and largest errors against the limits, on a logarithmic axis."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from gnd.fleet_sim.pictures import save_figure
from studies.localisation_study.reference import FORD_LOCAL, PAPER, PAPER_LIMITS, PAPER_OF_ROW, QUANTITIES
from studies.localisation_study.summary import ROWS
from studies.localisation_study.tables import ROW_LABELS
from studies.localisation_study.targets import sensors_of
from studies.localisation_study.variants import LABELS

_INK: Final = "#1c2430"
_PALE: Final = "#5a6675"
_COLOURS: Final = ("#d1282e", "#2f6fb5", "#2e8b57", "#e0a020", "#8455a8", "#76808e")
_P95, _MAX, _FORD = "#2e8b57", "#c9a100", "#9aa4b2"
_TITLES: Final = ("longitudinal, m", "lateral, m", "heading, °")
_LEAST: Final = (1e-3, 1e-3, 2e-3)
"""Left end of each axis; what is smaller is drawn there."""


def draw_overview(found: Mapping[str, Any], path: Path) -> Path:
    """Draw every row of every sensor.

    Args:
        found: the result.
        path: PNG to write.

    Raises:
        SimError: it cannot be written.
    """
    sensors = sensors_of(found)
    rows = list(_rows(found, sensors))
    tall_in = 1.9 + 0.27 * len(rows) * (1 + 0.28 * len(sensors))
    figure = Figure(figsize=(13.0, tall_in), dpi=130, facecolor="white")
    panels = figure.subplots(1, 3, sharey=True)
    figure.subplots_adjust(left=0.165, right=0.985, top=1 - 1.25 / tall_in, bottom=0.5 / tall_in, wspace=0.06)
    for quantity, axes in enumerate(panels):
        _dress(axes, quantity, len(rows))
        for y, (name, _) in enumerate(rows):
            for index, sensor in enumerate(sensors):
                row = _row_of(found[sensor], name)
                shift = (index - (len(sensors) - 1) / 2) * 0.24
                if row is not None:
                    _draw_row(axes, y + shift, row[QUANTITIES[quantity]], quantity, _COLOURS[index % len(_COLOURS)])
            _draw_paper(axes, y, name, quantity)
    panels[0].set_yticks(range(len(rows)), [label for _, label in rows])
    seeds = ", ".join(found["seeds"])
    figure.text(0.02, 1 - 0.32 / tall_in, "Localisation in a changed world", fontsize=16, weight="bold", color=_INK)
    note = f"world seed {seeds}" + (", the worst of each" if len(found["seeds"]) > 1 else "")
    figure.text(0.02, 1 - 0.58 / tall_in, note, fontsize=10, color=_PALE)
    _legend(figure, sensors, tall_in)
    save_figure(figure, path)
    return path


def _rows(found: Mapping[str, Any], sensors: list[str]) -> "list[tuple[str, str]]":
    """Name and label of every row that some sensor has."""
    variants = dict.fromkeys(name for sensor in sensors for name in found[sensor].get("variants", {}))
    return [(name, ROW_LABELS[name]) for name in ROWS] + [(name, LABELS[name]) for name in variants]


def _row_of(rows: Mapping[str, Any], name: str) -> Mapping[str, Any] | None:
    row: Mapping[str, Any] | None = rows.get(name) or rows.get("variants", {}).get(name)
    return row if row is not None and row[QUANTITIES[0]] is not None else None


def _draw_row(axes: Axes, y: float, error: Mapping[str, float], quantity: int, colour: str) -> None:
    """A filled dot at the 95 %, a ring at the largest error."""
    p95, largest = (max(error[name], _LEAST[quantity]) for name in ("p95", "max"))
    axes.plot([p95, largest], [y, y], color=colour, linewidth=1.2, alpha=0.6, zorder=2)
    axes.plot(p95, y, "o", color=colour, markersize=5, zorder=3)
    axes.plot(largest, y, "o", color=colour, markerfacecolor="white", markersize=4.5, zorder=3)


def _draw_paper(axes: Axes, y: float, name: str, quantity: int) -> None:
    """Crosses at the 95 % of the paper's simulation, or of its drives where it has no simulation."""
    for paper in PAPER_OF_ROW.get(name, ())[:1]:
        axes.plot(PAPER[paper].p95[quantity], y, "x", color=_INK, markersize=6, zorder=4)


def _dress(axes: Axes, quantity: int, rows: int) -> None:
    axes.set_xscale("log")
    axes.set_xlim(_LEAST[quantity], 3.0)
    axes.set_ylim(rows - 0.5, -0.5)
    axes.axvline(PAPER_LIMITS.p95[quantity], color=_P95, linewidth=1.4)
    axes.axvline(PAPER_LIMITS.max[quantity], color=_MAX, linewidth=1.4)
    if quantity < 2:
        for value in (FORD_LOCAL.p95[quantity], FORD_LOCAL.max[quantity]):
            axes.axvline(value, color=_FORD, linewidth=1.0, linestyle="--")
    for y in range(1, rows, 2):
        axes.axhspan(y - 0.5, y + 0.5, color="#f3f5f8", linewidth=0, zorder=0)
    axes.set_title(_TITLES[quantity], fontsize=11, color=_INK, loc="left", weight="bold")
    axes.grid(axis="x", color="#e3e7ed", linewidth=0.8, zorder=0)
    axes.tick_params(colors=_INK, labelsize=9, left=False)
    for name, spine in axes.spines.items():
        spine.set(visible=name == "bottom", color="#c3ccd8")


def _legend(figure: Figure, sensors: list[str], tall_in: float) -> None:
    handles = [
        Line2D([], [], color=_COLOURS[i % len(_COLOURS)], marker="o", markersize=5, linewidth=1.2, label=sensor)
        for i, sensor in enumerate(sensors)
    ]
    marks = (("o", _PALE, "95 %"), ("o", "white", "largest"), ("x", _INK, "paper, 95 %"))
    for marker, fill, label in marks:
        edge = _PALE if marker == "o" else _INK
        handles.append(Line2D([], [], marker=marker, color=edge, markerfacecolor=fill, linewidth=0, label=label))
    handles.append(Line2D([], [], color=_P95, label="95 % limit"))
    handles.append(Line2D([], [], color=_MAX, label="largest allowed"))
    handles.append(Line2D([], [], color=_FORD, linestyle="--", label="Ford, local street"))
    figure.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(0.015, 1 - 0.62 / tall_in),
        ncols=len(handles),
        frameon=False,
        fontsize=9,
    )
