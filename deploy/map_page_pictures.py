"""The pictures of a map's quality page, each as bytes of a PNG."""

import io
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gnd.picture_style import BLUE, CYCLE, DPI, FAINT, INK, PAPER, RED, SMALL_PT
from gnd.vehicle_agent.localise_drive.style import dress
from gnd.vehicle_agent.map_build.build import BuiltMap
from gnd.vehicle_agent.map_build.quality import MOUNT_M, Quality

DOUBLE: Final = RED
_DRIVES: Final = tuple(one for one in CYCLE if one != DOUBLE)
_THICKEST_M: Final = 0.12
_MOST_DOTS: Final = 60_000


def map_picture(built: BuiltMap, quality: Quality) -> bytes:
    """The planes of the map from above by their thickness, the ways of the drives, doubled surfaces in red."""
    figure, axes = _figure(9.0, 6.0, "north, m")
    planes, sd = quality.plane_p_map_m, quality.plane_sd_m
    shown = np.linspace(0, max(len(planes) - 1, 0), min(len(planes), _MOST_DOTS)).astype(np.int64)
    dots = axes.scatter(
        planes[shown, 0], planes[shown, 1], c=100 * sd[shown], s=3, cmap="cividis_r", vmin=0, vmax=100 * _THICKEST_M,
        linewidths=0, rasterized=True,
    )  # fmt: skip
    figure.colorbar(dots, ax=axes, label="thickness of planes (one sd), cm", shrink=0.8)
    doubled = quality.doubled_p_map_m
    axes.scatter(doubled[:, 0], doubled[:, 1], s=10, c=DOUBLE, linewidths=0, label="doubled wall or road")
    for number, source in enumerate(built.sources):
        way = source.poses.T_dst_vehicle[:, :2, 3]
        axes.plot(way[:, 0], way[:, 1], color=_colour(number), linewidth=1.2, label=source.header.drive_id)
    axes.set_aspect("equal")
    axes.set_xlabel("east, m", color=INK)
    axes.legend(loc="upper right", fontsize=SMALL_PT, framealpha=0.9)
    return _png(figure)


def thickness_picture(quality: Quality) -> bytes:
    """How thick planes are."""
    figure, axes = _figure(6.0, 3.2, "planes")
    axes.hist(100 * quality.plane_sd_m.clip(0, _THICKEST_M), bins=48, color=BLUE)
    for share, value in zip((10, 50, 90), quality.thickness_m, strict=True):
        axes.axvline(100 * min(value, _THICKEST_M), color=INK, linewidth=1.0, linestyle=(0, (4, 3)))
        axes.text(
            100 * min(value, _THICKEST_M), 0.97, f" {share} %", transform=axes.get_xaxis_transform(), fontsize=SMALL_PT,
            color=INK, va="top",
        )  # fmt: skip
    axes.set_xlabel(f"smallest sd, cm (all beyond {100 * _THICKEST_M:.0f} in the last bar)", color=INK)
    return _png(figure)


def height_picture(built: BuiltMap, quality: Quality) -> bytes:
    """The LiDAR over the road along each way, and what the header says."""
    figure, axes = _figure(6.0, 3.2, "LiDAR over the road, m")
    for number, (survey, mount) in enumerate(zip(built.surveys, quality.mounts, strict=True)):
        seen = np.isfinite(survey.road_z_m)
        height = mount.header_m - survey.road_z_m[seen]
        axes.plot(survey.way_m[seen], height, color=_colour(number), linewidth=1.2, label=mount.drive)
        axes.axhspan(mount.header_m - MOUNT_M, mount.header_m + MOUNT_M, color=_colour(number), alpha=0.08, linewidth=0)
        axes.axhline(mount.header_m, color=_colour(number), linewidth=1.0, linestyle=(0, (4, 3)))
    axes.set_xlabel("way, m (dashed: the header's mount; band: in bounds)", color=INK)
    axes.legend(fontsize=SMALL_PT)
    return _png(figure)


def _colour(number: int) -> str:
    return _DRIVES[number % len(_DRIVES)]


def _figure(width_in: float, height_in: float, label: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width_in, height_in), dpi=DPI, facecolor=PAPER, layout="constrained")
    axes = figure.add_subplot()
    dress(axes, label)
    axes.spines["bottom"].set_color(FAINT)
    return figure, axes


def _png(figure: Figure) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format="png")
    return out.getvalue()
