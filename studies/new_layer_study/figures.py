"""Two figures of the paper on new feature layers on our routes: errors of beacons by drives (7), of lights (10)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from matplotlib.ticker import MaxNLocator

from gnd.picture_style import BLUE, GREEN, GREY, MAGENTA, ORANGE
from studies.frame.figures import dress, finish, new_figure
from studies.new_layer_study import layers as reference
from studies.new_layer_study.layers import (
    DIRECTIONS,
    WIDE_RADIUS_M,
    LayerScore,
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
    paths = [draw_integration(found, folder / "new_layer_by_drives.png")]
    for name, road in (("motorway", first.motorway), ("straight", first.straight)):
        if road is not None:
            where = f"{km:g} km of {'motorway' if name == 'motorway' else 'straight motorway'}, {note}"
            paths.append(draw_lights(road.route, where, folder / f"new_layer_lights_{name}.png"))
    return paths


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
