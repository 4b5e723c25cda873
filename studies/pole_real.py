"""Poles in scans of real sensors: what is found, whether the next scans find it again, and pictures of both."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F32, F64
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import transform
from gnd.picture_style import BLUE, GREEN, GREY, ORANGE, RED, SMALL_PT, styled, write_png
from gnd.schemas.drive import U32
from gnd.vehicle_agent.features.poles.detector import Pole, PoleDetector, Rays
from gnd.vehicle_agent.importer import FORMATS, no_progress
from gnd.vehicle_agent.importers.cleaning import cleaned
from gnd.vehicle_agent.importers.detect_format import format_of
from gnd.vehicle_agent.importers.lidar_odometry import lidar_odometry, reference_ns
from gnd.vehicle_agent.importers.recording import Recording

APOLLO_LIDAR_M: Final = 1.9
"""Apollo's recording has no mount: its vehicle's origin is the LiDAR, so far over the road in its scans."""
AGAIN_M: Final = 0.3
"""A pole is found again when one is found within this."""
WELL_INSIDE_M: Final = 30.0
"""Only poles so near to the vehicle in both scans are asked for again: farther ones come and go at the edge."""


@dataclass(frozen=True, slots=True, eq=False)
class RealScan:
    """A scan of a recording: its rays, and the pose T_map_vehicle (4, 4) of the road below the vehicle."""

    number: int
    rays: Rays
    T_map_vehicle: F64


@dataclass(frozen=True, slots=True)
class Stability:
    """Poles of scans, and how many of those that lay well inside the next scan it found again."""

    scans: int
    found: int
    asked: int
    again: int

    @property
    def share(self) -> float:
        """Of the poles that were asked for again."""
        return self.again / max(self.asked, 1)


def scans_of(folder: Path, first: int = 0, count: int | None = None) -> list[RealScan]:
    """Scans of a recording, moved to the map frame along its track (its own, else by LiDAR odometry).

    Raises:
        ImportDriveError: the folder holds no recording that can be read.
    """
    recording = FORMATS[format_of(folder)](folder, None)
    track = recording.track or lidar_odometry(recording, no_progress)
    last = len(recording) if count is None else min(first + count, len(recording))
    found = []
    for number in range(first, last):
        scan = cleaned(recording.read(number)).scan
        if scan is None:
            continue
        t_ns = reference_ns(scan)
        T = track.at(t_ns)
        ends, starts = (
            transform(T, _straight(points, scan.t_offset_ns, scan.t_ns, track, recording.T_vehicle_lidar, t_ns))
            for points in (scan.points_m, np.zeros_like(scan.points_m))
        )
        found.append(RealScan(number, Rays(ends, starts), _on_the_road(T, recording)))
    return found


def _on_the_road(T: F64, recording: Recording) -> F64:
    if recording.T_vehicle_lidar[2, 3] > 0.0:
        return T
    lowered = T.copy()
    lowered[2, 3] -= APOLLO_LIDAR_M
    return lowered


def _straight(points: F32, offset_ns: U32, start_ns: int, track: Trajectory, mount: F64, t_ns: int) -> F64:
    """Points in the vehicle frame at t_ns; a scan whose offsets are all zero is freed of its motion already."""
    if not np.any(offset_ns):
        return transform(mount, points.astype(np.float64))
    return deskew(points, offset_ns, start_ns, track, mount, t_ns)


def poles_of(scan: RealScan, detector: PoleDetector) -> tuple[Pole, ...]:
    """Poles of one scan, map frame."""
    return detector.window([scan.rays], scan.T_map_vehicle[:3, 3])


def stability(scans: Sequence[RealScan], detector: PoleDetector) -> Stability:
    """How many of the poles of each scan the next one finds again."""
    found = [poles_of(scan, detector) for scan in scans]
    asked = again = 0
    for here, there, scan, then in zip(found, found[1:], scans, scans[1:], strict=False):
        places = np.array([pole.xy_m for pole in there]).reshape(-1, 2)
        for pole in here:
            if max(_away(pole, scan), _away(pole, then)) <= WELL_INSIDE_M:
                asked += 1
                again += bool(len(places) and np.hypot(*(places - pole.xy_m).T).min() <= AGAIN_M)
    return Stability(len(scans), sum(map(len, found)), asked, again)


def _away(pole: Pole, scan: RealScan) -> float:
    return float(np.hypot(*(pole.xy_m - scan.T_map_vehicle[:2, 3])))


COLOURS: Final = {"pole": BLUE, "streetlight": ORANGE, "traffic_sign": RED, "trunk": GREEN}
REACH_M: Final = 42.0
SIDE_M: Final = 2.5
"""Half the width of a side view."""


@styled
def draw_poles(scan: RealScan, poles: Sequence[Pole], title: str, path: Path) -> Path:
    """Draw a scan from above, the vehicle in the middle, and side views of its nearest poles; write a PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15.0, 9.0), layout="constrained")
    grid = figure.add_gridspec(3, 8)
    _from_above(figure.add_subplot(grid[:, :5]), scan, poles, title)
    for number, pole in enumerate(poles[:9]):
        _from_the_side(figure.add_subplot(grid[number // 3, 5 + number % 3]), scan, pole, number)
    write_png(figure, path)
    return path


def _from_above(axes: Any, scan: RealScan, poles: Sequence[Pole], title: str) -> None:
    points = scan.rays.points_m - scan.T_map_vehicle[:3, 3]
    near = points[np.abs(points[:, :2]).max(axis=1) < REACH_M]
    order = np.argsort(near[:, 2])
    shown = near[order]
    axes.scatter(shown[:, 0], shown[:, 1], c=shown[:, 2], s=0.4, cmap="gray_r", vmin=-1.0, vmax=4.0, linewidths=0)
    for number, pole in enumerate(poles):
        x, y = pole.xy_m - scan.T_map_vehicle[:2, 3]
        colour = COLOURS[pole.kind]
        axes.plot(x, y, "o", mfc="none", mec=colour, ms=11, mew=1.6)
        axes.annotate(str(number), (x, y), xytext=(6, 6), textcoords="offset points", color=colour, fontsize=SMALL_PT)
    for kind, colour in COLOURS.items():
        axes.plot([], [], "o", mfc="none", mec=colour, label=kind)
    axes.plot(0.0, 0.0, "k^", ms=8)
    axes.set(xlim=(-REACH_M, REACH_M), ylim=(-REACH_M, REACH_M), aspect="equal", title=title, xlabel="m", ylabel="m")
    axes.legend(loc="upper right")


def _from_the_side(axes: Any, scan: RealScan, pole: Pole, number: int) -> None:
    """Points about a pole as the sensor sees them: across against up, those before and behind it left out."""
    toward = pole.xy_m - scan.T_map_vehicle[:2, 3]
    distance = float(np.hypot(*toward))
    toward = toward / distance
    off: F64 = scan.rays.points_m[:, :2] - pole.xy_m
    along, across = off @ toward, off @ np.array([toward[1], -toward[0]])
    height = scan.rays.points_m[:, 2] - pole.foot_z_m
    near = (np.abs(across) < SIDE_M) & (np.abs(along) < SIDE_M) & (height < 9.0)
    core = near & (np.hypot(*off.T) < 0.5 * pole.diameter_m + 0.2)
    axes.scatter(across[near], height[near], s=1.5, c=GREY, linewidths=0)
    axes.scatter(across[core], height[core], s=3.0, c=COLOURS[pole.kind], linewidths=0)
    axes.set(xlim=(-SIDE_M, SIDE_M), ylim=(-0.5, 8.0))
    kind = pole.kind.replace("_", " ")
    axes.set_title(f"{number}: {kind}, {distance:.0f} m, Ø {pole.diameter_m:.2f} m", fontsize=7.5, weight="normal")
    axes.tick_params(labelsize=6)
