"""The figures of the paper on new feature layers on our routes: errors of beacons (Figures 6, 7, 8), of lights (10, 11)
and of localisation (12).
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse
from matplotlib.ticker import MaxNLocator

from gnd.gnd_map.arrays import F64
from studies.frame.figures import BLUE, GREEN, GREY, INK, MAGENTA, ORANGE, RED, dress, finish, new_figure
from studies.new_layer_study import layers as reference
from studies.new_layer_study.layers import (
    DIRECTIONS,
    WIDE_RADIUS_M,
    LayerScore,
    MotorwayOutcome,
    NewLayerSeed,
    RouteOutcome,
)
from studies.new_layer_study.summary import drive_scores, integrated_score

_SENSORS: Final = {"beacon": BLUE, "lane": ORANGE}
_SIGMAS_95: Final = 2.4477
"""Half axes of the 95 % ellipse of two dimensions, in standard deviations."""


def draw_figures(outcomes: Sequence[NewLayerSeed], km: float, found: Mapping[str, Any], folder: Path) -> list[Path]:
    """Draw all figures into the folder and return their paths; of single features those of the first seed.

    Raises:
        SimError: a file cannot be written.
    """
    first, note = outcomes[0], f"seed {outcomes[0].seed}"
    paths = [
        draw_beacons(first.track, f"test track, {note}", folder / "new_layer_beacons.png"),
        draw_integration(found, folder / "new_layer_by_drives.png"),
    ]
    if found["nfl"]["noise"]:
        paths.append(draw_noise(found, folder / "new_layer_noise.png"))
    roads = [("motorway", first.motorway)]
    if first.straight is not None:
        roads.append(("straight", first.straight))
    for name, road in roads:
        where = f"{km:g} km of {'motorway' if name == 'motorway' else 'straight motorway'}, {note}"
        paths.append(draw_lights(road.route, where, folder / f"new_layer_lights_{name}.png"))
        paths.append(draw_one_light(road.route, where, folder / f"new_layer_one_light_{name}.png"))
        paths.append(draw_localisation(road, where, folder / f"new_layer_localisation_{name}.png"))
    return paths


def draw_beacons(route: RouteOutcome, note: str, path: Path) -> Path:
    """Draw Figure 6: errors of each beacon of the first drive, without and with HD map."""
    figure = new_figure(11.0, 4.8)
    axes, side = figure.subplots(1, 2, width_ratios=(4.2, 1))
    dress(axes, "beacon", "position error, m")
    cases = (("without_map", "without HD map", GREEN, -0.2), ("with_map", "with HD map", BLUE, 0.2))
    top = 1.0
    for case, label, colour, shift in cases:
        first = drive_scores(route, case)[0]
        axes.bar(
            first.feature + 1 + shift, first.of("euclidean"), width=0.4, color=colour, label=f"{label}, first drive"
        )
        top = max(top, float(first.of("euclidean").max(initial=0.0)))
    axes.set_ylim(0.0, 1.2 * top)
    axes.legend(fontsize=9, ncols=2, loc="upper right")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    dress(side, "", f"mean ± std of {len(route.drives)} drives, m")
    for i, (case, _, colour, _) in enumerate(cases):
        distance = np.concatenate([one.of("euclidean") for one in drive_scores(route, case)])
        _bar(side, 2 * i, (float(distance.mean()), float(distance.std())), colour)
        _bar(side, 2 * i + 1, reference.PAPER_SINGLE_M[case], colour, pale=True)
    side.set_xticks(range(4), ["without", "paper", "with", "paper"], fontsize=8)
    return finish(figure, "Beacons of single drives", note, path)


def _bar(axes: Axes, x: float, value: tuple[float, float], colour: str, *, pale: bool = False) -> None:
    mean, std = value
    axes.bar(x, mean, yerr=std, color=colour, alpha=0.4 if pale else 1.0, width=0.7, capsize=3, ecolor=INK)
    axes.text(x + 0.05, mean, f" {mean:.2f}", color=INK, fontsize=8, va="bottom")


def draw_integration(found: Mapping[str, Any], path: Path) -> Path:
    """Draw Figure 7: mean error of the integrated beacons by number of drives, each seed thin."""
    figure = new_figure(8.0, 4.8)
    axes = figure.subplots()
    dress(axes, "drives integrated", "mean position error, m")
    for one in found["seeds"].values():
        axes.plot(*_curve(one["integrated"]), color=GREY, linewidth=0.9, alpha=0.8)
    n, mean = _curve(found["nfl"]["integrated"])
    axes.plot(n, mean, "o-", color=MAGENTA, linewidth=2.2, label="ours, mean of the seeds")
    paper = reference.PAPER_INTEGRATED_M
    axes.plot(list(paper), list(paper.values()), "D", color=ORANGE, markersize=7, label="paper")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_ylim(bottom=0.0)
    axes.legend(fontsize=9)
    return finish(figure, "Beacons of several drives", f"test track, seeds {', '.join(found['seeds'])}", path)


def _curve(values: Mapping[str, Any]) -> tuple[list[float], list[float]]:
    shown = {float(n): value for n, value in values.items() if value is not None}
    return list(shown), list(shown.values())


def draw_noise(found: Mapping[str, Any], path: Path) -> Path:
    """Draw Figure 8: mean error by noise level of one sensor, the other's at 1."""
    figure = new_figure(10.4, 4.6)
    titles = (("integrated", f"{max(map(int, found['nfl']['integrated']))} drives"), ("single_with_map", "one drive"))
    for axes, (what, title) in zip(figure.subplots(1, 2), titles, strict=True):
        dress(axes, "noise level l", "mean position error, m", title)
        for sensor, colour in _SENSORS.items():
            rows = found["nfl"]["noise"][sensor]
            levels, values = _curve({level: row[what] for level, row in rows.items()})
            axes.plot(levels, values, "o-", color=colour, linewidth=2.0, label=f"noise of {sensor}s")
        axes.set_ylim(bottom=0.0)
        axes.legend(fontsize=9)
    seeds = ", ".join(seed for seed, one in found["seeds"].items() if one["noise"])
    note = f"test track, seeds {seeds}; N(0, l²) m and N(0, (2.5 l)²) °; the other sensor's l = 1"
    return finish(figure, "Noise of the sensors", note, path)


