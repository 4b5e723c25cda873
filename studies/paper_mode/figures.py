"""The figures of paper mode: both readings of ξ beside the paper's points."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.ticker import MaxNLocator

from gnd.picture_style import BLUE, GREEN, GREY, INK, MAGENTA, ORANGE
from studies.frame.figures import dress, finish, new_figure
from studies.simulation import scores as reference

PAPER_KB_PER_KM: Final = 56.32
"""Upload of one drive (GND, section 8)."""
PAPER_FLEET_KB_PER_KM: Final = 3511.0 / 38 / (110.0 / PAPER_KB_PER_KM)
"""Mean of the 38 drives that uploaded 3.511 MB (section 7.5), each as long as the one of 0.11 MB."""
PAPER_WITHOUT: Final = {
    "longitudinal_p95_m": 0.08412, "longitudinal_max_m": 0.2002, "lateral_p95_m": 0.30124, "lateral_max_m": 1.4518,
    "heading_p95_deg": 1.1388, "heading_max_deg": 6.2191,
}  # fmt: skip
PAPER_WITH: Final = {
    "longitudinal_p95_m": 0.031013, "longitudinal_max_m": 0.054553, "lateral_p95_m": 0.012499,
    "lateral_max_m": 0.030573, "heading_p95_deg": 0.052715, "heading_max_deg": 0.094034,
}  # fmt: skip
"""Table 2: errors in the simulation, without and with submap."""
_COLOURS: Final = (MAGENTA, GREEN)
Found = Mapping[str, Any]


def draw_curves(found: Found, readings: Sequence[str], path: Path) -> Path:
    """Draw Figure 17: F1 by number of vehicles, of all voxels (as the paper) and of observable ones."""
    figure = new_figure(9.4, 5.6)
    axes = figure.subplots()
    for name, colour in zip(readings, _COLOURS, strict=True):
        fleet = found[name]["fleet"]
        at = sorted(map(int, fleet))
        for level, style, width in (("scored", "--", 1.4), ("observable", "-", 2.4), ("all", ":", 1.4)):
            values = [fleet[str(n)]["f1"][level] for n in at]
            axes.plot(at, values, style, color=colour, linewidth=width, label=f"{name}, {level}")
    paper = {1: reference.SINGLE, **reference.FLEET_READ_OFF, **reference.FLEET}
    axes.plot(list(paper), list(paper.values()), "x", color=INK, markersize=8, markeredgewidth=2, label="paper")
    dress(axes, "vehicles", "macro F1, percent")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend(frameon=False, fontsize=9, ncols=2, labelcolor=INK, loc="lower right")
    axes.set_ylim(min(axes.get_ylim()[0], 60.0), 101.0)
    stale = found[readings[0]]["stale"]["f1"]
    note = f"stale map: {stale['all']:.2f} of all voxels, {stale['scored']:.2f} scored (paper {reference.PAPER_STALE})"
    return finish(figure, "Figure 17 with both readings of ξ", note, path)


def draw_localisation(found: Found, path: Path) -> Path:
    """Draw Figure 15 as its Table 2: errors of a vehicle that comes after the fleet, on each map."""
    rows = [*found["localisation"].items(), ("paper, with submap", PAPER_WITH), ("paper, without", PAPER_WITHOUT)]
    figure = new_figure(10.0, 4.2)
    for axes, (name, unit) in zip(
        figure.subplots(1, 3), (("longitudinal", "m"), ("lateral", "m"), ("heading", "deg")), strict=True
    ):
        for at, ((_, row), colour) in enumerate(zip(rows, (BLUE, *_COLOURS, GREY, ORANGE), strict=True)):
            p95, most = row[f"{name}_p95_{unit}"], row[f"{name}_max_{unit}"]
            axes.plot([p95, most], [at, at], color=colour, linewidth=2.5)
            axes.plot([p95], [at], "o", color=colour, markersize=8)
            axes.plot([most, most], [at - 0.2, at + 0.2], color=colour, linewidth=2.5)
            axes.text(max(p95, most) * 1.15, at, f"{p95:.3g} | {most:.3g}", va="center", fontsize=8, color=INK)
        dress(axes, f"{name}, {unit}", "")
        axes.set_yticks(range(len(rows)), [label for label, _ in rows] if name == "longitudinal" else [""] * len(rows))
        axes.set_xscale("log")
        low, high = axes.get_xlim()
        axes.set_xlim(low, high * 6)
        axes.invert_yaxis()
    return finish(
        figure, "Figure 15: errors of a vehicle after the fleet", "dot: 95 %, bar: largest, as numbers beside", path
    )


def draw_traffic(found: Found, path: Path) -> Path:
    """Draw Figure 23 (b) and (c): bytes up a km, of each vehicle, and together."""
    figure = new_figure(9.4, 4.2)
    left, right = figure.subplots(1, 2)
    number = 0
    for (name, values), colour in zip(found["upload"].items(), _COLOURS, strict=True):
        number = len(values)
        left.plot(range(1, number + 1), values, "o", color=colour, markersize=5, label=name)
        right.plot(range(1, number + 1), np.cumsum(values), color=colour, linewidth=2.2, label=name)
    left.axhline(
        PAPER_KB_PER_KM, color=INK, linewidth=1.2, linestyle="--", label=f"paper, one drive: {PAPER_KB_PER_KM}"
    )
    at = np.arange(1, number + 1)
    right.plot(at, PAPER_FLEET_KB_PER_KM * at, "--", color=INK, linewidth=1.2, label="paper, mean of 38 drives")
    dress(left, "vehicle", "kB/km up", "(b) a vehicle")
    dress(right, "vehicles", "kB/km up, together", "(c) the fleet")
    for axes in (left, right):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_ylim(bottom=0)
        axes.legend(frameon=False, fontsize=9, labelcolor=INK)
    return finish(figure, "Figure 23: what either reading uploads", "reports with float Gaussians, whole", path)
