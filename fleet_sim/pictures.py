"""Pictures of a map as coloured ellipsoids, as in Figure 16 of the GND paper: from above, and in perspective."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import ceil
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from gnd.fleet_sim.ellipsoids import Ellipsoids, Tiles, ellipsoids_of_maps, ellipsoids_of_truth
from gnd.fleet_sim.errors import SimError
from gnd.fleet_sim.truth import Truth
from gnd.gnd_map.classes import ChangeClass
from gnd.picture_style import INK, LABEL_PT, MUTED, NOTE_PT, PAPER, SAFE_COLOURS, SMALL_PT, TITLE_PT, write_png

FloatArray = NDArray[np.float64]
Colours = Mapping[ChangeClass, str]

_DPI: Final = 150
_SIGMAS: Final = 1.9
"""Drawn size: an evenly filled plane across a 1 m voxel just reaches the neighbouring voxel's."""
_SHOWN: Final = (ChangeClass.NORMAL, ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED)
_SUN: Final = np.array([-0.35, -0.5, 0.79])
_SKY: Final = "#e9eef5"
_HALF_WIDTH_M: Final = 24.0
_NEAR_M: Final = 4.0
_FOCAL: Final = 1.75
_HALO: Final = [withStroke(linewidth=3.0, foreground=PAPER)]
_WIDTH_IN: Final = 12.6
_MARGIN_IN: Final = 0.378
_PANEL_IN: Final = 0.94 * _WIDTH_IN
_HEAD_IN: Final = 0.924
_ROW_IN: Final = 2.646
_PERSPECTIVE_IN: Final = 4.494
_GAP_IN: Final = 0.126
_FOOT_IN: Final = 0.21
_LONGEST_ROW_M: Final = 260.0
"""A longer street is shown from above in several rows."""
_ARROW: Final = {"arrowstyle": "-|>", "color": INK, "linewidth": 1.6}


@dataclass(frozen=True, slots=True)
class StreetView:
    """How the pictures look at the map: along the street, whatever its heading.

    Attributes:
        origin_m: middle of what is shown, map frame (3,).
        heading_rad: direction of the street, counter-clockwise from east.
        half_length_m: what is shown reaches so far along the street from the middle.
        focus_m: place along the street, from the middle, at which the perspective looks.
    """

    origin_m: tuple[float, float, float]
    heading_rad: float
    half_length_m: float
    focus_m: float

    @staticmethod
    def around(ellipsoids: Ellipsoids) -> "StreetView":
        """Return a view that fits a map: its longest horizontal axis is the street, the focus is on changes."""
        if not len(ellipsoids):
            return StreetView((0.0, 0.0, 0.0), 0.0, 50.0, 0.0)
        middle = np.median(ellipsoids.mean_m, axis=0)
        flat = ellipsoids.mean_m[:, :2] - middle[:2]
        axis = np.linalg.eigh(flat.T @ flat)[1][:, 1]
        axis = axis if axis[0] >= 0 else -axis
        reach = float(np.quantile(np.abs(flat @ axis), 0.97))
        changed = (flat @ axis)[ellipsoids.change_class != ChangeClass.NORMAL]
        focus = float(np.median(changed)) if len(changed) else 0.0
        return StreetView(tuple(middle.tolist()), float(np.arctan2(axis[1], axis[0])), max(reach, 20.0), focus)

    def rows(self) -> "list[StreetView]":
        """Return views of equal stretches, none longer than a row of the picture, in order along the street."""
        count = max(1, ceil(2 * self.half_length_m / _LONGEST_ROW_M))
        half = self.half_length_m / count
        along = self.R_view_map.T @ np.array([1.0, 0.0, 0.0])
        middles = np.array(self.origin_m) + np.outer((2 * np.arange(count) + 1 - count) * half, along)
        return [replace(self, origin_m=(x, y, z), half_length_m=half) for x, y, z in middles.tolist()]

    @property
    def R_view_map(self) -> FloatArray:
        """Rotation (3, 3) from the map frame to x along the street, y to the left, z up."""
        c, s = np.cos(self.heading_rad), np.sin(self.heading_rad)
        return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def draw_map(
    ellipsoids: Ellipsoids, path: Path, title: str, note: str = "", view: StreetView | None = None, dpi: int = _DPI
) -> None:
    """Draw `map_figure` as one PNG.

    Raises:
        SimError: the file cannot be written.
    """
    save_figure(map_figure(ellipsoids, title, note, view, dpi), path)


