"""Curves over time: errors beside the limits (GND, Figures 15, 19 and 24), and the localiser's own uncertainty."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from gnd.gnd_map.arrays import F64, I64
from gnd.picture_style import INK, MUTED
from gnd.vehicle_agent.localise.estimates import ErrorSeries, PoseEstimate, error_series
from gnd.vehicle_agent.localise_drive.accuracy import LIMITS, AccuracyLimit, healthy
from gnd.vehicle_agent.localise_drive.run import LocalisedDrive
from gnd.vehicle_agent.localise_drive.stretches import HEALTHS, HealthStretch, stretches_of
from gnd.vehicle_agent.localise_drive.style import (
    HEALTH_COLOURS,
    ONLINE,
    REFINED,
    dress,
    health_strip,
    name_causes,
    new_figure,
    save_figure,
)

GAP_NS: Final = 500_000_000
"""Lines are interrupted where there is no pose for longer."""
_MAX_BAND: Final = "#f6e39a"
_P95_BAND: Final = "#bfe3c2"
_HEADROOM: Final = 1.15
_SIZE_IN: Final = (12.6, 8.6)
_GRID: Final = {"left": 0.075, "right": 0.985, "top": 0.845, "bottom": 0.075, "hspace": 0.16, "wspace": 0.17}


def draw_errors(drive: LocalisedDrive, path: Path) -> Path:
    """Errors over time, left against the limits, right enlarged; the drive has a reference.

    Raises:
        LocaliseError: the file cannot be written.
    """
    series = {
        "online": (error_series(drive.online, drive.reference), ONLINE),
        "refined": (error_series(drive.refined, drive.reference), REFINED),
    }
    figure = new_figure(*_SIZE_IN, "Errors against the reference", _heading(drive))
    axes = figure.subplots(3, 2, sharex=True, squeeze=False)
    figure.subplots_adjust(**_GRID)
    for (name, limit), row in zip(LIMITS.items(), axes, strict=True):
        _error_row(row, name, limit, series, drive)
    name_causes(axes[0, 1], stretches_of(drive.moments))
    figure.align_ylabels()
    for foot in axes[-1]:
        foot.set_xlabel("seconds since the first scan", color=INK)
    axes[0, 0].set_title("against the limits", fontsize=11, color=INK, loc="left", pad=14)
    axes[0, 1].set_title("enlarged", fontsize=11, color=INK, loc="left", pad=14)
    _legend(figure, [*_error_handles(), *_health_handles(stretches_of(drive.moments))])
    save_figure(figure, path)
    return path


def draw_quality(drive: LocalisedDrive, path: Path) -> Path:
    """The localiser's own estimate over time: one-sigma of place and heading, matching ratio, health.

    Raises:
        LocaliseError: the file cannot be written.
    """
    figure = new_figure(*_SIZE_IN, "The localiser's own estimate of its errors", _heading(drive))
    axes = figure.subplots(3, 1, sharex=True)
    figure.subplots_adjust(**_GRID)
    stretches = stretches_of(drive.moments)
    for panel, (label, of) in zip(axes, _SAID.items(), strict=True):
        dress(panel, label)
        for estimates, colour in ((drive.online, ONLINE), (drive.refined, REFINED)):
            values = np.array([of(estimate) for estimate in estimates], np.float64)
            panel.plot(*_broken(_times(estimates), values, drive.start_ns), color=colour, linewidth=1.5)
        panel.set_ylim(0.0, 1.05 if label == _RATIO else max(panel.get_ylim()[1], 1e-6))
        _whole_drive(panel, drive)
        health_strip(panel, stretches)
    name_causes(axes[0], stretches)
    figure.align_ylabels()
    axes[-1].set_xlabel("seconds since the first scan", color=INK)
    lines = [Line2D([], [], color=c, linewidth=2, label=n) for n, c in (("refined", REFINED), ("online", ONLINE))]
    _legend(figure, [*lines, *_health_handles(stretches)])
    save_figure(figure, path)
    return path


_RATIO: Final = "matching ratio"
_SAID: Final[Mapping[str, Callable[[PoseEstimate], float]]] = {
    "one sigma, place [cm]": lambda e: e.sigma_m * 100.0,
    "one sigma, heading [°]": lambda e: math.degrees(e.sigma_rad),
    _RATIO: lambda e: e.matching_ratio,
}


def _error_row(
    row: Sequence[Axes],
    name: str,
    limit: AccuracyLimit,
    series: dict[str, tuple[ErrorSeries, str]],
    drive: LocalisedDrive,
) -> None:
    """Both panels of one kind of error."""
    scale, unit = (100.0, "cm") if limit.unit == "m" else (1.0, "°")
    for panel in row:
        dress(panel, f"{name} [{unit}]" if panel is row[0] else "")
        for one, colour in series.values():
            panel.plot(*_broken(one.t_ns, one.of(name) * scale, drive.start_ns), color=colour, linewidth=1.4, zorder=3)
        _whole_drive(panel, drive)
        health_strip(panel, stretches_of(drive.moments), shade=panel is row[1])
    _bands(row[0], limit, scale)
    _edges(row[1], limit, scale)
    row[0].set_ylim(*(np.array([-1, 1]) * _HEADROOM * limit.largest * scale))
    row[1].set_ylim(*(np.array([-1, 1]) * _HEADROOM * scale * _reach(drive, name)))


def _reach(drive: LocalisedDrive, name: str) -> float:
    """How far the enlarged panel must reach: the largest error of refined poses called good, 95 % of online ones."""
    refined, online = (error_series(healthy(poses) or poses, drive.reference).of(name) for poses in _both(drive))
    usual = float(np.quantile(np.abs(online), 0.95)) if len(online) else 0.0
    return max(float(np.abs(refined).max(initial=0.0)), usual, 1e-5)


def _both(drive: LocalisedDrive) -> tuple[Sequence[PoseEstimate], Sequence[PoseEstimate]]:
    return drive.refined, drive.online


def _bands(panel: Axes, limit: AccuracyLimit, scale: float) -> None:
    """Yellow for the largest error that is allowed, green for what 95 % must keep."""
    panel.axhspan(-limit.largest * scale, limit.largest * scale, color=_MAX_BAND, alpha=0.55, linewidth=0, zorder=-2)
    panel.axhspan(-limit.p95 * scale, limit.p95 * scale, color=_P95_BAND, alpha=0.8, linewidth=0, zorder=-1)


def _edges(panel: Axes, limit: AccuracyLimit, scale: float) -> None:
    """Where the limits lie, if errors reach that far."""
    for edge in (limit.p95, limit.largest):
        for side in (-edge, edge):
            panel.axhline(side * scale, color=MUTED, linewidth=1.0, linestyle="--", zorder=1)


def _times(estimates: Sequence[PoseEstimate]) -> I64:
    return np.array([estimate.t_ns for estimate in estimates], np.int64)


def _broken(t_ns: I64, values: F64, start_ns: int) -> tuple[F64, F64]:
    """Seconds and values with a NaN where a line is to be interrupted."""
    after = np.flatnonzero(np.diff(t_ns) > GAP_NS) + 1
    return np.insert((t_ns - start_ns) * 1e-9, after, np.nan), np.insert(values, after, np.nan)


def _whole_drive(panel: Axes, drive: LocalisedDrive) -> None:
    last_ns = drive.moments[-1].t_ns if drive.moments else drive.start_ns
    panel.set_xlim(0.0, max((last_ns - drive.start_ns) * 1e-9, 0.1))


def _heading(drive: LocalisedDrive) -> str:
    return f"drive {drive.header.drive_id}, {drive.header.sensor_model}, {len(drive.refined)} scans with a pose"


def _error_handles() -> list[Any]:
    return [
        Line2D([], [], color=REFINED, linewidth=2, label="refined"),
        Line2D([], [], color=ONLINE, linewidth=2, label="online"),
        Patch(color=_P95_BAND, label="limit of 95 %"),
        Patch(color=_MAX_BAND, label="limit of all"),
    ]


def _health_handles(stretches: Sequence[HealthStretch]) -> list[Any]:
    there = {one.health for one in stretches}
    return [Patch(color=HEALTH_COLOURS[health], label=f"health: {health}") for health in HEALTHS if health in there]


def _legend(figure: Figure, handles: list[Any]) -> None:
    ncols = min(len(handles), 4 if len(handles) > 6 else 3)
    figure.legend(
        handles=handles, loc="upper right", bbox_to_anchor=(0.988, 0.975), ncols=ncols, frameon=False, fontsize=10,
        labelcolor=INK, columnspacing=1.4, handlelength=1.6,
    )  # fmt: skip