def draw_lights(route: RouteOutcome, note: str, path: Path) -> Path:
    """Draw Figure 10: errors of each light, one drive without and with map, and the integration."""
    figure = new_figure(11.5, 8.2)
    cases = lights_cases(route)
    for axes, direction in zip(figure.subplots(3, 1, sharex=True), DIRECTIONS, strict=True):
        dress(axes, "light" if direction == DIRECTIONS[-1] else "", "error, m", direction)
        for i, (label, colour, scored) in enumerate(cases):
            errors = scored.of(direction)
            mean = f"{errors.mean():.3f} ± {errors.std():.3f} m" if len(errors) else "none found"
            axes.bar(scored.feature + 1 + 0.28 * (i - 1), errors, width=0.28, color=colour, label=f"{label}: {mean}")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_ylim(0.0, 1.28 * max([0.2, *(float(s.of(direction).max(initial=0.0)) for *_, s in cases)]))
        axes.legend(fontsize=8.5, ncols=3, loc="upper right")
    return finish(figure, "Lights along the motorway", f"{note}; single drives: the first", path)


def lights_cases(route: RouteOutcome) -> list[tuple[str, str, LayerScore]]:
    """Return label, colour and score of the first drive without and with map, and of the integration."""
    first = [(case, drive_scores(route, case, WIDE_RADIUS_M)[0]) for case in ("without_map", "with_map")]
    colours = {"without_map": GREEN, "with_map": BLUE}
    labels = {"without_map": "without HD map", "with_map": "with HD map"}
    cases = [(labels[case], colours[case], scored) for case, scored in first]
    return [*cases, (f"{len(route.drives)} drives", MAGENTA, integrated_score(route, WIDE_RADIUS_M))]


