"""Paint on a real street: KITTI's reflectance, odd scans against even ones, and a picture.

There is no truth of the paint. What can be said: whether the same lines are found by scans that share none of their
points, and how far apart across. Both halves have the same poses and the same sensor: what these are off by is not in
it.
"""

import lzma
from collections.abc import Sequence
from dataclasses import dataclass
from math import radians
from pathlib import Path
from typing import Any, Final

import numpy as np

from gnd.fleet_sim.markings import FloatArray
from gnd.gnd_map.features.lane_pieces import beside
from gnd.gnd_map.geodesy import LocalFrame
from gnd.picture_style import BLUE, GREY, ORANGE
from gnd.vehicle_agent.features.lanes.lane_mapper import DrivenBorder, LaneMapper
from gnd.vehicle_agent.features.lanes.paint import PaintLook, paint_look
from studies.frame.errors import RealDataError
from studies.frame.figures import dress, finish, new_figure

_MOUNT_M: Final = 1.73
"""KITTI's LiDAR above the road."""
_T_CAMERA_LIDAR: Final = np.array([
    [4.276802385584e-04, -9.999672484946e-01, -8.084491683471e-03, -1.198459927713e-02],
    [-7.210626507497e-03, 8.081198471645e-03, -9.999413164504e-01, -5.403984729748e-02],
    [9.999738645903e-01, 4.859485810390e-04, -7.206933692422e-03, -2.921968648686e-01],
    [0.0, 0.0, 0.0, 1.0],
])  # fmt: skip
"""Calibration of the recordings of 2011-10-03."""


@dataclass(frozen=True, slots=True, eq=False)
class RealPaint:
    """What the scans of a recording show, each with its pose.

    Attributes:
        looks: one a scan.
        T_map_vehicle: (K, 4, 4), x ahead, y left, z up, the first is the origin.
    """

    looks: tuple[PaintLook, ...]
    T_map_vehicle: FloatArray


def kitti_paint(folder: Path) -> RealPaint:
    """Find paint in the scans `velodyne_xz/*.bin.xz` (float32 x, y, z, reflectance) with poses `KITTI_00_gt.txt`.

    Raises:
        RealDataError: the folder holds no such scans, or fewer poses than scans.
    """
    paths = sorted((folder / "velodyne_xz").glob("*.bin.xz"))
    poses_file = folder / "KITTI_00_gt.txt"
    if not paths or not poses_file.is_file():
        raise RealDataError(f"{folder}: {len(paths)} scans velodyne_xz/*.bin.xz; needed with {poses_file.name}")
    rows = np.loadtxt(poses_file).reshape(-1, 3, 4)
    if len(rows) < len(paths):
        raise RealDataError(f"{poses_file}: {len(rows)} poses of {len(paths)} scans")
    T_map_camera = np.tile(np.eye(4), (len(paths), 1, 1))
    T_map_camera[:, :3] = rows[: len(paths)]
    T = np.linalg.inv(_T_CAMERA_LIDAR) @ np.linalg.inv(T_map_camera[0]) @ T_map_camera @ _T_CAMERA_LIDAR
    return RealPaint(tuple(_look(path) for path in paths), T)


def _look(path: Path) -> PaintLook:
    rows = np.frombuffer(lzma.decompress(path.read_bytes()), np.float32).reshape(-1, 4).astype(np.float64)
    return paint_look(rows[:, :3] + np.array([0.0, 0.0, _MOUNT_M]), rows[:, 3], None)


def repeatability(paint: RealPaint) -> tuple[dict[str, Any], list[DrivenBorder], list[DrivenBorder]]:
    """Borders from even and from odd scans, how many answer to each other, and how far apart they lie across."""
    frame = LocalFrame(radians(49.0), radians(8.4), 100.0)
    even, odd = (_borders(frame, paint, first) for first in (0, 1))
    pairs = [_off(one, odd) for one in even]
    off = np.abs([one for one in pairs if one is not None])
    found = {
        "even": len(even),
        "odd": len(odd),
        "in_both": len(off),
        "apart_m_p50": round(float(np.quantile(off, 0.5)), 4) if len(off) else None,
        "apart_m_p95": round(float(np.quantile(off, 0.95)), 4) if len(off) else None,
        "sigma_m": round(float(np.median([one.sigma_m for one in (*even, *odd)])), 4) if even or odd else None,
        "way_m": round(float(np.linalg.norm(paint.T_map_vehicle[-1, :3, 3])), 1),
        "runs": sum(len(look.runs_m) for look in paint.looks),
    }
    return found, even, odd


def _borders(frame: LocalFrame, paint: RealPaint, first: int) -> list[DrivenBorder]:
    mapper = LaneMapper(frame, 0.0)
    T = paint.T_map_vehicle
    ahead = np.eye(4)
    for back_m in (-12.0, -6.0):  # the way goes on straight at both ends, so that windows reach over what was seen
        ahead[0, 3] = back_m
        mapper.see_paint(_nothing(), T[0] @ ahead)
    for number in range(first, len(paint.looks), 2):
        mapper.see_paint(paint.looks[number], T[number])
    for on_m in (6.0, 12.0, 18.0):
        ahead[0, 3] = on_m
        mapper.see_paint(_nothing(), T[-1] @ ahead)
    return mapper.borders()


def _nothing() -> PaintLook:
    return PaintLook(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))


def _off(one: DrivenBorder, others: Sequence[DrivenBorder]) -> float | None:
    near = (beside(one.piece.points_m, other.piece.points_m) for other in others if other.piece.tile == one.piece.tile)
    off = [lateral for overlap, lateral in near if overlap >= 0.5 and abs(lateral) < 0.25]
    return min(off, key=abs) if off else None


def draw_real(paint: RealPaint, even: Sequence[DrivenBorder], odd: Sequence[DrivenBorder], path: Path) -> Path:
    """Draw the runs of paint from above, and the borders of both halves."""
    frame = LocalFrame(radians(49.0), radians(8.4), 100.0)
    figure = new_figure(11.0, 7.0)
    axes = figure.subplots()
    dress(axes, "x, m", "y, m")
    runs = np.concatenate([
        look.runs_m @ T[:3, :3].T + T[:3, 3] for look, T in zip(paint.looks, paint.T_map_vehicle, strict=True)
    ])  # fmt: skip
    axes.plot(runs[:, 0], runs[:, 1], ".", color=GREY, markersize=2, label="bright runs")
    for some, colour, label in ((even, BLUE, "even scans"), (odd, ORANGE, "odd scans")):
        for k, one in enumerate(some):
            T = frame.T_self_other(LocalFrame.of_tile(one.piece.tile))
            ends = one.piece.points_m @ T[:3, :3].T + T[:3, 3]
            axes.plot(ends[:, 0], ends[:, 1], color=colour, linewidth=2, label=None if k else label)
    axes.set_aspect("equal")
    axes.legend(fontsize=9)
    return finish(figure, "Paint by reflectance, KITTI 00, 16 scans", "odd scans against even ones", path)
