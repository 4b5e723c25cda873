"""What the odometry is wrong by along a stretch, found among noisy and wrong matches."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import theilslopes

from gnd_map.se3 import T_from_R_t, T_inverse, exp_so3
from vehicle_agent.localise.drift import APART, drift_of, slope
from vehicle_agent.localise.graph import MapMatch

EVERY_S, SPEED_MPS = 0.5, 10.0
BIAS_RADPS, SCALE, LEFT, UP = 4e-3, 0.01, 0.006, -0.004
SIGMA_M, SIGMA_RAD = 0.01, np.radians(0.02)


def turn_and_way(yaw_rad, forward_m, left_m=0.0, up_m=0.0):
    return T_from_R_t(exp_so3([0.0, 0.0, yaw_rad]), [forward_m, left_m, up_m])


def stretch(rng, n=24, share_wrong=0.0, wrong_rad=0.0, turn_radps=0.05):
    """(times, steps by a wrong odometry, noisy matches) of a bent drive at even speed."""
    way = EVERY_S * SPEED_MPS
    true = [np.eye(4)]
    for _ in range(n - 1):
        true.append(true[-1] @ turn_and_way(turn_radps * EVERY_S, way))
    driven = way / (1.0 - SCALE)  # the errors are per metre as driven
    steps = [turn_and_way((turn_radps + BIAS_RADPS) * EVERY_S, driven, LEFT * driven, UP * driven)] * (n - 1)
    noise = [turn_and_way(rng.normal(0, SIGMA_RAD), *rng.normal(0, SIGMA_M, 3)) for _ in range(n)]
    for k in rng.choice(n, round(share_wrong * n), replace=False):
        noise[k] = turn_and_way(rng.normal(0, wrong_rad), *rng.choice([-0.5, 0.5], 3))
    matches = [MapMatch(T @ off, np.eye(6) * 1e-4) for T, off in zip(true, noise, strict=True)]
    return [round(k * EVERY_S * 1e9) for k in range(n)], steps, matches


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(("share_wrong", "wrong_rad"), [(0.0, 0.0), (0.25, 0.0), (0.25, 0.02)])
def test_bias_scale_and_course_are_found(seed, share_wrong, wrong_rad):
    drift = drift_of(*stretch(np.random.default_rng(seed), share_wrong=share_wrong, wrong_rad=wrong_rad))
    assert drift.yaw_radps.value == pytest.approx(BIAS_RADPS, abs=3e-4)
    assert drift.forward.value == pytest.approx(SCALE, abs=1e-3)
    assert drift.up.value == pytest.approx(UP, abs=1e-3)
    if not wrong_rad:  # a wrong heading turns the way to the next match aside, which no later match takes back
        assert drift.left.value == pytest.approx(LEFT, abs=1e-3)


def test_sigmas_say_how_wrong_the_slopes_are():
    found = [drift_of(*stretch(np.random.default_rng(seed), turn_radps=0.0)) for seed in range(60)]
    for name, true in (("yaw_radps", BIAS_RADPS), ("forward", SCALE), ("up", UP)):
        slopes = [getattr(drift, name) for drift in found]
        off = np.array([(one.value - true) / one.sigma for one in slopes])
        assert 0.4 < np.sqrt(np.mean(off**2)) < 2.0


def test_matches_that_are_missing_are_bridged():
    times, steps, matches = stretch(np.random.default_rng(3))
    held = [match if n % 3 == 0 else None for n, match in enumerate(matches)]
    drift = drift_of(times, steps, held)
    assert drift.yaw_radps.value == pytest.approx(BIAS_RADPS, abs=5e-4)
    assert drift.forward.value == pytest.approx(SCALE, abs=2e-3)


@pytest.mark.parametrize(("n", "known"), [(5, False), (6, True)])
def test_fewer_than_six_matches_tell_nothing(n, known):
    times, steps, matches = stretch(np.random.default_rng(0))
    held = [match if k < n else None for k, match in enumerate(matches)]
    assert (drift_of(times, steps, held) is not None) == known


def test_a_standing_vehicle_tells_nothing_of_its_wheels():
    match = MapMatch(np.eye(4), np.eye(6) * 1e-4)
    drift = drift_of([n * 10**9 for n in range(10)], [np.eye(4)] * 9, [match] * 10)
    assert (drift.forward.value, drift.forward.sigma) == (0.0, np.inf)
    assert drift.yaw_radps.sigma < 1e-9  # but its gyro is known to the end


def test_a_perfect_odometry_has_no_drift():
    times, _, matches = stretch(np.random.default_rng(0))
    T = [match.T_map_vehicle for match in matches]
    drift = drift_of(times, [T_inverse(a) @ b for a, b in pairwise(T)], matches)
    for one in (drift.yaw_radps, drift.forward, drift.left, drift.up):
        assert abs(one.value) < 1e-12
        assert one.sigma < 1e-12


def plain_slope(x, y):
    """The twin: all pairs that are far enough apart, one by one."""
    found, least = [], APART * (x[-1] - x[0])
    for i in range(len(x)):
        for j in range(i + 1, len(x)):
            dx, dy = x[j] - x[i], y[j] - y[i]
            found += [dy / dx] if dx >= least else []
    return np.median(found)


@pytest.mark.parametrize("seed", range(10))
def test_slope_equals_its_plain_twin(seed):
    rng = np.random.default_rng(seed)
    x, y = np.cumsum(rng.uniform(0.5, 8.0, 23)), rng.normal(size=23)
    assert slope(x, y).value == pytest.approx(plain_slope(x, y), rel=1e-12)


@given(st.lists(st.integers(-1000, 1000), min_size=5, max_size=5))
def test_slope_of_five_even_points_is_that_of_theil_and_sen(values):
    """All pairs of five even points are at least a quarter of the span apart, so that none is left out."""
    x, y = np.arange(5.0), np.array(values, float)
    assert slope(x, y).value == pytest.approx(theilslopes(y, x).slope, abs=1e-9)


@given(st.floats(-10, 10), st.floats(-100, 100), st.integers(6, 30))
def test_a_straight_line_has_its_slope_and_no_doubt(gradient, height, n):
    x = np.linspace(0.0, 50.0, n)
    found = slope(x, gradient * x + height)
    assert found.value == pytest.approx(gradient, abs=1e-9)
    assert found.sigma < 1e-9
