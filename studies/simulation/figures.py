"""The figures of a reproduction: map changes (GND, Figure 16), F1 by number of vehicles (Figure 17)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from gnd.fleet_sim.ellipsoids import ellipsoids_of_maps, ellipsoids_of_truth
from gnd.fleet_sim.pictures import StreetView, draw_map
from gnd.fleet_sim.truth import LEVELS, Truth, read_truth
from gnd.picture_style import BLUE, DPI, GREEN, INK, MAGENTA, NOTE_PT, ORANGE, PAPER, SMALL_PT, TITLE_PT
from studies.frame.figures import PALE, dress, save
from studies.simulation import scores as reference
from studies.simulation.cloud import arrived, map_of_one, merged_map
from studies.simulation.scores import SimulationOutcome, WorldOutcome, target_single
from studies.simulation.worlds import read_world_base

_LEVEL_NAMES: Final = {"observable": "observable voxels", "all": "all voxels", "scored": "scored voxels"}
_LEVEL_STYLE: Final = {"observable": "-", "scored": "--", "all": ":"}


def draw_figures(outcome: SimulationOutcome, summary: Mapping[str, Any], folder: Path) -> list[Path]:
    """Draw all figures of the first world into the folder and return their paths.

    Raises:
        SimError: a file cannot be written.
    """
    world = outcome.worlds[0]
    truth = read_truth(world.files.truth)
    paths = draw_changes(outcome, world, truth, folder)
    paths.append(draw_curve(summary, folder / "f1_by_vehicles.png"))
    return paths


def draw_changes(outcome: SimulationOutcome, world: WorldOutcome, truth: Truth, folder: Path) -> list[Path]:
    """Draw Figure 16: changes found by one drive, by the fleet, and the truth, in one view."""
    base, true = read_world_base(world.files), ellipsoids_of_truth(truth)
    view, n = StreetView.around(true), max(outcome.options.vehicles)
    one = next((vehicle for vehicle in world.vehicles if vehicle.sensor in reference.TARGET_SENSORS), world.vehicles[0])
    merge, parked_h = outcome.options.method.merge, outcome.options.method.parked_h
    held = arrived(base, world.vehicles[:n], merge, outcome.options.upload)
    merged = merged_map(base, [body for sent in held for body in sent.bodies], merge, parked_h)
    alone, fleet = (
        f"F1 {scored.f1():.2f} % of observable voxels" for scored in (world.single[one.vehicle], world.fleet[n])
    )
    pictures = (
        ("single.png", ellipsoids_of_maps(truth.frame, base.tiles, map_of_one(base, one.reports, merge, parked_h)),
         f"One drive, {one.sensor}", alone),
        ("merged.png", ellipsoids_of_maps(truth.frame, base.tiles, merged), f"{n} vehicles", fleet),
        ("truth.png", true, "Truth", f"world seed {world.seed}"),
    )  # fmt: skip
    for name, ellipsoids, title, note in pictures:
        draw_map(ellipsoids, folder / name, title, note, view)
    return [folder / name for name, *_ in pictures]


def draw_curve(summary: Mapping[str, Any], path: Path) -> Path:
    """Draw Figure 17: F1 of observable voxels by number of vehicles; thin lines are the other two levels.

    The axis is broken: the stale map lies far below everything else.
    """
    figure = Figure(figsize=(9.4, 6.4), dpi=DPI, facecolor=PAPER)
    axes, below = figure.add_axes((0.08, 0.27, 0.89, 0.61)), figure.add_axes((0.08, 0.095, 0.89, 0.13))
    numbers = sorted(int(n) for n in summary["fleet"])
    drawn = [*_curves(axes, summary, numbers), *_baseline(axes, summary)]
    stale = summary["stale"]["f1"]["observable"]
    below.axhline(stale, color=BLUE, linewidth=1.8)
    axes.plot([], [], color=BLUE, linewidth=1.8, label=f"stale map: {stale:.2f} (paper {reference.PAPER_STALE})")
    paper = {1: reference.SINGLE, **reference.FLEET_READ_OFF, **reference.FLEET}
    shown = [n for n in paper if n <= max(numbers)]
    axes.plot(shown, [paper[n] for n in shown], "x", color=INK, markersize=7, label="paper", clip_on=False, zorder=5)
    for part in (axes, below):
        dress(part, "", "")
        part.set_xlim(min(numbers) - 0.3, max(*numbers, 2) + 0.3)
        part.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_ylim(np.floor(min(*drawn, reference.SINGLE)) - 1.5, 100.5)
    axes.tick_params(labelbottom=False)
    axes.spines["bottom"].set_visible(False)
    below.set_ylim(stale - 6, stale + 6)
    below.set_xlabel("vehicles", color=INK)
    axes.set_ylabel("macro F1 in percent", color=INK)
    axes.legend(frameon=False, fontsize=SMALL_PT, loc="lower right", labelcolor=INK, ncols=2)
    seeds = ", ".join(map(str, summary["seeds"]))
    _title(figure, "F1 by number of vehicles", f"world seed {seeds}, poses {summary['parameters']['poses']}")
    return save(figure, path)


def _curves(axes: Axes, summary: Mapping[str, Any], numbers: list[int]) -> list[float]:
    """Draw the fleet at the three levels and the line of one drive; give all values."""
    _spread(axes, summary, numbers)
    drawn: list[float] = []
    for level in reversed(LEVELS):
        values = [summary["fleet"][str(n)]["f1"][level] for n in numbers]
        width, label = 2.4 if level == "observable" else 1.3, f"fleet, {_LEVEL_NAMES[level]}"
        axes.plot(numbers, values, _LEVEL_STYLE[level], color=GREEN, linewidth=width, label=label)
        drawn += values
    single, of = _one_drive(summary)
    axes.axhline(single, color=ORANGE, linewidth=1.8, label=f"one drive, {of}: {single:.2f}")
    return [*drawn, single]


def _one_drive(summary: Mapping[str, Any]) -> tuple[float, str]:
    """Mean F1 of a drive alone and whose it is: of the 16- and 32-layer sensors, of all where none of them drove."""
    target = target_single(summary)
    if target is not None:
        return target["observable"], "16/32 layers"
    return float(np.mean([stage["f1"]["observable"] for stage in summary["single"].values()])), "all sensors"


def _spread(axes: Axes, summary: Mapping[str, Any], numbers: list[int]) -> None:
    """Shade what lies between the best and the worst of several worlds."""
    worlds = list(summary.get("by_seed", {}).values())
    if worlds:
        each = np.array([[world["fleet"][str(n)]["f1"]["observable"] for n in numbers] for world in worlds])
        axes.fill_between(numbers, each.min(axis=0), each.max(axis=0), color=GREEN, alpha=0.15, linewidth=0)


def _baseline(axes: Axes, summary: Mapping[str, Any]) -> list[float]:
    """Draw the point-cloud baseline, where it ran; give its values."""
    fleet = summary.get("pcd", {}).get("fleet", {})
    numbers = sorted(int(n) for n in fleet)
    values = [float(fleet[str(n)]["f1"]["observable"]) for n in numbers]
    if values:
        axes.plot(numbers, values, "o-", color=MAGENTA, linewidth=1.6, markersize=4, label="point clouds, observable")
    return values


def _title(figure: Figure, title: str, note: str) -> None:
    figure.text(0.03, 0.955, title, fontsize=TITLE_PT, weight="bold", color=INK, va="center")
    figure.text(0.03, 0.912, note, fontsize=NOTE_PT, color=PALE, va="center")
