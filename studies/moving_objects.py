"""Two scans of a junction from above, what is called moving in red: `python -m studies.moving_objects RECORDING PNG`.

The recording is 38 scans or more of a folder of KITTI raw (drive 60 of 2011-09-26, where a lorry and a car follow).
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import click
import numpy as np
from matplotlib.axes import Axes

from gnd.gnd_map.se3 import transform
from gnd.picture_style import BLUE, GREY, RED
from gnd.vehicle_agent.importer import map_track, open_recording
from gnd.vehicle_agent.importers.recording import Recording
from gnd.vehicle_agent.localise.estimates import PoseEstimate, RefinedScan
from gnd.vehicle_agent.packed_rays import PlacedRays
from gnd.vehicle_agent.segment import MotionSegmenter, SegmentedScan
from studies.frame.figures import dress, finish, new_figure

SHOWN: Final = (1, 23)
SCANS: Final = 38
ACROSS_M: Final = (-18.0, 10.0)
ALONG_M: Final = (-30.0, 40.0)
UPRIGHT_M: Final = (0.5, 3.0)
"""Heights over the road that are drawn."""


def refined_scans(recording: Recording) -> list[RefinedScan]:
    """Scans with the poses of LiDAR odometry; KITTI's are free of the motion of the sweep."""
    track = map_track(recording)
    found = []
    for n, t_ns in enumerate(track.t_ns.tolist()):
        T_map_vehicle = track.at(t_ns)
        T = T_map_vehicle @ recording.T_vehicle_lidar
        points = recording.read(n).points_m.astype(np.float64)
        points = transform(T, points[np.isfinite(points).all(axis=1)])
        estimate = PoseEstimate(t_ns, T_map_vehicle, 0.02, 0.001, 0.9, "good")
        found.append(RefinedScan(t_ns, PlacedRays(points, np.tile(T[:3, 3], (len(points), 1))), estimate))
    return found


def segmented(folder: Path) -> list[SegmentedScan]:
    """The first scans of a recording with what moves marked."""
    whole = open_recording("kitti", folder)
    segmenter = MotionSegmenter()
    scans = refined_scans(replace(whole, t_ns=whole.t_ns[:SCANS]))
    return [done for scan in scans for done in segmenter.push(scan)]


def draw(scans: Sequence[SegmentedScan], path: Path) -> Path:
    """Draw the scans one below the other.

    Raises:
        SimError: the file cannot be written.
    """
    figure = new_figure(11.0, 9.6)
    for axes, number in zip(figure.subplots(len(SHOWN), 1), SHOWN, strict=True):
        dress(axes, "along the road, m", "across, m", f"scan {number}")
        _draw_scan(axes, scans[number])
    return finish(figure, "What moves at a junction", "standing grey, moving red, the vehicle blue", path)


def _draw_scan(axes: Axes, found: SegmentedScan) -> None:
    x, y, z = found.scan.points_map_m.T
    seen = (z > UPRIGHT_M[0]) & (z < UPRIGHT_M[1])
    for moving, colour, size in ((False, GREY, 1.0), (True, RED, 3.0)):
        shown = seen & (found.moving == moving)
        axes.plot(x[shown], y[shown], ".", color=colour, markersize=size, markeredgewidth=0)
    vehicle = found.scan.estimate.T_map_vehicle[:2, 3]
    axes.plot(*vehicle, "^", color=BLUE, markersize=8)
    axes.set(xlim=ALONG_M, ylim=ACROSS_M, aspect="equal")


@click.command(help=__doc__)
@click.argument("recording", type=click.Path(path_type=Path, exists=True))
@click.argument("png", type=click.Path(path_type=Path))
def main(recording: Path, png: Path) -> None:
    """Draw."""
    click.echo(draw(segmented(recording), png))


if __name__ == "__main__":
    main()
