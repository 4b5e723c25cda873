"""How all our pictures look: colours that everybody tells apart, sizes, lines; `make pictures` draws with it.

The colours are those of Okabe and Ito (2008): people who see no red, green or blue tell them apart, too.
"""

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, ParamSpec, TypeVar

from gnd.gnd_map.classes import ChangeClass

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK: Final = "#1c2430"
MUTED: Final = "#5a6675"
FAINT: Final = "#c3ccd8"
GRID: Final = "#e3e7ed"
PAPER: Final = "#ffffff"
BLUE: Final = "#0072b2"
SKY: Final = "#56b4e9"
GREEN: Final = "#009e73"
ORANGE: Final = "#e69f00"
RED: Final = "#d55e00"
MAGENTA: Final = "#cc79a7"
YELLOW: Final = "#f0d000"
GREY: Final = "#8a94a3"
BROWN: Final = "#7a4b1e"
CYCLE: Final = (BLUE, RED, GREEN, MAGENTA, ORANGE, SKY, BROWN)
"""Colours of lines whose order says nothing."""
SAFE_COLOURS: Final[Mapping[ChangeClass, str]] = MappingProxyType(
    {
        ChangeClass.NORMAL: "#9aa4b0",
        ChangeClass.NEW: RED,
        ChangeClass.MODIFIED: YELLOW,
        ChangeClass.DELETED: BLUE,
        ChangeClass.EMPTY: "#d0d4d9",
        ChangeClass.UNMEASURED: "#eceef0",
    }
)
"""Colours of the classes of changes; what stayed is grey. The paper's own are `gnd_map.classes.CLASS_COLOURS`."""
FEATURE_COLOURS: Final[Mapping[str, str]] = MappingProxyType({"normal": GREY, "deleted": BLUE, "new": RED})
"""The same for features."""

DPI: Final = 130
TITLE_PT: Final = 16
NOTE_PT: Final = 10
PANEL_PT: Final = 11
LABEL_PT: Final = 10
SMALL_PT: Final = 9

_STYLE: Final[dict[Any, Any]] = {
    "figure.dpi": DPI, "figure.facecolor": PAPER, "savefig.dpi": "figure", "font.size": LABEL_PT, "text.color": INK,
    "axes.titlesize": PANEL_PT, "axes.titleweight": "bold", "axes.titlelocation": "left", "axes.titlecolor": INK,
    "axes.labelsize": LABEL_PT, "axes.labelcolor": INK, "axes.edgecolor": FAINT, "axes.spines.top": False,
    "axes.spines.right": False, "axes.grid": True, "axes.axisbelow": True, "grid.color": GRID, "grid.linewidth": 0.8,
    "xtick.color": INK, "ytick.color": INK, "xtick.labelsize": SMALL_PT, "ytick.labelsize": SMALL_PT,
    "legend.framealpha": 0.85, "legend.edgecolor": "none", "legend.fontsize": SMALL_PT, "legend.labelcolor": INK,
    "figure.titlesize": TITLE_PT, "figure.titleweight": "bold",
}  # fmt: skip

P = ParamSpec("P")
R = TypeVar("R")


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Let a function draw in our style, whatever the program has set; nothing of it stays behind."""

    @functools.wraps(draw)
    def drawing(*args: P.args, **kwargs: P.kwargs) -> R:
        from cycler import cycler
        from matplotlib import rc_context

        with rc_context({**_STYLE, "axes.prop_cycle": cycler(color=CYCLE)}):
            return draw(*args, **kwargs)

    return drawing


def write_png(figure: "Figure", path: Path) -> None:
    """Write a figure as PNG, without the date and the program: the file appears complete or not at all.

    Raises:
        OSError: it cannot be written.
    """
    partial = path.with_name(f".{path.name}.part")
    try:
        with partial.open("wb") as file:
            figure.savefig(file, format="png", metadata={"Software": None})
        partial.replace(path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise
