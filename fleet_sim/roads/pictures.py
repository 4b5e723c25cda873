"""A route and one drive along it as a picture: the whole, a stretch with detections, what was hidden, the GNSS."""

from pathlib import Path
from typing import Any, Final

import numpy as np

from gnd.fleet_sim.roads.curve import FloatArray
from gnd.fleet_sim.roads.drive import RoadDrive
from gnd.picture_style import FAINT, FEATURE_COLOURS, GREY, INK, MUTED, ORANGE, SMALL_PT, styled, write_png

_STRETCH_M: Final = 150.0


def detection_places(drive: RoadDrive) -> tuple[FloatArray, FloatArray]:
    """Return where all detections lie, seen from the true poses, float64 (K, 2), and what each is of, int64 (K,)."""
    poses, looks = drive.truth.look_poses, drive.looks
    count = [len(look) for look in looks]
    pose = np.repeat(poses, count, axis=0)
    range_m = np.concatenate([look.range_m for look in looks]).astype(np.float64)
    angle = pose[:, 2] + np.concatenate([look.bearing_rad for look in looks])
    places = pose[:, :2] + range_m[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return places, np.concatenate(drive.truth.of_detection)


@styled
def draw_drive(drive: RoadDrive, png: Path, *, dpi: int = 75) -> None:
    """Draw a drive: the route, its most crowded stretch, the looks at each feature, the error of the GNSS."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 10), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2)
    _whole(axes[0, 0], drive)
    _stretch(axes[0, 1], drive)
    _visibility(axes[1, 0], drive)
    _gnss(axes[1, 1], drive)
    seen = int((drive.truth.looks_at > 0).sum())
    figure.suptitle(
        f"{drive.route.name}, drive {drive.seed}: {drive.route.length_m:.0f} m, {len(drive.looks)} looks,"
        f" {seen} of {len(drive.route.features)} features in sight",
        x=0.012, ha="left",
    )  # fmt: skip
    write_png(figure, png)


def _whole(ax: Any, drive: RoadDrive) -> None:
    features = drive.route.features
    ax.plot(*drive.route.line.xy_m.T, color=GREY, lw=1)
    _dots(ax, drive, features.xy_m, 14)
    ax.plot(*drive.gnss.xy_m.T, ",", color=MUTED)
    ax.set_title("route [m]; " + ", ".join(f"{len(features.rows(s))} {s}" for s in FEATURE_COLOURS))  # type: ignore[arg-type]
    ax.set_aspect("equal")
    ax.legend(loc="best", fontsize=SMALL_PT)


def _dots(ax: Any, drive: RoadDrive, xy_m: FloatArray, size: float) -> None:
    states = np.array(drive.route.features.states)
    for state, colour in FEATURE_COLOURS.items():
        rows = states == state
        if rows.any():
            ax.scatter(
                *xy_m[rows].T, s=size, color=colour, label=state, zorder=3, marker="x" if state == "deleted" else "o"
            )


def _stretch(ax: Any, drive: RoadDrive) -> None:
    """The stretch with the most features, turned along the road."""
    poses, features = drive.truth.poses, drive.route.features
    near = np.linalg.norm(features.xy_m[None] - features.xy_m[:, None], axis=2) < 0.5 * _STRETCH_M
    middle = features.xy_m[int(near.sum(axis=0).argmax())]
    pose = poses[int(np.linalg.norm(poses[:, :2] - middle, axis=1).argmin())]
    c, s = np.cos(pose[2]), np.sin(pose[2])

    def along(xy: FloatArray) -> FloatArray:
        return np.asarray((xy - pose[:2]) @ np.array([[c, -s], [s, c]]))

    for marking in drive.route.lanes():
        ax.plot(*along(marking).T, color=FAINT, lw=0.8)
    places, of = detection_places(drive)
    ax.plot(*along(places[of > 0]).T, ".", ms=2, color=ORANGE, label="detections, from true poses")
    ax.plot(*along(places[of == 0]).T, "+", ms=4, color=MUTED, label="false alarms")
    ax.plot(*along(poses[:, :2]).T, color=INK, lw=1, label="drive")
    _dots(ax, drive, along(features.xy_m), 30)
    ax.set_xlim(-_STRETCH_M / 2, _STRETCH_M / 2)
    ax.set_ylim(-30, 30)
    ax.set_title("its most crowded stretch, along the road [m]")
    ax.legend(loc="best", fontsize=SMALL_PT)


def _visibility(ax: Any, drive: RoadDrive) -> None:
    truth = drive.truth
    index = np.arange(len(drive.route.features))
    ax.bar(index, truth.in_view.sum(axis=0), color=FAINT, label="in the field of view, hidden")
    colours = [FEATURE_COLOURS[state] for state in drive.route.features.states]
    ax.bar(index, truth.looks_at, color=colours, label="in sight")
    ax.set_title("looks at each feature, or at the place of a deleted one, along the way")
    ax.set_xlabel("feature")
    ax.legend(loc="best", fontsize=SMALL_PT)


def _gnss(ax: Any, drive: RoadDrive) -> None:
    truth, gnss = drive.truth, drive.gnss
    true = np.stack([np.interp(gnss.t_ns, truth.t_ns, truth.poses[:, k]) for k in (0, 1)], axis=1)
    t_s = (gnss.t_ns - gnss.t_ns[0]) * 1e-9
    for error, name in zip((gnss.xy_m - true).T, ("east", "north"), strict=True):
        ax.plot(t_s, error, lw=0.8, label=name)
    ax.set_title("error of the GNSS [m] over time [s]")
    ax.legend(loc="best", fontsize=SMALL_PT)
