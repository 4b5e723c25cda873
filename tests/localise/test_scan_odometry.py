"""Scan-to-scan odometry against known motion: with good wheels, slipping wheels, no wheels; where it must say no."""

from functools import cache

import numpy as np
import pytest
from yard import GROUND_M, corridor, offset, pose, seen_from, yard

from gnd.gnd_map.se3 import T_inverse, transform
from gnd.vehicle_agent.localise import rolling_map
from gnd.vehicle_agent.localise.kernels import tapered_information
from gnd.vehicle_agent.localise.match_map import UNIFORM_VOXEL_M2
from gnd.vehicle_agent.localise.rolling_map import RollingMap
from gnd.vehicle_agent.localise.scan_odometry import ScanOdometry, ScanStep, joint_step

STEP_NS = 100_000_000
RINGLESS = 0.0  # points of the yard's ground lie in no rings
SIGMAS = np.array([3e-3, 3e-3, 1e-3, 0.012, 0.005, 0.012])


@pytest.fixture(scope="module")
def surfaces():
    return yard(np.random.default_rng(5), per_m2=60.0)


@pytest.fixture(scope="module")
def sweep(surfaces):
    """What is seen at scan k; made once."""
    return cache(lambda k: seen_from(np.random.default_rng(100 + k), surfaces, true_pose(k), 6000, 18.0))


def true_pose(k):
    """A slow bend, 0.6 m and 1.5 degrees a scan."""
    angle = np.radians(1.5) * k
    radius_m = 0.6 / np.radians(1.5)
    return pose(-12.0 + radius_m * np.sin(angle), -5.0 + radius_m * (1.0 - np.cos(angle)), np.degrees(angle))


def true_step(k):
    return T_inverse(true_pose(k - 1)) @ true_pose(k)


def wheels(k, scale=1.0, turn_deg=0.0):
    """What wheels and gyro tell of the step to scan k."""
    T = true_step(k) @ pose(0.0, 0.0, turn_deg, z=0.0)
    T[:3, 3] *= scale
    return T


def drive(odometry, sweep, scans, told):
    """Steps of scans 1 ... scans - 1; the first begins."""
    steps = []
    for k in range(scans):
        points = sweep(k)
        T = told(k) if k else np.eye(4)
        steps.append(odometry.step(k * STEP_NS, points, T, SIGMAS, lambda points=points: points))
    assert steps[0] is None
    return steps[1:]


def test_steps_are_right_and_say_how_right(sweep):
    steps = drive(ScanOdometry(min_standing_share=RINGLESS), sweep, 12, wheels)
    off = np.array([offset(true_step(k), s.T_before_now) for k, s in enumerate(steps, 1)])
    assert off[:, 0].max() < 0.03
    assert off[:, 1].max() < 0.12
    sigma_m = np.array([np.sqrt(np.trace(s.covariance[3:, 3:])) for s in steps])
    assert 0.1 < np.mean((off[:, 0] / sigma_m) ** 2) ** 0.5 < 2.5


@pytest.mark.parametrize("scale", [0.85, 1.15])
def test_slipping_wheels_are_contradicted(sweep, scale):
    """9 cm a step too little or too much: the way of the scans stays right, and the wheels lose their say."""
    steps = drive(ScanOdometry(min_standing_share=RINGLESS), sweep, 14, lambda k: wheels(k, scale if k > 4 else 1.0))
    way = np.linalg.multi_dot([s.T_before_now for s in steps])
    driven_m = 0.09 * 9
    off_m, off_deg = offset(T_inverse(true_pose(0)) @ true_pose(13), way)
    assert off_m < 0.15 * driven_m
    assert off_deg < 0.3
    joint = joint_step(wheels(13, scale), SIGMAS, steps[-1])
    assert joint.slipped
    assert joint.driven_sigmas[3] > 0.05
    assert offset(true_step(13), joint.T_before_now)[0] < 0.02


def test_locked_wheels_are_seen_through(sweep):
    """The wheels stand while the vehicle slides on: going on as before fits, standing does not."""
    steps = drive(ScanOdometry(min_standing_share=RINGLESS), sweep, 10, lambda k: wheels(k, 0.0 if k > 5 else 1.0))
    assert all(s is not None for s in steps)
    for k in (7, 8, 9):
        assert offset(true_step(k), steps[k - 1].T_before_now)[0] < 0.03


