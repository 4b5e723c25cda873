"""How the pictures of the studies look."""

from pathlib import Path
from typing import Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gnd.fleet_sim.pictures import save_figure
from gnd.picture_style import (
    DPI,
    FAINT,
    GRID,
    INK,
    LABEL_PT,
    MUTED,
    NOTE_PT,
    PANEL_PT,
    PAPER,
    SMALL_PT,
    TITLE_PT,
)

PALE: Final = MUTED
"""Of the colours, green is without HD map, blue with it, magenta the integration, orange lanes: as in the papers."""


def new_figure(wide_in: float, tall_in: float) -> Figure:
    """Return an empty figure."""
    return Figure(figsize=(wide_in, tall_in), dpi=DPI, facecolor=PAPER, layout="constrained")


def dress(axes: Axes, x: str, y: str, title: str = "") -> None:
    """Name the axes, draw a faint grid, leave out the frame."""
    axes.set_xlabel(x, color=INK, fontsize=LABEL_PT)
    axes.set_ylabel(y, color=INK, fontsize=LABEL_PT)
    if title:
        axes.set_title(title, loc="left", color=INK, fontsize=PANEL_PT, weight="bold")
    axes.grid(visible=True, color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=INK, labelsize=SMALL_PT)
    spines(axes)


def spines(axes: Axes, *shown: str) -> None:
    """Leave of the frame only some sides, by default the left and the lower one."""
    for name, spine in axes.spines.items():
        spine.set(visible=name in (shown or ("left", "bottom")), color=FAINT)


def save(figure: Figure, path: Path) -> Path:
    """Write a figure into a folder that is made if need be, and return its path.

    Raises:
        SimError: it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    save_figure(figure, path)
    return path


def finish(figure: Figure, title: str, note: str, path: Path) -> Path:
    """Write a figure with its headline and return its path.

    Raises:
        SimError: it cannot be written.
    """
    figure.suptitle(f"{title}\n", x=0.012, ha="left", fontsize=TITLE_PT, weight="bold", color=INK)
    top = 1.0 - 0.42 / figure.get_figheight()
    figure.text(0.0125, top, note, fontsize=NOTE_PT, color=PALE, va="center")
    return save(figure, path)
