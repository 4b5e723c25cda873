"""How the pictures of the studies look."""

from pathlib import Path
from typing import Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gnd.fleet_sim.pictures import save_figure

INK: Final = "#1c2430"
PALE: Final = "#5a6675"
GREEN: Final = "#2e8b57"
BLUE: Final = "#2f6fb5"
MAGENTA: Final = "#c2378f"
ORANGE: Final = "#e08a1e"
RED: Final = "#d1433f"
GREY: Final = "#8a94a3"
"""Green without HD map, blue with it, magenta for the integration, orange for lanes: as in the papers."""


def new_figure(wide_in: float, tall_in: float) -> Figure:
    """Return an empty figure."""
    return Figure(figsize=(wide_in, tall_in), dpi=130, facecolor="white", layout="constrained")


def dress(axes: Axes, x: str, y: str, title: str = "") -> None:
    """Name the axes, draw a faint grid, leave out the frame."""
    axes.set_xlabel(x, color=INK)
    axes.set_ylabel(y, color=INK)
    if title:
        axes.set_title(title, loc="left", color=INK, fontsize=11, weight="bold")
    axes.grid(visible=True, color="#e6eaf0", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(colors=INK, labelsize=9)
    spines(axes)


def spines(axes: Axes, *shown: str) -> None:
    """Leave of the frame only some sides, by default the left and the lower one."""
    for name, spine in axes.spines.items():
        spine.set(visible=name in (shown or ("left", "bottom")), color="#c3ccd8")


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
    figure.suptitle(f"{title}\n", x=0.012, ha="left", fontsize=14, weight="bold", color=INK)
    top = 1.0 - 0.42 / figure.get_figheight()
    figure.text(0.0125, top, note, fontsize=9, color=PALE, va="center")
    return save(figure, path)