def test_slipping_wheels_coast_over_a_scan_that_matches_nowhere(sweep):
    """And not for long: after half a second the wheels have their say again."""
    odometry = ScanOdometry(min_standing_share=RINGLESS)
    drive(odometry, sweep, 8, lambda k: wheels(k, 0.0 if k > 5 else 1.0))
    nothing = sweep(7)[:10]
    for k in range(8, 13):
        step = odometry.step(k * STEP_NS, nothing, wheels(k, 0.0), SIGMAS, lambda: nothing)
        assert offset(true_step(k), step.T_before_now)[0] < 0.05
        assert step.covariance[3, 3] >= 0.03**2
        assert joint_step(wheels(k, 0.0), SIGMAS, step).slipped
    assert odometry.step(13 * STEP_NS, nothing, wheels(13, 0.0), SIGMAS, lambda: nothing) is None


def test_wheels_that_slipped_are_believed_again_once_they_agree(sweep):
    """Two sigmas are no slip in themselves, but the rest of one."""
    off = wheels(3)
    off[0, 3] -= 2.0 * np.hypot(SIGMAS[3], 0.005)
    covariance = np.diag(np.full(6, 0.005**2))
    assert not joint_step(off, SIGMAS, ScanStep(wheels(3), covariance)).slipped
    assert joint_step(off, SIGMAS, ScanStep(wheels(3), covariance, slipping=True)).slipped
    assert not joint_step(wheels(3), SIGMAS, ScanStep(wheels(3), covariance, slipping=True)).slipped


def test_agreeing_wheels_are_not_contradicted(sweep):
    steps = drive(ScanOdometry(min_standing_share=RINGLESS), sweep, 8, wheels)
    assert not any(joint_step(wheels(k), SIGMAS, s).slipped for k, s in enumerate(steps, 1))
    alone = joint_step(wheels(3), SIGMAS, None)
    assert not alone.slipped
    assert np.array_equal(alone.T_before_now, wheels(3))


def test_along_a_corridor_the_wheels_decide():
    """Nothing tells how far along: the step says so, and what is joined follows the wheels there."""
    walls, odometry = corridor(np.random.default_rng(3)), ScanOdometry(min_standing_share=RINGLESS)
    steps = []
    for k in range(8):
        points = seen_from(np.random.default_rng(k), walls, pose(-30.0 + 0.6 * k, 0.3, 0.0, z=GROUND_M), 6000, 25.0)
        told = pose(0.55, 0.0, 0.0, z=0.0)
        steps.append(odometry.step(k * STEP_NS, points, told, SIGMAS, None))
    step = steps[-1]
    assert step.covariance[3, 3] > 100 * step.covariance[4, 4]
    joint = joint_step(pose(0.55, 0.0, 0.0, z=0.0), SIGMAS, step)
    assert joint.T_before_now[0, 3] == pytest.approx(0.55, abs=0.01)
    assert not joint.slipped


def test_a_match_far_from_every_prediction_is_no_step(sweep):
    """The sparse sensor jumps by 10 to 15 cm; here the scan itself jumps by 0.5 m."""
    odometry = ScanOdometry(min_standing_share=RINGLESS)
    drive(odometry, sweep, 6, wheels)
    points = transform(pose(0.0, 0.5, 0.0, z=0.0), sweep(6))
    assert odometry.step(6 * STEP_NS, points, wheels(6), SIGMAS, lambda: points) is None


def test_what_does_not_continue_begins_anew(sweep):
    odometry = ScanOdometry(min_standing_share=RINGLESS)
    drive(odometry, sweep, 5, wheels)
    assert odometry.step(20_000_000_000, sweep(5), wheels(5), SIGMAS) is None  # a gap
    assert odometry.step(20_100_000_000, sweep(6), wheels(6), SIGMAS) is not None
    assert odometry.step(20_000_000_000, sweep(7), wheels(7), SIGMAS) is None  # time goes backwards


def test_a_scan_of_too_few_points_is_no_step(sweep):
    odometry = ScanOdometry(min_standing_share=RINGLESS)
    drive(odometry, sweep, 4, wheels)
    for few in (np.empty((0, 3)), sweep(4)[:10]):
        odometry.begin(0, sweep(3))
        assert odometry.step(STEP_NS, few, wheels(4), SIGMAS) is None


# --- the rolling map -------------------------------------------------------------------------------------------------


