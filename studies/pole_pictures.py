"""Pictures of poles: a scan from above with what was found in it, and side views of the found poles."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.poles.detector import Pole
from studies.pole_real import RealScan

COLOURS: Final = {"pole": "#1f77b4", "streetlight": "#ff7f0e", "traffic_sign": "#d62728", "trunk": "#2ca02c"}
REACH_M: Final = 42.0
SIDE_M: Final = 2.5
"""Half the width of a side view."""
SIDES: Final = 12


def draw_poles(scan: RealScan, poles: Sequence[Pole], title: str, path: Path) -> Path:
    """Draw a scan from above, the vehicle in the middle, and side views of its nearest poles; write a PNG."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure = plt.figure(figsize=(15.0, 9.0), layout="constrained")
    grid = figure.add_gridspec(3, 8)
    _from_above(figure.add_subplot(grid[:, :5]), scan, poles, title)
    for number, pole in enumerate(poles[:9]):
        _from_the_side(figure.add_subplot(grid[number // 3, 5 + number % 3]), scan, pole, number)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def _from_above(axes: Any, scan: RealScan, poles: Sequence[Pole], title: str) -> None:
    points = scan.rays.points_m - scan.T_map_vehicle[:3, 3]
    near = points[np.abs(points[:, :2]).max(axis=1) < REACH_M]
    order = np.argsort(near[:, 2])
    shown = near[order]
    axes.scatter(shown[:, 0], shown[:, 1], c=shown[:, 2], s=0.4, cmap="gray_r", vmin=-1.0, vmax=4.0, linewidths=0)
    for number, pole in enumerate(poles):
        x, y = pole.xy_m - scan.T_map_vehicle[:2, 3]
        colour = COLOURS[pole.kind]
        axes.plot(x, y, "o", mfc="none", mec=colour, ms=11, mew=1.6)
        axes.annotate(str(number), (x, y), xytext=(6, 6), textcoords="offset points", color=colour, fontsize=9)
    for kind, colour in COLOURS.items():
        axes.plot([], [], "o", mfc="none", mec=colour, label=kind)
    axes.plot(0.0, 0.0, "k^", ms=8)
    axes.set(xlim=(-REACH_M, REACH_M), ylim=(-REACH_M, REACH_M), aspect="equal", title=title, xlabel="m", ylabel="m")
    axes.legend(loc="upper right", fontsize=8)


def _from_the_side(axes: Any, scan: RealScan, pole: Pole, number: int) -> None:
    """Points about a pole as the sensor sees them: across against up, those before and behind it left out."""
    toward = pole.xy_m - scan.T_map_vehicle[:2, 3]
    distance = float(np.hypot(*toward))
    toward = toward / distance
    off: F64 = scan.rays.points_m[:, :2] - pole.xy_m
    along, across = off @ toward, off @ np.array([toward[1], -toward[0]])
    height = scan.rays.points_m[:, 2] - pole.foot_z_m
    near = (np.abs(across) < SIDE_M) & (np.abs(along) < SIDE_M) & (height < 9.0)
    core = near & (np.hypot(*off.T) < 0.5 * pole.diameter_m + 0.2)
    axes.scatter(across[near], height[near], s=1.5, c="0.6", linewidths=0)
    axes.scatter(across[core], height[core], s=3.0, c=COLOURS[pole.kind], linewidths=0)
    axes.set(xlim=(-SIDE_M, SIDE_M), ylim=(-0.5, 8.0))
    axes.set_title(f"{number}: {pole.kind}, {distance:.0f} m, Ø {pole.diameter_m:.2f} m", fontsize=8)
    axes.tick_params(labelsize=6)
