"""The pictures of a localised drive; the map from above with the track on it, coloured by health."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from gnd.gnd_map.arrays import F64
from gnd.picture_style import DPI, FAINT, INK, MUTED
from gnd.vehicle_agent.localise.estimates import error_series
from gnd.vehicle_agent.localise_drive.curves import GAP_NS, draw_errors, draw_quality
from gnd.vehicle_agent.localise_drive.map_raster import COLOURS, KINDS, MapRaster
from gnd.vehicle_agent.localise_drive.run import LocalisedDrive, trajectory_of
from gnd.vehicle_agent.localise_drive.stretches import HEALTHS
from gnd.vehicle_agent.localise_drive.style import HEALTH_COLOURS, new_figure, save_figure
from gnd.vehicle_agent.tiles_at_hand import TileSource

MARGIN_M: Final = 30.0
_WIDTH_IN: Final = 12.6
_SIDE_IN: Final = 0.3
_HEAD_IN: Final = 0.95
_PANEL_IN: Final = _WIDTH_IN - 2 * _SIDE_IN
_TALL_IN: Final = (2.4, 11.0)
_NICE_M: Final = (10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000, 100_000)
_HALO: Final = [withStroke(linewidth=3.0, foreground="white")]


@dataclass(frozen=True, slots=True, eq=False)
class PictureView:
    """A rectangle of the map, turned so that the drive's longest direction lies to the right."""

    R_view_map: F64
    """(2, 2)"""
    low_m: F64
    """(2,) lower left corner, view."""
    high_m: F64
    """(2,) upper right corner."""

    @classmethod
    def around(cls, p_map_m: F64) -> "PictureView":
        """A view of positions (N, 2) with a margin; N >= 1."""
        flat = p_map_m - p_map_m.mean(axis=0)
        axis = np.linalg.eigh(flat.T @ flat)[1][:, 1]
        axis = axis if axis[0] >= 0 else -axis
        R = np.array([[axis[0], axis[1]], [-axis[1], axis[0]]])
        at = p_map_m @ R.T
        return cls(R, *_tall_enough(at.min(axis=0) - MARGIN_M, at.max(axis=0) + MARGIN_M))

    @property
    def size_m(self) -> F64:
        """(2,) width and height."""
        return self.high_m - self.low_m

    @property
    def tall_in(self) -> float:
        """Height of the panel."""
        return float(np.clip(_PANEL_IN * self.size_m[1] / self.size_m[0], *_TALL_IN))


def _tall_enough(low: F64, high: F64) -> tuple[F64, F64]:
    """The rectangle widened to what the panel can show."""
    width, height = high - low
    grow = np.maximum(0.0, [height * _PANEL_IN / _TALL_IN[1] - width, width * _TALL_IN[0] / _PANEL_IN - height])
    return low - grow / 2, high + grow / 2


def draw_pictures(drive: LocalisedDrive, tiles: TileSource, folder: Path) -> list[Path]:
    """Draw map.png, quality.png, and errors.png where there are poses and a reference; give the paths.

    Raises:
        LocaliseError: a file cannot be written.
        StoreError: a tile cannot be read again.
    """
    drawn = [draw_map(drive, tiles, folder / "map.png"), draw_quality(drive, folder / "quality.png")]
    if len(error_series(drive.online, drive.reference)):
        drawn.append(draw_errors(drive, folder / "errors.png"))
    return drawn


def draw_map(drive: LocalisedDrive, tiles: TileSource, path: Path) -> Path:
    """The Gaussians of the tiles that were used, and the refined poses on them; GNSS fixes where there are none.

    Raises:
        LocaliseError: the file cannot be written.
    """
    track, lost = trajectory_of(drive.refined).T_dst_vehicle[:, :2, 3], _lost_fixes(drive)
    view = PictureView.around(np.concatenate([track, lost if len(track) else _fixes(drive)]))
    raster = _raster(drive, tiles, view)
    figure = new_figure(_WIDTH_IN, _HEAD_IN + view.tall_in + _SIDE_IN, "The drive on the map", _note(drive, raster))
    axes = _panel(figure, view)
    extent = (view.low_m[0], view.high_m[0], view.low_m[1], view.high_m[1])
    axes.imshow(raster.image(), origin="lower", extent=extent, interpolation="antialiased", aspect="equal")
    _draw_track(axes, drive, track @ view.R_view_map.T)
    axes.plot(*(lost @ view.R_view_map.T).T, ".", color=HEALTH_COLOURS["lost"], markersize=5, zorder=5)
    axes.set(xlim=extent[:2], ylim=extent[2:])
    _scale_and_north(axes, view)
    _legend(figure, drive, has_lost=bool(len(lost)))
    save_figure(figure, path)
    return path


def _raster(drive: LocalisedDrive, tiles: TileSource, view: PictureView) -> MapRaster:
    pixel_m = float(view.size_m[0] / (_PANEL_IN * DPI))
    columns, rows = (max(1, round(float(size) / pixel_m)) for size in view.size_m)
    raster = MapRaster(
        drive.header.anchor, view.R_view_map, float(view.low_m[0]), float(view.low_m[1]), pixel_m, (rows, columns)
    )
    for tile_id in sorted(drive.used):
        tile = tiles.tile(tile_id)
        if tile is not None:
            raster.add(tile)
    return raster


def _note(drive: LocalisedDrive, raster: MapRaster) -> str:
    counts = drive.counts
    return (
        f"drive {drive.header.drive_id}, {drive.header.sensor_model}: {len(drive.refined)} of {counts.scans} scans"
        f" localised; {len(drive.used)} tiles, {raster.gaussians:,} Gaussians from above"
    )


