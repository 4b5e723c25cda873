import numpy as np
import pytest

from gnd.schemas.drive import MotionTrack
from gnd.vehicle_agent.features.mapping.dead_reckoning import DeadReckoning, composed, relative
from gnd.vehicle_agent.features.mapping.sensors import SERIES_CAR, WheelsAndGyro

NOISE = SERIES_CAR.motion


def wavy(seed=0, n=400):
    rng = np.random.default_rng(seed)
    t_ns = np.arange(n, dtype=np.int64) * 20_000_000
    t = t_ns * 1e-9
    return MotionTrack(t_ns, 9.0 + 2.0 * np.sin(t), 0.2 * np.sin(0.7 * t) + 0.01 * rng.standard_normal(n))


def test_a_circle_closes():
    n = 6284
    t_ns = np.arange(n + 1, dtype=np.int64) * 10_000_000
    rate = 2.0 * np.pi / (n * 0.01)
    d = DeadReckoning.of(MotionTrack(t_ns, np.full(n + 1, 5.0), np.full(n + 1, rate)), NOISE, 0.0, 0.0)
    np.testing.assert_allclose(d.pose[-1], [0.0, 0.0, 2.0 * np.pi], atol=1e-6)
    assert np.hypot(*d.pose[n // 2, :2]) == pytest.approx(2.0 * 5.0 / rate, rel=1e-6)


def test_composed_undoes_relative():
    rng = np.random.default_rng(3)
    a, b = rng.normal(0.0, 3.0, (2, 20, 3))
    back = composed(a, relative(a, b))
    np.testing.assert_allclose(back[:, :2], b[:, :2])
    np.testing.assert_allclose(np.cos(back[:, 2]), np.cos(b[:, 2]))


def test_jacobians_are_the_slopes_of_the_steps():
    track, keys = wavy(), wavy().t_ns[[0, 90, 200, 399]]
    at = np.array([0.002, 0.003])
    steps = DeadReckoning.of(track, NOISE, *at).steps(keys)
    for column, h in enumerate((1e-5, 1e-6)):
        change = np.zeros(2)
        change[column] = h
        more, less = (DeadReckoning.of(track, NOISE, *(at + s * change)).steps(keys).delta for s in (1.0, -1.0))
        np.testing.assert_allclose(steps.jacobian[:, :, column], (more - less) / (2.0 * h), atol=1e-5)


def test_covariance_is_that_of_many_drives_with_white_noise():
    track, rng = wavy(), np.random.default_rng(1)
    keys = track.t_ns[[0, 100]]
    noise = WheelsAndGyro(0.005, 0.5, 0.002, 0.05, 1e-6, 0.0)
    steps = DeadReckoning.of(track, noise, 0.0, 0.0).steps(keys)
    ends = []
    for _ in range(800):
        speed = track.speed_mps + 0.5 * rng.standard_normal(len(track.t_ns))
        rate = track.yaw_rate_radps + 0.05 * rng.standard_normal(len(track.t_ns))
        ends.append(DeadReckoning.of(MotionTrack(track.t_ns, speed, rate), noise, 0.0, 0.0).steps(keys).delta[0])
    seen = np.cov(np.array(ends).T)
    np.testing.assert_allclose(np.sqrt(np.diag(steps.cov[0])), np.sqrt(np.diag(seen)), rtol=0.25)
    assert steps.cov[0, 1, 2] == pytest.approx(seen[1, 2], rel=0.3)


def test_a_gap_between_samples_leaves_much_unknown():
    track = wavy()
    kept = np.r_[0:100, 150:400]
    gap = MotionTrack(*(column[kept] for column in track))
    keys = track.t_ns[[90, 160]]
    whole = DeadReckoning.of(track, NOISE, 0.0, 0.0).steps(keys).cov[0]
    assert DeadReckoning.of(gap, NOISE, 0.0, 0.0).steps(keys).cov[0, 0, 0] > 100.0 * whole[0, 0]


def test_keyframes_by_way_and_by_time():
    t_ns = np.arange(1001, dtype=np.int64) * 20_000_000  # 20 s, the second half standing
    speed = np.where(np.arange(1001) < 500, 10.0, 0.0)
    d = DeadReckoning.of(MotionTrack(t_ns, speed, np.zeros(1001)), NOISE, 0.0, 0.0)
    keys = d.keyframes(5.0, 2.0)
    way, t_s = np.interp(keys, t_ns, d.way_m), keys * 1e-9
    assert keys[0] == t_ns[0]
    assert keys[-1] == t_ns[-1]
    assert np.diff(way).max() < 5.0 + 0.21
    assert np.diff(t_s).max() < 2.0 + 0.021
    assert len(keys) == pytest.approx(20 + 5, abs=2)
