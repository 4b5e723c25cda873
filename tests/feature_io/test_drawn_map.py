"""A map drawn over a local track comes to lie where the track's GNSS says, drift and all."""

from pathlib import Path

import numpy as np
import pytest

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import T_from_R_t, exp_so3
from gnd.vehicle_agent.errors import LocaliseError
from gnd.vehicle_agent.localise.drawn_map import placement_by_track, read_fixes, read_track

FRAME = LocalFrame(np.radians(48.0), np.radians(11.0), 0.0)
TURN = 0.7


def driven() -> tuple[np.ndarray, np.ndarray]:
    """Places (N, 2) every 2 m and headings along a road with bends, east and north."""
    heading = 0.8 * np.sin(np.arange(400) / 25.0) + 0.6 * np.sin(np.arange(400) / 60.0)
    return np.cumsum(2.0 * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0), heading


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """Track and fixes of a drive; the track's frame is turned, and its yaw drifts by 1.7 degrees over 800 m."""
    place, heading = driven()
    drift = np.linspace(0.0, 0.03, len(place))
    local_heading = heading - TURN + drift
    step = 2.0 * np.column_stack([np.cos(local_heading), np.sin(local_heading)])
    local = np.cumsum(step, axis=0) - step[0]
    rows = [
        T_from_R_t(exp_so3([0.0, 0.0, yaw]), [*p, 0.0])[:3].ravel() for yaw, p in zip(local_heading, local, strict=True)
    ]
    np.savetxt(tmp_path / "poses.txt", rows)
    lat, lon, _ = FRAME.geodetic_from_enu(np.column_stack([place, np.zeros(len(place))]))
    np.savetxt(tmp_path / "fixes.txt", np.degrees(np.column_stack([lat, lon])), fmt="%.10f")
    return tmp_path / "poses.txt", tmp_path / "fixes.txt"


def test_points_beside_the_track_lie_beside_the_road(files: tuple[Path, Path]) -> None:
    placement = placement_by_track(*files)
    assert not placement.height_known
    track = read_track(files[0]).T_dst_vehicle
    beside = (track @ np.array([0.0, 3.0, 0.0, 1.0]))[:, :3]  # 3 m to the left
    found = FRAME.enu_from_geodetic(*placement.geodetic(beside))[:, :2]
    place, heading = driven()
    true = place + 3.0 * np.column_stack([-np.sin(heading), np.cos(heading)])
    off_m = np.linalg.norm(found - true, axis=1)
    assert np.median(off_m) < 0.15
    assert off_m.max() < 0.5


def test_files_that_are_no_tables_are_refused(files: tuple[Path, Path], tmp_path: Path) -> None:
    poses, fixes = files
    with pytest.raises(LocaliseError, match=r"fixes\.txt: 400 lines of 2 columns; at least 2 of 12 are needed"):
        placement_by_track(fixes, fixes)
    with pytest.raises(LocaliseError, match=r"no\.txt: no table of numbers"):
        placement_by_track(poses, tmp_path / "no.txt")
    (tmp_path / "far.txt").write_text("48 11\n98 11\n")
    with pytest.raises(LocaliseError, match=r"far\.txt: line 2: \[98\.0, 11\.0\] is no latitude and longitude"):
        read_fixes(tmp_path / "far.txt")
    (tmp_path / "still.txt").write_text("48 11\n48 11\n48 11\n")
    with pytest.raises(LocaliseError, match="3 are needed"):
        placement_by_track(poses, tmp_path / "still.txt")
