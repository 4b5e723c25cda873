"""Maps from above with tracks, and what tracks are off by."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse
from gnd.picture_style import CYCLE, FAINT, GRID, INK, styled
from gnd.vehicle_agent.localise import PoseEstimate
from gnd.vehicle_agent.localise.georeference import Georeferenced
from studies.frame.figures import save
from studies.real.scene import RecordedScans
from studies.real_localisation.flexmap import DrawnFlexmap
from studies.real_localisation.halves import METHODS, Half, localised
from studies.real_localisation.odometry import OdometryResult

F64 = NDArray[np.float64]


@styled
def draw_halves(
    recorded: RecordedScans, tracks: Sequence[OdometryResult], halves: Sequence[Half], folder: Path
) -> list[Path]:
    """The map of the interleaved half with all odometries and the localised poses, and what these are off by."""
    half = halves[0]
    figure = Figure(figsize=(15.0, 8.0), layout="constrained")
    above, errors = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
    _map_above(above, half)
    known = [(one.name, one.track) for one in tracks if one.track is not None]
    first = half.scene.poses.T_dst_vehicle[0]
    for colour, (name, track) in zip(CYCLE, known, strict=False):
        p = (first @ track.T_dst_vehicle)[:, :3, 3]
        above.plot(p[:, 0], p[:, 1], "-", color=colour, lw=1.3, label=name)
    for (method, parameters), marker in zip(METHODS.items(), ("o", "x"), strict=False):
        estimates = localised(half, 0, parameters).estimates
        _errors_of(errors, estimates, half.scene.poses, method.replace("_", " "), marker)
        p = np.array([e.T_map_vehicle[:3, 3] for e in estimates]).reshape(-1, 3)
        above.plot(p[:, 0], p[:, 1], marker, color=INK, ms=4, mfc="none", label=f"localised {method.replace('_', ' ')}")
    above.legend(loc="best")
    above.set_title(f"{recorded.name}: {half.name}")
    return [save(figure, folder / f"{recorded.name}_localised.png")]


def _map_above(axes: Axes, half: Half) -> None:
    """Gaussians of the map around the track as points, the higher the darker."""
    p, track = half.local_map.mean_map_m, half.scene.positions_m
    axes.scatter(p[:, 0], p[:, 1], s=2.0, c=p[:, 2], cmap="Greys", vmin=float(np.quantile(p[:, 2], 0.02)) - 4.0)
    low, high = track.min(axis=0) - 25.0, track.max(axis=0) + 25.0
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="east m", ylabel="north m")


def _errors_of(axes: Axes, estimates: Sequence[PoseEstimate], reference: Trajectory, name: str, marker: str) -> None:
    """Along, across and heading over the way."""
    if not len(estimates):
        return
    T = np.stack([e.T_map_vehicle for e in estimates])
    off = T_inverse(reference.at(np.array([e.t_ns for e in estimates], np.int64))) @ T
    at_s = (np.array([e.t_ns for e in estimates]) - reference.t_ns[0]) * 1e-9
    heading = np.degrees(np.arctan2(off[:, 1, 0], off[:, 0, 0]))
    values = (100 * off[:, 0, 3], 100 * off[:, 1, 3], 10 * heading)
    for colour, label, value in zip(CYCLE, ("along, cm", "across, cm", "heading, 0.1°"), values, strict=False):
        axes.plot(at_s, value, f"-{marker}", color=colour, lw=0.8, ms=4, mfc="none", label=f"{label}, {name}")
    axes.set(xlabel="time s", title="against the LiDAR track")
    axes.axhline(0.0, color=INK, lw=0.5)
    axes.legend()


@styled
def draw_flexmap(drawn: DrawnFlexmap, name: str, folder: Path) -> list[Path]:
    """Lanes, both tracks and the fixes, whole and from near."""
    figure = Figure(figsize=(16.0, 8.5), layout="constrained")
    whole, near = figure.subplots(1, 2)
    fixes = drawn.fixes.enu_m(drawn.bent.frame)
    rigid = (drawn.bent.frame.T_self_other(drawn.rigid.frame) @ drawn.rigid.track.T_dst_vehicle)[:, :3, 3]
    for axes in (whole, near):
        axes.add_collection(PolyCollection(list(drawn.lanes), facecolor=GRID, edgecolor=FAINT, lw=0.5))
        axes.plot(rigid[:, 0], rigid[:, 1], "-", color=CYCLE[1], lw=1.0, label="track, rigid")
        axes.plot(*_xy(drawn.bent), "-", color=CYCLE[0], lw=1.2, label="track, bent")
        for chosen, colour, label in ((~drawn.held_out, CYCLE[2], "used"), (drawn.held_out, INK, "held out")):
            axes.plot(fixes[chosen, 0], fixes[chosen, 1], ".", color=colour, ms=2.0, label=f"GNSS, {label}")
        axes.set(aspect="equal", xlabel="east m", ylabel="north m")
    whole.set_title(f"{name}: SLAM track and lanes on the Earth")
    whole.legend(loc="best")
    corner = np.array(_xy(drawn.bent)).T[int(0.3 * len(drawn.bent.track))]
    near.set(xlim=(corner[0] - 45, corner[0] + 45), ylim=(corner[1] - 45, corner[1] + 45), title="from near")
    return [save(figure, folder / f"{name}_georeferenced.png")]


def _xy(found: Georeferenced) -> tuple[F64, F64]:
    p = found.track.T_dst_vehicle
    return p[:, 0, 3], p[:, 1, 3]
