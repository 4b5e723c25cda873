"""How the pictures of a localised drive look."""

from pathlib import Path
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gnd.picture_style import (
    BLUE,
    DPI,
    FAINT,
    GREEN,
    GRID,
    INK,
    LABEL_PT,
    MUTED,
    NOTE_PT,
    ORANGE,
    PAPER,
    RED,
    SMALL_PT,
    TITLE_PT,
    write_png,
)
from gnd.vehicle_agent.errors import LocaliseError
from gnd.vehicle_agent.localise_drive.stretches import HealthStretch

HEALTH_COLOURS: Final = {"good": GREEN, "degraded": ORANGE, "lost": RED}
REFINED: Final = RED
ONLINE: Final = BLUE
_WORDS: Final = 0.05
"""Shortest stretch, of the whole drive, that is named."""
_STRIP: Final = 0.035
"""Height of the strip of health, of the axes' height."""


def new_figure(width_in: float, height_in: float, title: str, note: str) -> Figure:
    """A figure with a heading and a small line below it, 0.9 inches in all."""
    figure = Figure(figsize=(width_in, height_in), dpi=DPI, facecolor=PAPER)
    left = 0.4 / width_in
    figure.text(left, 1.0 - 0.36 / height_in, title, fontsize=TITLE_PT, weight="bold", color=INK, va="center")
    figure.text(left, 1.0 - 0.65 / height_in, note, fontsize=NOTE_PT, color=MUTED, va="center")
    return figure


def dress(axes: Axes, label: str) -> None:
    """Grid, colours, the label of the y axis."""
    axes.set_ylabel(label, color=INK, fontsize=LABEL_PT)
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=INK, labelsize=SMALL_PT)
    for name, spine in axes.spines.items():
        spine.set(visible=name in ("left", "bottom"), color=FAINT)


def health_strip(axes: Axes, stretches: list[HealthStretch], *, shade: bool = True) -> None:
    """Colour the foot of the axes by health over time; with `shade`, the whole height faintly where it is not good."""
    for one in stretches:
        colour = HEALTH_COLOURS[one.health]
        span: dict[str, Any] = {"color": colour, "linewidth": 0}
        axes.axvspan(one.from_s, one.to_s, ymin=0.0, ymax=_STRIP, alpha=0.9, zorder=4, **span)
        if shade and one.health != "good":
            axes.axvspan(one.from_s, one.to_s, alpha=0.10, zorder=0, **span)


def name_causes(axes: Axes, stretches: list[HealthStretch]) -> None:
    """Write the causes of health at the head of the axes, where a stretch is long enough for the words."""
    whole_s = stretches[-1].to_s if stretches else 0.0
    for one in stretches:
        if one.cause != "none" and one.to_s - one.from_s > _WORDS * whole_s:
            axes.axvline(one.from_s, color=FAINT, linewidth=1.0, zorder=1)
            axes.axvline(one.to_s, color=FAINT, linewidth=1.0, zorder=1)
            axes.text(
                (one.from_s + one.to_s) / 2, 1.015, one.cause.replace("_", " "), transform=axes.get_xaxis_transform(),
                ha="center", va="bottom", fontsize=8, color=MUTED,
            )  # fmt: skip


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG; the file appears complete or not at all.

    Raises:
        LocaliseError: it cannot be written.
    """
    try:
        write_png(figure, path)
    except OSError as error:
        raise LocaliseError(f"{path}: cannot write the picture: {error.strerror or error}") from None
