"""Errors over time without and with submaps (GND, Figures 15 and 19), online on the outdated and the updated map
(Figure 24).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gnd.fleet_sim.drives import DriveConfig, DriveSimulation
from gnd.fleet_sim.ellipsoids import ellipsoids_of_truth
from gnd.fleet_sim.street import street
from gnd.fleet_sim.truth import Truth, read_truth
from gnd.fleet_sim.world import World
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.classes import ChangeClass
from gnd.picture_style import BLUE, DPI, FAINT, GREY, INK, MAGENTA, NOTE_PT, PANEL_PT, PAPER, RED, TITLE_PT
from studies.frame.figures import PALE, save, spines
from studies.localisation_study.series import PAPER_LIMITS, PoseSeries
from studies.localisation_study.summary import (
    ROWS,
    LocalisationOutcome,
    LocalisationSeed,
    SensorOutcome,
)

_GREEN: Final = "#cfeccb"
_YELLOW: Final = "#fff1b8"
_NAMES: Final = (("longitudinal", "m", 1.0), ("lateral", "m", 1.0), ("heading", "°", 1.0))
_ENLARGED: Final = (("longitudinal", "cm", 100.0), ("lateral", "cm", 100.0), ("heading", "°", 1.0))
"""Name, unit, and how many of it are a metre or a degree."""
_MUCH: Final = 0.25
"""Places where more than this share has changed are marked: dark in the strip, between dotted lines below."""
_GAP: Final = 3.5  # a line is broken where more than this many scans have no pose


@dataclass(frozen=True, slots=True)
class Curve:
    """One line of a figure: which row, and how it is drawn."""

    row: str
    label: str
    colour: str
    width: float = 1.5


_SUBMAPS: Final = (
    Curve("without_submap", "without submap", BLUE),
    Curve("with_submap", "with submap", RED),
)
_UPDATE: Final = (
    Curve("online", "online, outdated map", BLUE),
    Curve("after_update", "online, updated map", RED),
    Curve("fresh", "online, fresh map", GREY, 1.0),
)
_PICTURES: Final = (
    ("submaps", "Localisation in a changed world, final poses", _SUBMAPS),
    ("update", "Online localisation before and after the map update", _UPDATE),
)


def draw_figures(outcome: LocalisationOutcome, folder: Path) -> list[Path]:
    """Draw both figures of each sensor, for the seed on which it is worst with submaps, and return their paths.

    Raises:
        SimError: a file cannot be written.
    """
    paths = []
    for index, sensor in enumerate(outcome.options.sensors):
        seed = max(outcome.seeds, key=lambda one: _badness(one.sensors[index]))
        found, plan = seed.sensors[index], seed.sensors[index]
        share = _share(outcome, seed, plan)
        for name, title, curves in _PICTURES:
            path = folder / f"{sensor}_{name}.png"
            head = f"{plan.drive.sensor}: {title.lower()}", f"world seed {seed.seed}, {_length(outcome)}"
            _draw(_series(found, curves), share, plan.drive.start_ns, head, path)
            paths.append(path)
    return paths


def _length(outcome: LocalisationOutcome) -> str:
    return f"street of {outcome.options.street.length_m:g} m, scans with motion distortion, urban traffic"


def _badness(found: SensorOutcome) -> float:
    """Largest error with submaps in units of its limit."""
    error = found.runs[ROWS["with_submap"][0]].final.error
    return float(np.max(np.abs(error) / np.array(PAPER_LIMITS.max), initial=0.0))


def _share(outcome: LocalisationOutcome, seed: LocalisationSeed, plan: SensorOutcome) -> tuple[F64, F64]:
    world = street(seed.seed, outcome.options.street)
    return changed_share_along(world, read_truth(seed.truth), plan.drive)


def _series(found: SensorOutcome, curves: Sequence[Curve]) -> dict[Curve, PoseSeries]:
    return {curve: getattr(found.runs[ROWS[curve.row][0]], ROWS[curve.row][1]) for curve in curves}


def _draw(
    series: Mapping[Curve, PoseSeries],
    share: tuple[F64, F64],
    start_ns: int,
    head: tuple[str, str],
    path: Path,
) -> None:
    """Draw three rows of errors, against the limits on the left and enlarged on the right."""
    figure = Figure(figsize=(13.0, 8.4), dpi=DPI, facecolor=PAPER)
    grid = figure.add_gridspec(
        4, 2, height_ratios=(0.28, 1, 1, 1), left=0.06, right=0.985, top=0.835, bottom=0.065, hspace=0.14, wspace=0.14
    )
    for column, titled in enumerate(("against the limits; numbers: 95 % / largest", "enlarged")):
        top = figure.add_subplot(grid[0, column])
        _draw_share(top, share, named=column == 0)
        top.set_title(titled, fontsize=PANEL_PT, color=INK, loc="left", weight="bold")
        for quantity in range(3):
            axes = figure.add_subplot(grid[quantity + 1, column], sharex=top)
            _draw_errors(axes, series, quantity, start_ns, enlarged=column == 1)
            _mark_changes(axes, share)
            axes.tick_params(labelbottom=quantity == 2)
        axes.set_xlabel("seconds since the drive began", color=INK)
    figure.align_ylabels()
    _legend(figure, series)
    figure.text(0.025, 0.965, head[0], fontsize=TITLE_PT, weight="bold", color=INK, va="center")
    figure.text(0.025, 0.930, head[1], fontsize=NOTE_PT, color=PALE, va="center")
    save(figure, path)


def _draw_share(axes: Axes, share: tuple[F64, F64], *, named: bool) -> None:
    """Draw the share of what is near that has changed."""
    t_s, changed = share
    axes.fill_between(t_s, 100 * changed, color=MAGENTA, alpha=0.3, linewidth=0)
    axes.fill_between(t_s, 100 * changed, where=changed > _MUCH, color=MAGENTA, alpha=0.6, linewidth=0)
    axes.set_xlim(t_s[0], t_s[-1])
    axes.set_ylim(0, max(100 * float(changed.max(initial=0.0)) * 1.15, 10))
    axes.set_ylabel(f"changed\n≤ {NEAR_M:g} m, %" if named else "", color=INK, fontsize=8)
    axes.tick_params(labelbottom=False, colors=INK, labelsize=8)
    spines(axes)


def _draw_errors(
    axes: Axes, series: Mapping[Curve, PoseSeries], quantity: int, start_ns: int, *, enlarged: bool
) -> None:
    name, unit, size = (_ENLARGED if enlarged else _NAMES)[quantity]
    p95, largest = size * PAPER_LIMITS.p95[quantity], size * PAPER_LIMITS.max[quantity]
    axes.axhspan(-largest, largest, color=_YELLOW, linewidth=0, zorder=0)
    axes.axhspan(-p95, p95, color=_GREEN, linewidth=0, zorder=0)
    for curve, one in series.items():
        t_s, error = broken(1e-9 * (one.t_ns - start_ns).astype(np.float64), size * one.error[:, quantity])
        axes.plot(t_s, error, color=curve.colour, linewidth=curve.width, zorder=3, solid_joinstyle="round")
    reach = size * max((float(np.abs(one.error[:, quantity]).max(initial=0.0)) for one in series.values()), default=0.0)
    axes.set_ylim(*_range(reach, largest, enlarged=enlarged))
    if not enlarged:
        _write_errors(axes, series, quantity)
    axes.axhline(0.0, color=FAINT, linewidth=0.8, zorder=1)
    axes.set_ylabel(f"{name}, {unit}", color=INK)
    axes.tick_params(colors=INK, labelsize=9)
    spines(axes)


def broken(t_s: F64, error: F64) -> tuple[F64, F64]:
    """The line with gaps where poses are missing."""
    if len(t_s) < 3:
        return t_s, error
    gaps = np.flatnonzero(np.diff(t_s) > _GAP * np.median(np.diff(t_s))) + 1
    return np.insert(t_s, gaps, np.nan), np.insert(error, gaps, np.nan)


def _range(reach: float, largest: float, *, enlarged: bool) -> tuple[float, float]:
    """Limits of the axis: the requirement's and somewhat more, or what the lines fill."""
    size = max(1.12 * reach, 0.01 * largest) if enlarged else 1.32 * max(largest, min(reach, 3 * largest))
    return -size, size