def draw_one_light(route: RouteOutcome, note: str, path: Path) -> Path:
    """Draw Figure 11: the estimates of single drives around one light, numbered, with 95 % ellipses, and what came of
    them; along the route is to the right.
    """
    feature = _middle_light(route)
    figure = new_figure(9.6, 5.4)
    axes = figure.subplots()
    dress(axes, "along the route from the true light, m", "to the left, m")
    for number, drive in enumerate(route.drives, start=1):
        found = _of_feature(drive.with_map.xy_m, drive.with_map.cov_m2, route, feature)
        if found is not None:
            _estimate(axes, found, BLUE, "estimates of drives" if number == 1 else "")
            place = (float(found[0][0]), float(found[0][1]))
            axes.annotate(f"{number}", place, textcoords="offset points", xytext=(5, 4), fontsize=9, color=BLUE)
    layer = route.integrated[max(route.integrated)]
    found = _of_feature(layer.xy_m, layer.cov_m2, route, feature)
    if found is not None:
        _estimate(axes, found, MAGENTA, "integrated", size=9)
    axes.plot(0.0, 0.0, "*", color=RED, markersize=15, label="true light", zorder=6)
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(fontsize=9, loc="upper right")
    return finish(figure, f"Light {feature + 1}, drive by drive", f"{note}; ellipses: 95 %", path)


def _middle_light(route: RouteOutcome) -> int:
    """The light nearest to the middle of those that the integrated layer has."""
    there = integrated_score(route, WIDE_RADIUS_M).feature
    return int(there[len(there) // 2]) if len(there) else 0


def _of_feature(xy_m: F64, cov_m2: F64, route: RouteOutcome, feature: int) -> tuple[F64, F64] | None:
    """Error and covariance, along and to the left, of the estimate that is nearest to a feature; None where none is."""
    truth = route.truth
    offset = xy_m - truth.xy_m[feature]
    distance = np.linalg.norm(offset, axis=1)
    if not len(distance) or distance.min() > WIDE_RADIUS_M:
        return None
    x, y = truth.along[feature]
    R = np.array([[x, y], [-y, x]])
    index = int(distance.argmin())
    return R @ offset[index], R @ cov_m2[index] @ R.T


def _estimate(axes: Axes, found: tuple[F64, F64], colour: str, label: str, size: float = 5.0) -> None:
    offset, cov = found
    values, vectors = np.linalg.eigh(cov)
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    short, long = 2.0 * _SIGMAS_95 * np.sqrt(values)
    axes.add_patch(Ellipse((offset[0], offset[1]), long, short, angle=angle, fill=False, color=colour, alpha=0.45))
    axes.plot(offset[0], offset[1], "o", color=colour, markersize=size, label=label or None, zorder=5)


def draw_localisation(road: MotorwayOutcome, note: str, path: Path) -> Path:
    """Draw Figure 12: errors of localisation over time without and with the new layer."""
    figure = new_figure(11.0, 5.6)
    for column, axes in enumerate(figure.subplots(2, 1, sharex=True)):
        name = ("longitudinal", "lateral")[column]
        dress(axes, "seconds since the drive began" if column else "", f"{name} error, m")
        for label, colour, one in (("without layer", GREEN, road.without), ("with layer", BLUE, road.with_layer)):
            rmse = one.rmse()[column]
            axes.plot(one.t_s, one.error_m[:, column], color=colour, linewidth=1.2, label=f"{label}: RMSE {rmse:.3f} m")
        axes.axhline(0.0, color=GREY, linewidth=0.8)
        axes.margins(y=0.3)
        axes.legend(fontsize=9, loc="upper right", ncols=2)
    return finish(figure, "Localisation without and with the new layer", f"{note}, a drive that made none of it", path)