def map_figure(
    ellipsoids: Ellipsoids,
    title: str,
    note: str = "",
    view: StreetView | None = None,
    dpi: int = _DPI,
    colours: Colours = SAFE_COLOURS,
) -> Figure:
    """Draw a map from above and in perspective, with legend and scale.

    At 150 dots an inch it has 1890 x 1260 pixels; a street of more than 260 m is shown from above in several rows, each
    of which adds 415.

    Args:
        ellipsoids: what to draw.
        title: heading of the picture.
        note: small line below the heading.
        view: the same view for several pictures makes them comparable; by default it is fitted.
        dpi: dots an inch; the picture is 12.6 inches wide.
        colours: of the classes.
    """
    view = view or StreetView.around(ellipsoids)
    rows = view.rows()
    height_in = _HEAD_IN + len(rows) * (_ROW_IN + _GAP_IN) + _PERSPECTIVE_IN + _FOOT_IN
    figure = Figure(figsize=(_WIDTH_IN, height_in), dpi=dpi, facecolor=PAPER)
    figure.text(0.03, 1.0 - 0.361 / height_in, title, fontsize=TITLE_PT, weight="bold", color=INK, va="center")
    figure.text(0.03, 1.0 - 0.655 / height_in, note, fontsize=NOTE_PT, color=MUTED, va="center")
    _legend(figure, 1.0 - 0.353 / height_in, ellipsoids, colours)
    for index, row in enumerate(rows):
        bottom_in = height_in - _HEAD_IN - (index + 1) * _ROW_IN - index * _GAP_IN
        _from_above(_panel(figure, bottom_in, _ROW_IN), ellipsoids, row, colours)
    _in_perspective(_panel(figure, _FOOT_IN, _PERSPECTIVE_IN), ellipsoids, view, colours)
    return figure


def _panel(figure: Figure, bottom_in: float, tall_in: float) -> Axes:
    """Axes as wide as the figure allows, placed in inches."""
    height_in = figure.get_figheight()
    return figure.add_axes((_MARGIN_IN / _WIDTH_IN, bottom_in / height_in, _PANEL_IN / _WIDTH_IN, tall_in / height_in))


def draw_run(truth: Truth, base: Tiles, final: Tiles, folder: Path) -> tuple[Path, Path, Path]:
    """Draw map_before.png, map_after.png and truth.png of a run in one view.

    Args:
        truth: of the world.
        base: the map at the start.
        final: the map at the end.
        folder: where the pictures go.

    Returns:
        The three paths.

    Raises:
        SimError: a file cannot be written.
    """
    true = ellipsoids_of_truth(truth)
    view = StreetView.around(true)
    paths = folder / "map_before.png", folder / "map_after.png", folder / "truth.png"
    draw_map(ellipsoids_of_maps(truth.frame, base), paths[0], "Map before", "what every vehicle starts with", view)
    note = "what the fleet has made of it, coloured by what it changed"
    draw_map(ellipsoids_of_maps(truth.frame, base, final), paths[1], "Map after", note, view)
    draw_map(true, paths[2], "Truth", "what really changed", view)
    return paths


