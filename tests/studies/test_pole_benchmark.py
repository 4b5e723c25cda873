"""The benchmark of the pole detector: its truth, its counts, and real scans."""

from pathlib import Path

import numpy as np
import pytest

from gnd.fleet_sim.shapes import Post
from gnd.fleet_sim.street import street
from gnd.gnd_map.se3 import transform
from gnd.vehicle_agent.features.poles.detector import Pole, PoleDetector, Rays
from gnd.vehicle_agent.importers.cleaning import cleaned
from gnd.vehicle_agent.importers.kitti import open_kitti
from studies.frame.errors import OptionError
from studies.frame.options import of_arguments
from studies.pole_real import RealScan, Stability, draw_poles, poles_of, stability
from studies.pole_scenes import OBSERVABLE_LENGTH_M, OBSERVABLE_RETURNS, PoleDrive, PoleScans, PoleScore, Posts, matches
from studies.poles import PoleOptions


def pole(x_m: float, y_m: float, kind: str = "pole") -> Pole:
    cov = 0.01 * np.eye(2)
    return Pole(np.array([x_m, y_m]), cov, 0.2, 0.02, 0.0, 1.0, 0.3, 4.0, np.zeros(2), kind, 20, 1, 0.0)


def posts(*xy_m: tuple[float, float]) -> Posts:
    n = len(xy_m)
    kinds = ("streetlight",) * n
    return Posts(("lamp",) * n, kinds, np.array(xy_m), np.full(n, 0.18), np.full(n, 7.5), np.array([-1]))


def test_matches_are_one_to_one_and_the_nearest_first() -> None:
    truth = posts((5.0, 0.0), (5.4, 0.0), (20.0, 0.0))
    assert matches([pole(5.3, 0.0), pole(5.35, 0.0), pole(19.0, 0.0)], truth).tolist() == [0, 1, -1]
    assert matches([], truth).tolist() == []


def test_scores_count_what_was_found_what_was_wrong_and_how_far_off() -> None:
    score, truth = PoleScore(), posts((5.0, 0.0), (15.0, 0.0), (16.0, 5.0), (80.0, 0.0))
    found = [pole(5.0, 0.1, "streetlight"), pole(25.0, 0.0)]
    score.add(found, truth, np.array([True, True, False, True]), np.zeros(2))
    assert score.recall() == (50.0, 2)
    assert score.recall(0) == (100.0, 1)
    assert score.recall_of_all()[0] == pytest.approx(100.0 / 3.0)
    assert score.recall_of_all()[1] == 3
    assert score.precision() == (50.0, 2)
    assert score.precision(2) == (0.0, 1)
    assert score.errors_m == [pytest.approx(0.1)]
    assert score.nees == [pytest.approx(1.0)]
    assert score.kinds == {("lamp", "streetlight"): 1}


def test_the_truth_counts_returns_on_posts() -> None:
    drive = PoleDrive(PoleScans(101, "VLP-16", (4.0,), traffic=False))
    (scan,) = drive.scans()
    objects = street(101).in_state("after")
    assert len(drive.posts.kind) == len({
        (s.x_m, s.y_m) for o in objects for s in o.shapes if isinstance(s, Post) and s.radius_m <= 0.25
    })  # fmt: skip
    lamps = [o for o in objects if o.kind == "lamp"]
    assert drive.posts.source.count("lamp") == len(lamps)
    assert (scan.observable == ((scan.returns >= OBSERVABLE_RETURNS) & (scan.length_m >= OBSERVABLE_LENGTH_M))).all()
    best = int(np.argmax(np.where(np.array(drive.posts.source) == "lamp", scan.returns, 0)))
    off = scan.rays.points_m[:, :2] - drive.posts.xy_m[best]
    assert (np.hypot(*off.T) < 0.5).sum() >= scan.returns[best] > 20
    found = PoleDetector().window([scan.rays], scan.T_map_vehicle[:3, 3])
    score = PoleScore()
    score.add(found, drive.posts, scan.observable, scan.T_map_vehicle[:2, 3])
    assert score.recall()[0] >= 50.0
    assert score.precision()[0] > 90.0


def test_options_refuse_unknown_sensors() -> None:
    assert of_arguments(PoleOptions, ["--sensors", "none", "--seeds", "7"]).sensors == ()
    with pytest.raises(OptionError, match="there is no radar"):
        of_arguments(PoleOptions, ["--sensors", "radar"])


def kitti_scans(shared_data: Path, numbers: tuple[int, ...]) -> list[RealScan]:
    """Scans of a vehicle that stands at a junction: all have one pose."""
    folder = shared_data / "kitti_raw_0060"
    if not folder.is_dir():
        pytest.skip("no recording kitti_raw_0060")
    recording = open_kitti(folder, None)
    mount, found = recording.T_vehicle_lidar, []
    for number in numbers:
        scan = cleaned(recording.read(number)).scan
        assert scan is not None
        rays = Rays(transform(mount, scan.points_m.astype(np.float64)), mount[:3, 3].copy())
        found.append(RealScan(number, rays, np.eye(4)))
    return found


@pytest.mark.slow
def test_poles_of_a_real_junction_are_found_again(shared_data: Path, tmp_path: Path) -> None:
    scans, detector = kitti_scans(shared_data, (70, 71, 72)), PoleDetector()
    result = stability(scans, detector)
    assert isinstance(result, Stability)
    assert result.found >= 9
    assert result.again >= 0.7 * result.asked > 0
    path = draw_poles(scans[0], poles_of(scans[0], detector), "junction", tmp_path / "poles.png")
    assert path.read_bytes().startswith(b"\x89PNG")
