"""The pictures of a report as bytes of PNGs: the whole map in three states, and each change before and after."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from gnd.deploy.map_export.changes import Change
from gnd.deploy.report.finished_run import FinishedRun
from gnd.fleet_sim.ellipsoids import Ellipsoids, Tiles, ellipsoids_of_maps, ellipsoids_of_truth
from gnd.fleet_sim.pictures import StreetView, add_ellipses, map_figure, shaded
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.geodesy import LocalFrame
from gnd.picture_style import BLUE, FAINT, GRID, INK, SAFE_COLOURS

_MAP_DPI: Final = 100
_PATCH_DPI: Final = 110
_PATCH_IN: Final = 2.4
_MARGIN_M: Final = 3.0
_LEAST_HALF_M: Final = 5.0
_MOST_HALF_M: Final = 40.0
_ELEVATION_RAD: Final = np.radians(38.0)
_SUN: Final = np.array([-0.35, -0.5, 0.79])
_HALO: Final = [withStroke(linewidth=2.5, foreground="white")]


@dataclass(frozen=True, slots=True)
class MapStates:
    """The map of a run in one frame.

    Attributes:
        frame: of all three.
        before: base map; what is deleted or modified in the newest one has the class of that.
        after: newest map with what the run has changed.
        truth: of the simulated world, None without.
    """

    frame: LocalFrame
    before: Ellipsoids
    after: Ellipsoids
    truth: Ellipsoids | None


def map_states(run: FinishedRun) -> MapStates | None:
    """The states of a run's map; None where it has no tiles."""
    base = {one.tile.tile: one.before for one in run.tiles}
    final = {one.tile.tile: one.after for one in run.tiles}
    if not final:
        return None
    frame = run.truth.frame if run.truth is not None else LocalFrame.of_tile(sorted(final)[len(final) // 2])
    true = None if run.truth is None else ellipsoids_of_truth(run.truth)
    return MapStates(frame, _before(frame, base, final), ellipsoids_of_maps(frame, base, final), true)


def _before(frame: LocalFrame, base: Tiles, final: Tiles) -> Ellipsoids:
    """The base map with the classes of what became of it: what is new on the way back was deleted on the way there."""
    back = ellipsoids_of_maps(frame, final, base)
    there = back.change_class != ChangeClass.DELETED
    change_class = back.change_class[there].copy()
    change_class[change_class == ChangeClass.NEW] = ChangeClass.DELETED
    return Ellipsoids(back.mean_m[there], back.cov_m2[there], change_class)


def map_pictures(states: MapStates) -> list[tuple[str, bytes]]:
    """Before, after and, where it is known, truth: caption and PNG, all in one view."""
    view = StreetView.around(states.after if states.truth is None else states.truth)
    shown = [
        ("Map before", "coloured by what became of it", states.before),
        ("Map after", "coloured by what the vehicles changed", states.after),
    ]
    if states.truth is not None:
        shown.append(("Truth", "what really changed", states.truth))
    return [(f"{title}: {note}", _png(map_figure(one, title, note, view, _MAP_DPI))) for title, note, one in shown]


@dataclass(frozen=True, slots=True)
class PatchView:
    """Looks at one change from above at an angle, its longer side across the picture.

    Attributes:
        middle_m: middle of the change, map frame (3,).
        R_view_map: rotation (3, 3) from the map frame to x across, y up the picture, z towards the eye.
        half_m: half the width of the picture.
    """

    middle_m: F64
    R_view_map: F64
    half_m: float

    @staticmethod
    def of(change: Change, frame: LocalFrame) -> "PatchView":
        """The view of a change."""
        lat, lon = np.radians(change.lat_deg), np.radians(change.lon_deg)
        foot = frame.enu_from_geodetic(np.array([lat]), np.array([lon]), np.array([change.height_m]))[0]
        azimuth = np.pi / 2 - np.radians(change.bearing_deg)  # of the longer side, counter-clockwise from east
        across = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        if across[0] < 0:
            across = -across  # seen from the south
        back = np.array([across[1], -across[0], 0.0])  # towards the eye, horizontally
        sine, cosine = np.sin(_ELEVATION_RAD), np.cos(_ELEVATION_RAD)
        towards = cosine * back + np.array([0.0, 0.0, sine])
        up = np.cross(towards, across)
        reach = max(change.length_m, change.width_m * sine + change.tall_m * cosine) / 2 + _MARGIN_M
        half = float(np.clip(reach, _LEAST_HALF_M, _MOST_HALF_M))
        return PatchView(foot + np.array([0.0, 0.0, change.tall_m / 2]), np.stack([across, up, towards]), half)


def change_picture(change: Change, states: MapStates) -> bytes:
    """A change before and after, and as it is in truth where that is known, side by side, as a PNG."""
    view = PatchView.of(change, states.frame)
    panels: list[tuple[str, Ellipsoids]] = [("before", states.before), ("after", _standing(states.after))]
    if states.truth is not None:
        panels.append(("truth", _standing(states.truth)))
    figure = Figure(figsize=(_PATCH_IN * len(panels), _PATCH_IN + 0.2), dpi=_PATCH_DPI, facecolor="white")
    for number, (title, one) in enumerate(panels):
        axes = figure.add_axes((number / len(panels) + 0.004, 0.01, 1 / len(panels) - 0.008, 0.9))
        _draw_patch(axes, one, view)
        axes.set_title(title, fontsize=9, color=INK, pad=3)
    return _png(figure)


def _standing(ellipsoids: Ellipsoids) -> Ellipsoids:
    """Without what is gone."""
    keep = ellipsoids.change_class != ChangeClass.DELETED
    return Ellipsoids(ellipsoids.mean_m[keep], ellipsoids.cov_m2[keep], ellipsoids.change_class[keep])


def _draw_patch(axes: Axes, ellipsoids: Ellipsoids, view: PatchView) -> None:
    R = view.R_view_map
    place = (ellipsoids.mean_m - view.middle_m) @ R.T
    order = np.flatnonzero((np.abs(place[:, :2]) < view.half_m + 1.0).all(axis=1) & (np.abs(place[:, 2]) < 60.0))
    order = order[np.argsort(place[order, 2], kind="stable")]
    cov = R @ ellipsoids.cov_m2[order] @ R.T
    colours = shaded(cov, ellipsoids.change_class[order], R @ _SUN, SAFE_COLOURS)
    add_ellipses(axes, place[order, :2], cov[:, :2, :2], colours)
    axes.set(xlim=(-view.half_m, view.half_m), ylim=(-view.half_m, view.half_m), aspect="equal", xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set(color=FAINT, linewidth=0.8)
    _scale(axes, view.half_m)


def _scale(axes: Axes, half_m: float) -> None:
    length = next((one for one in (20.0, 10.0, 5.0) if one < 0.8 * half_m), 2.0)
    x, y = -0.93 * half_m, -0.93 * half_m
    axes.plot([x, x + length], [y, y], color=INK, linewidth=2.0, solid_capstyle="butt")
    place: dict[str, Any] = {"ha": "left", "va": "bottom", "fontsize": 7, "color": INK, "path_effects": _HALO}
    axes.text(x, y + 0.03 * half_m, f"{length:g} m", **place)


def errors_picture(vehicles: Sequence[tuple[F64, F64, F64]]) -> bytes:
    """Errors along and across the way over time, a curve a vehicle.

    Args:
        vehicles: time of the drive (N,) s, error along (N,) m, error across (N,) m.
    """
    figure = Figure(figsize=(9.0, 3.6), dpi=_MAP_DPI, facecolor="white", layout="constrained")
    for row, label in enumerate(("along, cm", "across, cm")):
        axes = figure.add_subplot(2, 1, row + 1)
        for t_s, *errors in vehicles:
            axes.plot(t_s, 100 * errors[row], linewidth=0.8, color=BLUE, alpha=0.6)
        axes.set_ylabel(label, color=INK, fontsize=9)
        axes.grid(color=GRID, linewidth=0.8)
        axes.tick_params(colors=INK, labelsize=8)
        for name, spine in axes.spines.items():
            spine.set(visible=name in ("left", "bottom"), color=FAINT)
    axes.set_xlabel("time of the drive, s", color=INK, fontsize=9)
    return _png(figure)


def _png(figure: Figure) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format="png")
    return out.getvalue()
