"""What was just seen as a map: it tells a pose that jumped from a base map that is met by chance."""

import numpy as np
import pytest
from gate_scene import POSE, START_NS, WALLS, map_of, match_maps, scan, seen, shift

from gnd.gnd_map.se3 import T_inverse, transform
from gnd.vehicle_agent.detect.recent_map import recent_map as found_map
from gnd.vehicle_agent.detect.shift import OF_SCANS, costs_at, find_shift, gain
from gnd.vehicle_agent.detect.trial import Trial
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty
from gnd.vehicle_agent.localise.match_map import MatchMap

REBUILT = [((a[0] + 0.4, a[1]), (b[0] + 0.4, b[1])) for a, b in WALLS]
"""All that stands has moved by 40 cm alike: what no test against the base map can tell."""


def recent_map(points_m: np.ndarray, noise_m: float) -> MatchMap:
    """Of all points; there are some."""
    found = found_map(points_m, noise_m)
    assert found is not None
    return found


def plain_map(points_map_m: np.ndarray, noise_m: float) -> MatchMap:
    """What the kernels must find."""
    origin = np.floor(points_map_m.min(axis=0)).astype(np.int64) - 2
    g = np.floor(points_map_m).astype(np.int64) - origin
    shape = tuple(g.max(axis=0) + 3)
    flat, member, count = np.unique(np.ravel_multi_index(tuple(g.T), shape), return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(member, column) for column in points_map_m.T], axis=1) / count[:, None]
    d = points_map_m - mean[member]
    squares = d[:, [0, 0, 0, 1, 1, 2]] * d[:, [0, 1, 2, 1, 2, 2]]
    cov = np.stack([np.bincount(member, column) for column in squares.T], axis=1) / np.maximum(count - 1, 1)[:, None]
    enough = count >= 6
    index = np.full(int(np.prod(shape)), -1, np.int32)
    index[flat[enough]] = np.arange(int(enough.sum()), dtype=np.int32)
    return MatchMap.of(index.reshape(shape), np.eye(3), -origin.astype(float), mean[enough], cov[enough], noise_m)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_its_kernels_find_what_numpy_finds_within_reach(dtype: type) -> None:
    points, centre, about = (seen(WALLS, 3, 10.0) - POSE[:3, 3]).astype(dtype), POSE[:3, 3], POSE[:3, 3] + 1.0
    placed = points + centre
    near = placed[np.linalg.norm(placed - about, axis=1) < 15.0]
    assert 1000 < len(near) < 0.9 * len(placed)
    found, plain = found_map(points, 0.04, centre, about, 15.0), plain_map(near, 0.04)
    assert found is not None
    for column in ("index", "A", "b", "mean_m", "information"):
        np.testing.assert_array_equal(getattr(found, column), getattr(plain, column), err_msg=column)


def test_there_is_none_where_nothing_is_within_reach() -> None:
    far = np.array([[20.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0]])
    assert found_map(far, 0.04, np.zeros(3), np.zeros(3), 15.0) is None
    assert found_map(np.empty((0, 3), np.float32), 0.04) is None


def test_its_gaussians_are_those_of_the_points() -> None:
    rng = np.random.default_rng(1)
    cube = np.array([3.0, -2.0, 1.0]) + rng.uniform(0.1, 0.9, (500, 3)) * np.array([1.0, 1.0, 0.1])
    few = np.array([[7.5, 0.5, 0.5]] * 3)
    found = recent_map(np.concatenate([cube, few]), 0.04)
    assert len(found) == 1  # three points make no Gaussian
    assert found.mean_m[0] == pytest.approx(cube.mean(axis=0))
    i = tuple(np.floor(found.A @ cube[0] + found.b).astype(int))
    assert found.index[i] == 0
    cost = costs_at(np.concatenate([cube, cube + np.array([0.0, 0.0, 0.5]), few]), np.eye(4), found)
    assert cost[:500].max() < 0.7 < 0.9 < cost[500:1000].min()
    assert (cost[1000:] == 1.0).all()


def test_the_pose_that_fits_is_preferred_and_neither_before_itself() -> None:
    recent = recent_map(seen(WALLS, 1, 40.0), 0.04)
    points = transform(T_inverse(POSE), seen(WALLS, 2))
    assert gain(points, POSE @ shift(0.3), POSE, recent) > 5.0
    assert gain(points, POSE, POSE @ shift(0.3), recent) < -5.0
    assert gain(points, POSE, POSE, recent) == 0.0
    assert gain(np.empty((0, 3)), POSE, POSE, recent) == 0.0


def numbers(one: Trial, scans: list) -> list[int]:
    counted = [out for scan_in in scans for out in one.push(scan_in)] + list(one.flush())
    return [(out.scan.t_ns - START_NS) // 100_000_000 for out in counted]


def test_a_rebuilt_stretch_of_a_drive_is_no_jump_of_the_pose() -> None:
    """The base map would like another place; what was seen just before says that nothing jumped."""
    yard = map_of()
    alone = find_shift(transform(T_inverse(POSE), seen(REBUILT, 5)), POSE, match_maps(yard).near(POSE[:3, 3]))
    assert alone.is_pose_error(OF_SCANS, PoseUncertainty(0.01, 0.0005))
    both = [*WALLS, *REBUILT]  # old and new stand side by side for a while, then only the new
    drive = [scan(seen(both if k < 20 else REBUILT, k % 5, 2.0), k) for k in range(40)]
    one = Trial(match_maps(yard))
    assert numbers(one, drive) == list(range(40))
    assert "unchecked" in {tried.verdict for tried in one.take_tried()}


def test_the_same_shift_as_a_jump_of_the_pose_is_held_back() -> None:
    drive = [scan(seen(WALLS, k % 5, 2.0), k, shift(-0.4) if k >= 20 else None) for k in range(40)]
    one = Trial(match_maps(map_of()))
    assert max(numbers(one, drive)) < 20
