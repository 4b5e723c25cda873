"""What a round looks like from above: classes of voxels, inserted objects, points on movers."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon
from numpy.typing import NDArray

from gnd.fleet_sim.shapes import Block
from gnd.gnd_map.classes import CLASS_COLOURS, ChangeClass
from studies.frame.figures import INK, save
from studies.real.drive import FoundVoxels
from studies.real.rounds import Placed, Round

F64 = NDArray[np.float64]

PALE: Final = {ChangeClass.NORMAL: "#b9cdf0"}
"""What did not change stays in the background."""
HIDDEN: Final = "#c9c2b2"
REACH_M: Final = 38.0
"""So much is shown around the track."""
DPI: Final = 110


def draw_round(one: Round, folder: Path) -> list[Path]:
    """Draw the untouched drive, the drive with objects (where there are some), and the segmented points; the files.

    Raises:
        SimError: a file cannot be written.
    """
    scene, name = one.scene, one.scene.name
    untouched, inserted = one.untouched, one.inserted
    count = np.bincount(untouched.found.change_class, minlength=6)
    false = ", ".join(
        f"{count[c]} {c.name.lower()}" for c in (ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED)
    )
    files = [folder / f"{name}_untouched.png", folder / f"{name}_inserted.png", folder / f"{name}_segmented.png"]
    save(_classes(one, untouched.found, (), (), f"{name}: untouched; reported {false}"), files[0])
    if inserted.new or inserted.gone:
        title = f"{name}: {len(inserted.new)} objects new, {len(inserted.gone)} gone"
        save(_classes(one, inserted.found, inserted.new, inserted.gone, title), files[1])
    else:
        files.pop(1)
    moving = untouched.sample_moving
    title = f"{name}: {moving.mean():.1%} of the points of {len(scene.scans) // 2} scans marked as moving"
    save(_points(one, untouched.sample_m, moving, title), files[-1])
    return files


def _classes(one: Round, found: FoundVoxels, new: Sequence[Placed], gone: Sequence[Placed], title: str) -> Figure:
    figure, axes = _sheet(one, title)
    hidden = np.isin(found.keys, one.inserted.truth.ignored) & found.where(*_CHANGED) & bool(new or gone)
    _add_voxels(axes, found.mean_m[hidden], HIDDEN)
    for change in (ChangeClass.NORMAL, ChangeClass.DELETED, ChangeClass.MODIFIED, ChangeClass.NEW):
        _add_voxels(axes, found.mean_m[found.where(change) & ~hidden], PALE.get(change, CLASS_COLOURS[change]))
    for placed, colour in [(p, ChangeClass.NEW) for p in new] + [(p, ChangeClass.DELETED) for p in gone]:
        axes.add_patch(_outline(placed, CLASS_COLOURS[colour]))
    handles: list[Artist] = [
        _dot(PALE.get(c, CLASS_COLOURS[c]), c.name.lower()) for c in (ChangeClass.NORMAL, *_CHANGED)
    ]
    handles += [Patch(facecolor="none", edgecolor=CLASS_COLOURS[c], linewidth=2, label=text) for c, text in _OUTLINES]
    handles.append(_dot(HIDDEN, "behind or under an object: not scored"))
    axes.legend(handles=handles if new or gone else handles[:4], loc="upper right", framealpha=0.9, fontsize=9)
    return figure


_CHANGED: Final = (ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED)
_OUTLINES: Final = ((ChangeClass.NEW, "put into the drive"), (ChangeClass.DELETED, "put into the map"))


def _points(one: Round, points_m: NDArray[np.float32], moving: NDArray[np.bool_], title: str) -> Figure:
    figure, axes = _sheet(one, title)
    low = one.scene.positions_m[:, 2].min() + 0.3  # the ground would hide everything
    for mask, colour, size in ((~moving, "#8d99a8", 0.3), (moving, CLASS_COLOURS[ChangeClass.NEW], 0.9)):
        shown = points_m[mask & (points_m[:, 2] > low)]
        axes.scatter(shown[:, 0], shown[:, 1], s=size, c=colour, linewidths=0, rasterized=True)
    handles = [_dot("#8d99a8", "stands (above the ground)"), _dot(CLASS_COLOURS[ChangeClass.NEW], "marked as moving")]
    axes.legend(handles=handles, loc="upper right", framealpha=0.9, fontsize=9)
    return figure


def _sheet(one: Round, title: str) -> tuple[Figure, Axes]:
    """An empty picture that shows the track, with equal axes."""
    track = one.scene.positions_m
    low, high = track[:, :2].min(axis=0) - REACH_M, track[:, :2].max(axis=0) + REACH_M
    width, height = high - low
    figure = Figure(
        figsize=(11.0, float(np.clip(11.0 * height / width, 5.0, 14.0)) + 0.6), dpi=DPI, layout="constrained"
    )
    axes = figure.add_subplot()
    axes.plot(track[:, 0], track[:, 1], color=INK, linewidth=1.5, marker=".", markersize=3, zorder=5)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="m", ylabel="m")
    axes.set_title(title, loc="left", color=INK)
    return figure, axes


def _add_voxels(axes: Axes, mean_m: F64, colour: str) -> None:
    size = np.full(len(mean_m), 0.8)
    axes.add_collection(
        EllipseCollection(
            size,
            size,
            np.zeros(len(mean_m)),
            units="xy",
            offsets=mean_m[:, :2],
            offset_transform=axes.transData,
            facecolors=colour,
            linewidths=0,
        )
    )


def _outline(placed: Placed, colour: str) -> Patch:
    style: dict[str, Any] = {"facecolor": "none", "edgecolor": colour, "linewidth": 2.0, "zorder": 6}
    shape = placed.shape
    if not isinstance(shape, Block):
        return Circle((shape.x_m, shape.y_m), max(shape.radius_m, 0.5), **style)
    c, s = np.cos(shape.yaw_rad), np.sin(shape.yaw_rad)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [shape.half_x_m, shape.half_y_m]
    return Polygon(corners @ np.array([[c, s], [-s, c]]) + [shape.x_m, shape.y_m], closed=True, **style)


def _dot(colour: str, label: str) -> Line2D:
    return Line2D([], [], color=colour, marker="o", linestyle="", label=label)
