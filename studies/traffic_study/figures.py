"""The figures of a study: Figure 23 of the GND paper, with our codecs beside."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from gnd.gnd_map.arrays import F64
from gnd.picture_style import (
    BLUE,
    DPI,
    GREEN,
    GREY,
    GRID,
    INK,
    MAGENTA,
    NOTE_PT,
    ORANGE,
    PAPER,
    SKY,
    SMALL_PT,
    TITLE_PT,
    YELLOW,
)
from studies.frame.figures import PALE, save, spines

_LINKS: Final = {"3g": BLUE, "4g": ORANGE, "5g": YELLOW}
"""As in the paper: blue, orange, yellow."""
_COLOURS: Final = {
    "raw": SKY,
    "pcd": MAGENTA,
    "pcd_changes": MAGENTA,
    "gnd_float": GREY,
    "gnd": GREEN,
}
_GAP: Final = 0.042
"""Least distance of two notes, as a share of the axis."""
_NAMES: Final = {"pcd": "point cloud, 0.2 m", "gnd_float": "GND, float32 columns", "gnd": "GND, standard"}


@dataclass(frozen=True, slots=True)
class Note:
    """What stands at the end of a line, at the height of its last size."""

    size: float
    text: str
    colour: str


def draw_figures(found: Mapping[str, Any], folder: Path) -> list[Path]:
    """Draw (a) the download and (c) the upload of all drives, and return their paths.

    Raises:
        SimError: a file cannot be written.
    """
    pictures = (("download.png", _download), ("upload_fleet.png", _fleet))
    for name, draw in pictures:
        figure = Figure(figsize=(9.6, 5.6), dpi=DPI, facecolor=PAPER, layout="constrained")
        draw(figure.add_subplot(), found)
        save(figure, folder / name)
    return [folder / name for name, _ in pictures]


def _download(axes: Axes, found: Mapping[str, Any]) -> None:
    """Accumulated bytes over the way, against what the links carry in the time."""
    down = found["download"]
    way_m = 1e3 * found["km"]
    x = np.linspace(0.0, way_m, 200)[1:]
    notes = _links(axes, x, {name: found["links"][name]["down_bytes"] * x / way_m for name in _LINKS})
    for name in ("pcd", "gnd_float", "gnd"):
        rows = np.array([[0.0, 0.0, 1.0], *down["along"][name]])
        x, y = np.append(rows[:, 1], way_m), np.append(rows[:, 2], rows[-1, 2])
        axes.step(x, y, where="post", color=_COLOURS[name], linewidth=2.2, zorder=4)
        notes.append(Note(y[-1], f"{_NAMES[name]}: {_shown(y[-1])}", _COLOURS[name]))
    axes.set_xlim(0, way_m)
    axes.set_xlabel("way driven, m", color=INK)
    density = f"{down['voxels']} voxels in {down['tiles']} tiles, {down['voxels_per_km']} voxels a km"
    _finish(axes, notes, "Download along the drive", f"world seed {found['seed']}, {density}")


def _links(axes: Axes, x: F64, sizes: Mapping[str, F64]) -> list[Note]:
    """Draw what each link carries until x (N,), and return what stands at the ends of the lines."""
    for name, y in sizes.items():
        axes.plot(x, y, color=_LINKS[name], linewidth=1.6, linestyle="--", zorder=2)
    return [Note(y[-1], f"{name.upper()} carries {_shown(y[-1])}", _LINKS[name]) for name, y in sizes.items()]


def _fleet(axes: Axes, found: Mapping[str, Any]) -> None:
    """Accumulated bytes over the drives."""
    drives = found["drives"]
    x = np.arange(1.0, len(drives) + 1.0)
    notes = _links(axes, x, {name: found["links"][name]["up_bytes"] * x for name in _LINKS})
    for name, label, sizes in _series(found, drives):
        y = np.cumsum(sizes)
        axes.plot(x, y, color=_COLOURS[name], linewidth=2.2, marker="o", markersize=2.8, zorder=4)
        notes.append(Note(float(y[-1]), f"{label}: {_shown(y[-1])}", _COLOURS[name]))
    axes.set_xlim(0.0, len(drives))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("drives", color=INK)
    rates = found["upload"]["changed_per_km"]
    where = f"world seed {found['seed']}, {1e3 * found['km']:.0f} m each"
    note = f"changes a km: {rates['first']:.0f} on the first drive, {rates['steady']:.0f} in the merged world"
    _finish(axes, notes, f"Upload of {len(drives)} drives", f"{where}; {note}")


def _series(found: Mapping[str, Any], drives: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, list[float]]]:
    series = [
        ("raw", "all measurements", [float(one["raw_bytes"]) for one in drives]),
        ("gnd_float", "GND changes in floats", [float(one["float_bytes"]) for one in drives]),
        ("gnd", "GND changes", [float(one["bytes"]) for one in drives]),
    ]
    total = found["upload"]["fleet"]["pcd_changes"]["bytes"]
    if total is not None:
        mean = total / len(drives)
        sizes = [float(one["pcd_bytes"].get("points", mean)) for one in drives]
        series.append(("pcd_changes", "point-cloud changes", sizes))
    return series


def _finish(axes: Axes, notes: Sequence[Note], title: str, note: str) -> None:
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _shown(value)))
    axes.set_ylim(bottom=max(axes.get_ylim()[0], 100.0))
    low, high = np.log10(axes.get_ylim())
    heights = spread([(np.log10(one.size) - low) / (high - low) for one in notes], _GAP)
    for one, height in zip(notes, heights, strict=True):
        axes.annotate(
            one.text,
            (1.012, height),
            xycoords="axes fraction",
            color=one.colour,
            va="center",
            fontsize=SMALL_PT,
            zorder=5,
        )
    _titled(axes, title, note)


def spread(heights: Sequence[float], gap: float) -> list[float]:
    """Heights in the same order, moved upwards where two are closer than `gap`."""
    found, last = [0.0] * len(heights), -float("inf")
    for index in sorted(range(len(heights)), key=lambda k: heights[k]):
        last = found[index] = max(heights[index], last + gap)
    return found


def _titled(axes: Axes, title: str, note: str) -> None:
    axes.set_title(f"{title}\n", loc="left", color=INK, fontsize=TITLE_PT, weight="bold")
    axes.text(0.0, 1.025, note, transform=axes.transAxes, color=PALE, fontsize=NOTE_PT)
    axes.grid(visible=True, color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=INK, labelsize=9)
    spines(axes)


def _shown(size: float) -> str:
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= scale:
            return f"{size / scale:.3g} {unit}"
    return f"{size:.0f} B"