def plain_map(scans, noise_m):
    """Shown voxels to (mean, covariance), summed point by point with the weights that fading gives."""
    held = {}
    for points in scans:
        voxels = {}
        for p in points:
            voxels.setdefault(tuple(np.floor(p).astype(int)), []).append(p)
        for v, ps in voxels.items():
            weights, old, cells = held.get(v, (np.empty(0), np.empty((0, 3)), set()))
            cells = cells | {tuple(np.floor((p - v) * 4).astype(int)) for p in ps}
            held[v] = (np.r_[weights * rolling_map._FADE, np.ones(len(ps))], np.r_[old, ps], cells)
    shown = {}
    for v, (w, ps, cells) in held.items():
        mean = np.average(ps, axis=0, weights=w)
        cov = np.einsum("n,ni,nj->ij", w / w.sum(), ps - mean, ps - mean)
        values = np.sort(np.linalg.eigvalsh(cov))[::-1]
        r = rolling_map._LINE_RATIO
        line = (
            values[0] * values[1] + values[0] * values[2] + values[1] * values[2] < r / (1 + r) ** 2 * cov.trace() ** 2
        )
        if len(cells) >= rolling_map._MIN_CELLS and not (line and cov[2, 2] < rolling_map._UPRIGHT**2 * cov.trace()):
            shown[v] = mean, cov
    return shown


def test_the_rolling_map_is_what_plain_sums_give(sweep):
    rolling = RollingMap(0.04)
    rolling.clear(np.zeros(3))
    scans = [transform(true_pose(k), sweep(k)) for k in range(3)]
    for points in scans:
        rolling.add(points, np.zeros(3))
    m, want = rolling.match_map(), plain_map(scans, 0.04)
    at = np.argwhere(m.index >= 0)
    found = {tuple(np.round(a - m.b).astype(int)): m.index[tuple(a)] for a in at}
    assert found.keys() == want.keys()
    assert len(found) > 200
    for v, row in found.items():
        mean, cov = want[v]
        assert np.allclose(m.mean_m[row], mean, atol=1e-9)
        information = np.empty((1, 6))
        tapered_information(cov[np.triu_indices(3)][None].copy(), 0.04**2, UNIFORM_VOXEL_M2, information)
        assert np.allclose(m.information[row], information[0], rtol=1e-5, atol=1e-4)


def test_one_ring_is_hidden_and_a_post_is_not():
    rolling = RollingMap(0.04)
    rolling.clear(np.zeros(3))
    t = np.linspace(0.02, 0.98, 60)
    ring = np.column_stack([3.0 + t, 5.2 + 0.02 * t, np.full(60, 0.31)])
    post = np.column_stack([np.full(60, 7.4), np.full(60, 5.3), t])
    for _ in range(3):
        rolling.add(np.concatenate([np.repeat(ring, 2, axis=0), post]), np.zeros(3))
    m = rolling.match_map()
    entry = lambda p: m.index[tuple(np.floor(np.asarray(p) + m.b).astype(int))]  # noqa: E731
    assert entry([3.5, 5.2, 0.3]) < -1  # not known, rather than empty
    assert entry([7.4, 5.3, 0.5]) < -1  # four of its sub-cells were hit: too few
    thick = np.concatenate([post + np.array([0.2 * (i % 2), 0.2 * (i // 2), 0.0]) for i in range(4)])
    rolling.add(thick, np.zeros(3))
    assert rolling.match_map().index[tuple(np.floor(np.array([7.4, 5.3, 0.5]) + m.b).astype(int))] >= 0


def test_the_window_follows_and_forgets(sweep):
    """What is left far behind goes; what is near stays as it was, at its place."""
    rolling = RollingMap(0.04, reach_m=30.0, keep_scans=3)
    rolling.clear(np.zeros(3))
    near = np.random.default_rng(1).uniform([14.0, -2.0, 0.0], [18.0, 2.0, 2.0], (3000, 3))
    behind = near - [40.0, 0.0, 0.0]
    rolling.add(np.concatenate([near, behind]), np.zeros(3))
    before, both = rolling.match_map(), len(rolling)
    means = {tuple(x) for x in before.mean_m.round(9)}
    rolling.add(near[:1], np.array([12.0, 0.0, 0.0]))
    after = rolling.match_map()
    assert len(rolling) == both // 2
    assert len({tuple(x) for x in after.mean_m.round(9)} & means) >= len(rolling) - 1
    for _ in range(4):
        rolling.add(near[:1], np.array([12.0, 0.0, 0.0]))
    rolling.add(near[:1], np.array([24.0, 0.0, 0.0]))
    assert len(rolling) == 1


def test_a_full_map_takes_no_more_and_goes_on(sweep):
    rolling = RollingMap(0.04, max_voxels=100)
    rolling.clear(np.zeros(3))
    for k in range(6):
        rolling.add(transform(true_pose(k), sweep(k)), true_pose(k)[:3, 3])
    assert len(rolling) == 100