def _mark_changes(axes: Axes, share: tuple[F64, F64]) -> None:
    """Dotted lines where places begin and end that have changed much."""
    t_s, changed = share
    for index in np.flatnonzero(np.diff(changed > _MUCH)):
        axes.axvline((t_s[index] + t_s[index + 1]) / 2, color=MAGENTA, linewidth=1.1, linestyle=":", zorder=2)


def _write_errors(axes: Axes, series: Mapping[Curve, PoseSeries], quantity: int) -> None:
    """Write 95 % and largest error of each curve into the panel."""
    name, unit, _ = _NAMES[quantity]
    scale, unit = (1.0, unit) if unit == "°" else (100.0, "cm")
    for number, (curve, one) in enumerate(series.items()):
        error = one.quantiles()[f"{name}_{'deg' if unit == '°' else 'm'}"]
        numbers = () if error is None else (scale * error["p95"], scale * error["max"])
        digits = 3 if unit == "°" else 1 if max(numbers, default=0.0) >= 10.0 else 2
        text = " / ".join(f"{value:.{digits}f}" for value in numbers) + f" {unit}" if numbers else "no pose"
        x = 0.995 - 0.215 * (len(series) - 1 - number)
        axes.text(x, 0.965, text, transform=axes.transAxes, ha="right", va="top", fontsize=8.5, color=curve.colour)


def _legend(figure: Figure, series: Mapping[Curve, PoseSeries]) -> None:
    handles: list[Any] = [
        Line2D([], [], color=c.colour, linewidth=2.0, label=f"{c.label}{_ending(one)}") for c, one in series.items()
    ]
    handles.append(Patch(color=_GREEN, label="95 % within: 0.15 m, 0.17°"))
    handles.append(Patch(color=_YELLOW, label="never beyond: 0.44 m, 0.5°"))
    figure.legend(
        handles=handles, loc="upper left", bbox_to_anchor=(0.018, 0.918), ncols=len(handles), frameon=False, fontsize=9
    )


def _ending(one: PoseSeries) -> str:
    return "" if len(one) else " (no pose)"


NEAR_M: Final = 20.0
STEP_S: Final = 0.25


def changed_share_along(world: World, truth: Truth, drive: DriveConfig) -> tuple[F64, F64]:
    """Return times (K,) [s] since the drive began and the share (K,) of Gaussians within `NEAR_M` that changed."""
    simulation = DriveSimulation(world, drive)
    t_s = np.arange(0.0, simulation.scans / drive.model.rate_hz, STEP_S)
    ellipsoids = ellipsoids_of_truth(truth)
    changed = ellipsoids.change_class != int(ChangeClass.NORMAL)
    way_m = simulation.motion.T_map_vehicle(t_s)[:, :2, 3]
    return t_s, share_near(ellipsoids.mean_m[:, :2], changed, way_m)


def share_near(p_m: F64, changed: NDArray[np.bool_], way_m: F64) -> F64:
    """Share (K,) of the points (M, 2) near each place (K, 2) that are marked; 0 where there is none."""
    near = cKDTree(p_m).query_ball_point(way_m, NEAR_M)
    return np.array([changed[index].mean() if index else 0.0 for index in near])