def draw_healing(truth: Truth, base: Tiles, final: Tiles, path: Path) -> None:
    """Draw the map before, the map after and the truth from above, one below the other, as one PNG.

    Args:
        truth: of the world.
        base: the map at the start.
        final: the map at the end.
        path: the PNG to write.

    Raises:
        SimError: the file cannot be written.
    """
    true = ellipsoids_of_truth(truth)
    view = StreetView.around(true)
    panels = (
        ("Map before", ellipsoids_of_maps(truth.frame, base)),
        ("Map after", ellipsoids_of_maps(truth.frame, base, final)),
        ("Truth", true),
    )
    figure = Figure(figsize=(12.6, 9.6), dpi=_DPI // 2, facecolor=PAPER)
    _legend(figure, 0.958)
    for row, (title, ellipsoids) in enumerate(panels):
        figure.text(0.03, 0.957 - 0.315 * row, title, fontsize=TITLE_PT, weight="bold", color=INK, va="center")
        _from_above(figure.add_axes((0.03, 0.667 - 0.315 * row, 0.94, 0.27)), ellipsoids, view)
    save_figure(figure, path)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG; the file appears complete or not at all.

    Raises:
        SimError: it cannot be written.
    """
    try:
        write_png(figure, path)
    except OSError as error:
        raise SimError(f"cannot write the picture {path}: {error}") from error


def _legend(
    figure: Figure, height: float, ellipsoids: Ellipsoids | None = None, colours: Colours = SAFE_COLOURS
) -> None:
    """The colours, with the number of ellipsoids of each where they are given."""
    number = ["" for _ in ChangeClass]
    if ellipsoids is not None:
        count = np.bincount(ellipsoids.change_class, minlength=len(ChangeClass))
        number = [f"  {n:,}" for n in count.tolist()]
    dot: dict[str, Any] = {"marker": "o", "linestyle": "", "markersize": 9}
    handles = [Line2D([], [], color=colours[c], label=f"{c.name.lower()}{number[c]}", **dot) for c in _SHOWN]
    figure.legend(
        handles=handles, loc="center right", bbox_to_anchor=(0.978, height), ncols=4, frameon=False, fontsize=LABEL_PT,
        handletextpad=0.2, columnspacing=1.4, labelcolor=INK,
    )  # fmt: skip


def _from_above(axes: Axes, ellipsoids: Ellipsoids, view: StreetView, palette: Colours = SAFE_COLOURS) -> None:
    R = view.R_view_map
    mean, cov = (ellipsoids.mean_m - np.array(view.origin_m)) @ R.T, R @ ellipsoids.cov_m2 @ R.T
    inside = np.flatnonzero((np.abs(mean[:, 0]) < view.half_length_m) & (np.abs(mean[:, 1]) < _HALF_WIDTH_M))
    order = inside[np.argsort(mean[inside, 2], kind="stable")]
    colours = shaded(cov[order], ellipsoids.change_class[order], np.array([0.0, 0.0, 1.0]), palette)
    add_ellipses(axes, mean[order, :2], cov[order, :2, :2], colours)
    half_width = view.half_length_m * _ROW_IN / _PANEL_IN
    axes.set(xlim=(-view.half_length_m, view.half_length_m), ylim=(-half_width, half_width), aspect="equal")
    _frame(axes, PAPER)
    _scale_bar(axes, view, half_width)
    _north(axes, view, half_width)


def _in_perspective(axes: Axes, ellipsoids: Ellipsoids, view: StreetView, palette: Colours) -> None:
    """Ellipsoids seen from above one end of the street; outlines are covariances through the projection's Jacobian."""
    eye, target = np.array([view.focus_m - 66.0, -13.0, 33.0]), np.array([view.focus_m + 2.0, 1.0, 0.0])
    R = _looking(eye, target) @ view.R_view_map
    p = (ellipsoids.mean_m - np.array(view.origin_m)) @ R.T - _looking(eye, target) @ eye
    order = np.flatnonzero(p[:, 2] > _NEAR_M)
    order = order[np.argsort(-p[order, 2], kind="stable")]
    p, cov = p[order], R @ ellipsoids.cov_m2[order] @ R.T
    centre = _FOCAL * p[:, :2] / p[:, 2:]
    J = np.zeros((len(p), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = _FOCAL / p[:, 2]
    J[:, :, 2] = -centre / p[:, 2:]
    colours = shaded(cov, ellipsoids.change_class[order], R @ view.R_view_map.T @ _SUN, palette)
    haze = np.clip((p[:, 2:] - 60.0) / 260.0, 0.0, 0.55)
    add_ellipses(axes, centre, J @ cov @ np.swapaxes(J, 1, 2), colours * (1 - haze) + np.array(to_rgb(_SKY)) * haze)
    tall = _PERSPECTIVE_IN / _PANEL_IN
    axes.set(xlim=(-1.0, 1.0), ylim=(-tall, tall), aspect="equal")
    _frame(axes, _SKY)


def _looking(eye: FloatArray, target: FloatArray) -> FloatArray:
    """Rotation (3, 3) to x right, y up, z forward of a camera without roll."""
    forward: FloatArray = (target - eye) / np.linalg.norm(target - eye)
    right: FloatArray = np.cross(forward, [0.0, 0.0, 1.0]) / np.hypot(forward[0], forward[1])
    rows: FloatArray = np.stack([right, np.cross(right, forward), forward])
    return rows


def shaded(
    cov: FloatArray, change_class: NDArray[np.uint8], sun: FloatArray, palette: Colours = SAFE_COLOURS
) -> FloatArray:
    """Colours (N, 3): the class's, lighter where the flat side of the ellipsoid faces the sun."""
    base: FloatArray = np.array([to_rgb(palette[c]) for c in ChangeClass])[change_class]
    if not len(cov):
        return base
    values, axes = np.linalg.eigh(cov)
    flat = np.clip(1.0 - values[:, 0] / np.maximum(values[:, 1], 1e-9), 0.0, 1.0)
    light = np.abs(np.einsum("ni,i->n", axes[:, :, 0], sun))
    shade = (0.62 + 0.5 * (flat * light + (1.0 - flat) * 0.5))[:, None]
    lit = np.where(shade <= 1.0, base * shade, base + (1.0 - base) * (shade - 1.0) * 2.2)
    return np.asarray(np.clip(lit, 0.0, 1.0))


def add_ellipses(axes: Axes, centre: FloatArray, cov: FloatArray, colours: FloatArray) -> None:
    """Draw N ellipses of covariances (N, 2, 2), the first one lowest."""
    if not len(centre):
        return
    values, vectors = np.linalg.eigh(cov + 1e-12 * np.eye(2))
    size = 2 * _SIGMAS * np.sqrt(np.maximum(values, 0.0))
    angle = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    place: dict[str, Any] = {"units": "xy", "offsets": centre, "offset_transform": axes.transData}
    look: dict[str, Any] = {"facecolors": colours, "edgecolors": colours * 0.72, "linewidths": 0.15}
    axes.add_collection(EllipseCollection(size[:, 1], size[:, 0], angle, **place, **look))


def _frame(axes: Axes, background: str) -> None:
    axes.set_facecolor(background)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set(color="#c3ccd8", linewidth=0.8)


def _scale_bar(axes: Axes, view: StreetView, half_width: float) -> None:
    length = 20.0 if view.half_length_m > 40 else 10.0
    x, y = -view.half_length_m + 0.025 * 2 * view.half_length_m, -half_width * 0.84
    axes.plot([x, x + length], [y, y], color=INK, linewidth=2.5, solid_capstyle="butt")
    place: dict[str, Any] = {"ha": "center", "va": "bottom", "color": INK, "path_effects": _HALO}
    axes.text(x + length / 2, y + half_width * 0.045, f"{length:.0f} m", **place)


def _north(axes: Axes, view: StreetView, half_width: float) -> None:
    size, x, y = half_width * 0.26, view.half_length_m * 0.965, -half_width * 0.72
    direction = view.R_view_map @ np.array([0.0, 1.0, 0.0])
    end = size / 2 * direction[:2]
    axes.annotate("", (x + end[0], y + end[1]), (x - end[0], y - end[1]), arrowprops=_ARROW)
    place: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": SMALL_PT, "color": INK, "path_effects": _HALO}
    axes.text(x + 1.35 * end[0], y + 1.35 * end[1], "N", **place)