def _panel(figure: Figure, view: PictureView) -> Axes:
    height_in = figure.get_figheight()
    axes = figure.add_axes(
        (_SIDE_IN / _WIDTH_IN, _SIDE_IN / height_in, _PANEL_IN / _WIDTH_IN, view.tall_in / height_in)
    )
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set(color=FAINT, linewidth=0.8)
    return axes


def _fixes(drive: LocalisedDrive) -> F64:
    """(N, 2) GNSS fixes in the map frame."""
    gnss = drive.gnss
    horizontal: F64 = drive.header.anchor.enu_from_geodetic(gnss.lat_rad, gnss.lon_rad, gnss.height_m)[:, :2]
    return horizontal


def _lost_fixes(drive: LocalisedDrive) -> F64:
    """(N, 2) those of the part that was driven for which there is no refined pose."""
    last_ns = drive.moments[-1].t_ns if drive.moments else drive.gnss.t_ns[-1]
    known = np.array([-(2**62), *(e.t_ns for e in drive.refined), 2**62], np.int64)
    after = np.searchsorted(known, drive.gnss.t_ns)
    away_ns = np.minimum(known[after] - drive.gnss.t_ns, drive.gnss.t_ns - known[after - 1])
    lost: F64 = _fixes(drive)[(away_ns > GAP_NS) & (drive.gnss.t_ns <= last_ns + GAP_NS)]
    return lost


def _draw_track(axes: Axes, drive: LocalisedDrive, track_m: F64) -> None:
    """Lines from pose to pose in the colour of the first one's health; a white line below sets them off."""
    if not len(track_m):
        return
    pairs = np.stack([track_m[:-1], track_m[1:]], axis=1)
    near = np.diff([e.t_ns for e in drive.refined]) <= GAP_NS
    colours = [HEALTH_COLOURS[e.health] for e in drive.refined[:-1]]
    look: dict[str, Any] = {"capstyle": "round", "zorder": 3}
    axes.add_collection(LineCollection(list(pairs[near]), colors="white", linewidths=5.5, **look))
    kept = [colour for colour, there in zip(colours, near, strict=True) if there]
    axes.add_collection(LineCollection(list(pairs[near]), colors=kept, linewidths=3.0, **look))
    _draw_ways(axes, track_m)


def _draw_ways(axes: Axes, track_m: F64) -> None:
    """A dot and a number every so many metres of the track; none where a gap passes over it."""
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(track_m, axis=0), axis=1))])
    step_m = nice_m(float(way_m[-1]) / 5)
    for mark_m in np.arange(0.0, way_m[-1], step_m):
        k = int(np.searchsorted(way_m, mark_m))
        if way_m[k] - mark_m > step_m / 10:
            continue
        axes.plot(*track_m[k], "o", color="white", markeredgecolor=INK, markersize=5.5, zorder=6)
        axes.annotate(
            f"{mark_m:g} m", track_m[k], (0, 9), textcoords="offset points", ha="center", fontsize=9,
            color=INK, path_effects=_HALO, zorder=7,
        )  # fmt: skip


def nice_m(length_m: float) -> int:
    """The round length nearest to this one, by ratio."""
    return min(_NICE_M, key=lambda nice: abs(np.log(nice / max(length_m, 1.0))))


def _scale_and_north(axes: Axes, view: PictureView) -> None:
    width, height = view.size_m
    length = nice_m(float(width) / 12)
    x, y = view.low_m + np.array([0.02 * width, 0.06 * height])
    axes.plot([x, x + length], [y, y], color=INK, linewidth=2.5, solid_capstyle="butt", path_effects=_HALO)
    place: dict[str, Any] = {"ha": "center", "va": "bottom", "color": INK, "path_effects": _HALO}
    axes.text(x + length / 2, y + 0.015 * height, f"{length:g} m", **place)
    inch_m = float(width) / _PANEL_IN
    end = 0.22 * inch_m * (view.R_view_map @ np.array([0.0, 1.0]))
    middle = np.array([view.high_m[0] - 0.5 * inch_m, view.low_m[1] + 0.5 * inch_m])
    arrow = {"arrowstyle": "-|>", "color": INK, "linewidth": 1.6}
    axes.annotate("", tuple(middle + end), tuple(middle - end), arrowprops=arrow)
    x, y = (middle + 1.5 * end).tolist()
    axes.text(x, y, "N", **(place | {"va": "center", "fontsize": 9}))


def _legend(figure: Figure, drive: LocalisedDrive, *, has_lost: bool) -> None:
    there = {estimate.health for estimate in drive.refined}
    handles: list[Any] = [Patch(color=tuple(c), label=name) for name, c in zip(KINDS, COLOURS.tolist(), strict=True)]
    handles += [
        Line2D([], [], color=HEALTH_COLOURS[health], linewidth=3, label=f"health: {health}")
        for health in HEALTHS
        if health in there
    ]
    if has_lost:
        dot: dict[str, Any] = {"marker": ".", "linestyle": "", "markersize": 9, "color": HEALTH_COLOURS["lost"]}
        handles.append(Line2D([], [], label="no final pose: GNSS", **dot))
    figure.legend(
        handles=handles, loc="upper right", bbox_to_anchor=(1 - _SIDE_IN / _WIDTH_IN, 1 - 0.1 / figure.get_figheight()),
        ncols=len(handles), frameon=False, fontsize=10, labelcolor=MUTED, columnspacing=1.3, handlelength=1.4,
    )  # fmt: skip
