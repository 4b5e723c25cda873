"""The time offset between LiDAR and motion: found where the motion tells it, and known not to be known where not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import cho_solve_banded, cholesky_banded

from gnd.gnd_map.se3 import T_from_R_t, exp_so3
from gnd.vehicle_agent.localise.clock import (
    MOST_S,
    PRIOR_S,
    SHARED,
    ClockEstimator,
    MotionSignal,
    _whitened,
    solve_chain,
)
from gnd.vehicle_agent.localise.odometry import ClockModel, MotionBuffer
from gnd.vehicle_agent.localise.scan_odometry import ScanStep

S = 1_000_000_000
START_NS = 1_600_000_000 * S
SWEEP_S, SAMPLE_S = 0.1, 0.02
WAY_SIGMA_M, YAW_SIGMA_RAD = 3e-3, 1.3e-4  # of a step, as measured (decision 0086)


def brisk(t):
    """(speed, its integral, yaw rate, its integral) of a drive that brakes, accelerates and turns."""
    speed, way = 9.0 + 3.0 * np.sin(0.6 * t), 9.0 * t - 5.0 * np.cos(0.6 * t)
    return speed, way, 0.15 * np.sin(0.9 * t), -0.15 / 0.9 * np.cos(0.9 * t)


def steady(t):
    """As `brisk`, straight on at one speed."""
    return np.full_like(t, 12.0), 12.0 * t, np.zeros_like(t), np.zeros_like(t)


def straight(t):
    """As `brisk`, without turns."""
    speed, way, _, _ = brisk(t)
    return speed, way, np.zeros_like(t), np.zeros_like(t)


def turning(t):
    """As `brisk`, at one speed."""
    _, _, yaw_rate, yaw = brisk(t)
    return np.full_like(t, 9.0), 9.0 * t, yaw_rate, yaw


class Drive:
    """Feeds an estimator: the samples' stamps are `offset(t)` later than the LiDAR's clock; noise as measured."""

    def __init__(self, motion=brisk, offset=lambda t: 0.0 * t, seed=0, noise=1.0, scale=1.0, bias=0.0):
        self.motion, self.offset, self.noise, self.scale, self.bias = motion, offset, noise, scale, bias
        self.rng = np.random.default_rng(seed)
        self.buffer = MotionBuffer()
        self.estimator = ClockEstimator(self.buffer)
        self._next_sample = -0.5
        self._scan_error = np.zeros(2)

    def push_samples(self, until_s):
        while self._next_sample <= until_s:
            t = np.array([self._next_sample])
            speed, _, yaw_rate, _ = self.motion(t)
            stamp = START_NS + round((t[0] + self.offset(t)[0]) * 1e9)
            noisy = speed / self.scale + self.noise * 0.02 * self.rng.normal()
            turn = yaw_rate + self.bias + self.noise * 1.7e-3 * self.rng.normal()
            self.buffer.push(stamp, float(noisy[0]), float(turn[0]))
            self._next_sample += SAMPLE_S

    def run(self, first_s, last_s, wrong=()):
        """Steps from scan to scan; every tenth of those in `wrong` is 0.3 m and 0.02 rad off."""
        for k in range(round(first_s / SWEEP_S), round(last_s / SWEEP_S)):
            a, b = k * SWEEP_S, (k + 1) * SWEEP_S
            self.push_samples(b + 0.3)
            (_, way_a, _, yaw_a), (_, way_b, _, yaw_b) = self.motion(np.array([a])), self.motion(np.array([b]))
            error = self.noise * self.rng.normal(size=2) * [1.9e-3, 8e-5]
            walk = self.noise * self.rng.normal(size=2) * [1.6e-3, 3e-5]
            way, yaw = np.array([way_b[0] - way_a[0], yaw_b[0] - yaw_a[0]]) + error - self._scan_error + walk
            self._scan_error = error
            if k % 10 in wrong:
                way, yaw = way + 0.3, yaw + 0.02
            T = T_from_R_t(exp_so3(np.array([0.0, 0.0, yaw])), np.array([way, 0.0, 0.0]))
            covariance = np.diag([1e-6, 1e-6, YAW_SIGMA_RAD**2, WAY_SIGMA_M**2, 1e-4, 1e-4])
            self.estimator.see(START_NS + round(a * 1e9), START_NS + round(b * 1e9), ScanStep(T, covariance))
        return self.estimator.estimate


def constant(offset_s):
    return lambda t: offset_s + 0.0 * t


@pytest.mark.parametrize("offset_s", [-0.08, -0.02, 0.0, 0.01, 0.05])
@pytest.mark.parametrize("motion", [brisk, straight, turning])
def test_a_constant_offset_is_found(motion, offset_s):
    found = Drive(motion, constant(offset_s), scale=1.01, bias=2e-3).run(0.0, 20.0)
    most_s = 10e-3 if motion is straight else 4e-3  # without turns, slip of the tyres looks nearly the same
    assert found.offset_s == pytest.approx(offset_s, abs=most_s)
    assert found.offset_sigma_s < most_s
    assert found.doubt == "none"


@settings(max_examples=12, deadline=None)
@given(st.floats(-0.09, 0.09), st.integers(0, 10**6))
def test_the_offset_has_its_sign_and_its_size(offset_s, seed):
    found = Drive(brisk, constant(offset_s), seed).run(0.0, 12.0)
    assert abs(found.offset_s - offset_s) < max(5.0 * found.offset_sigma_s, 2e-3)
    assert found.offset_sigma_s < 6e-3


def test_without_noise_it_is_exact():
    found = Drive(brisk, constant(0.037), noise=0.0).run(0.0, 15.0)
    assert found.offset_s == pytest.approx(0.037, abs=3e-4)


@pytest.mark.parametrize("offset_s", [0.0, 0.05, -0.05])
def test_an_even_drive_says_that_it_does_not_know(offset_s):
    found = Drive(steady, constant(offset_s)).run(0.0, 20.0)
    assert found.offset_sigma_s > 0.8 * PRIOR_S
    assert abs(found.offset_s) < 0.5 * PRIOR_S


def test_sigmas_say_how_wrong_the_offsets_are():
    """NEES of many drives that hardly tell anything, and of some that tell much."""
    gentle = [Drive(lambda t: tuple(0.3 * x for x in brisk(t)), constant(0.03), seed) for seed in range(10)]
    plain = [Drive(brisk, constant(0.03), seed) for seed in range(10)]
    for drives in (gentle, plain):
        found = [drive.run(0.0, 10.0) for drive in drives]
        nees = np.mean([((one.offset_s - 0.03) / one.offset_sigma_s) ** 2 for one in found])
        assert 0.1 < nees < 2.0


def test_a_drifting_clock_is_followed():
    drive = Drive(brisk, lambda t: 0.02 + 5e-4 * t)
    for first_s, last_s in ((0.0, 15.0), (15.0, 40.0), (40.0, 70.0)):
        found = drive.run(first_s, last_s)
        now = 0.02 + 5e-4 * (found.at_ns - START_NS) * 1e-9
        assert found.offset_s == pytest.approx(now, abs=5e-3)
        assert found.doubt == "none"
    assert found.rate == pytest.approx(5e-4, abs=2e-4)


def test_what_was_known_lasts_while_nothing_tells_more_and_fades():
    """Brisk for 20 s, then even driving for a minute and a half."""

    def motion(t):
        end = np.minimum(t, 20.0)
        speed, way, yaw_rate, yaw = brisk(end)
        later = np.maximum(t - 20.0, 0.0)
        return speed, way + speed * later, np.where(t > 20.0, 0.0, yaw_rate), yaw

    drive = Drive(motion, constant(0.04))
    first = drive.run(0.0, 20.0)
    last = drive.run(20.0, 110.0)
    assert last.offset_s == pytest.approx(0.04, abs=2.5 * last.offset_sigma_s)
    assert 2.0 * first.offset_sigma_s < last.offset_sigma_s < 0.8 * PRIOR_S


def test_wrong_steps_do_no_harm():
    found = Drive(brisk, constant(-0.03)).run(0.0, 20.0, wrong=(3, 7))
    assert found.offset_s == pytest.approx(-0.03, abs=5e-3)


@pytest.mark.parametrize("offset_s", [0.15, -0.15])
def test_an_offset_that_is_none_of_one_clock_is_said(offset_s):
    assert Drive(brisk, constant(offset_s)).run(0.0, 10.0).doubt == "large"


@pytest.mark.parametrize("rate", [4e-3, -4e-3])
def test_a_clock_that_runs_away_is_said(rate):
    drive, doubts = Drive(brisk, lambda t: rate * t), set()
    for k in range(15):
        doubts.add(drive.run(k, k + 1).doubt)
    assert doubts - {"none"} <= {"drifting", "jumped"}
    assert "drifting" in doubts


def test_a_clock_that_jumps_is_said_and_found_again():
    drive = Drive(brisk, lambda t: np.where(t < 20.0, 0.0, 0.06))
    doubts = [drive.run(k, k + 1).doubt for k in range(40)]
    assert set(doubts[:20]) <= {"none"}
    assert set(doubts[20:28]) - {"none"}
    assert drive.estimator.estimate.offset_s == pytest.approx(0.06, abs=6e-3)
    assert doubts[-1] == "none"


def test_stamps_that_begin_anew_make_all_begin_anew():
    drive = Drive(brisk, constant(0.05))
    drive.run(0.0, 10.0)
    T, covariance = np.eye(4), np.eye(6) * 1e-6
    drive.estimator.see(START_NS - 100 * S, START_NS - 100 * S + S // 10, ScanStep(T, covariance))
    assert (drive.estimator.estimate.offset_s, drive.estimator.estimate.offset_sigma_s) == (0.0, PRIOR_S)
    assert drive.buffer.clock == ClockModel()


def test_a_steps_error_counts_once_in_each_of_its_neighbours():
    """The banded whitening against the plain inverse of the whole covariance; steps 7 and 20 are left out."""
    rng = np.random.default_rng(0)
    J, rest, noise = rng.normal(size=(30, 5)), rng.normal(size=30), rng.uniform(1e-3, 4e-3, 30)
    used, joined = np.ones(30, bool), np.ones(30, bool)
    used[[7, 20]], joined[12] = False, False
    C = np.diag(noise**2)
    for k in set(range(29)) - {12}:
        C[k, k + 1] = C[k + 1, k] = -0.375 * noise[k] * noise[k + 1]
    kept = np.linalg.inv(C[np.ix_(used, used)])
    A, b = _whitened(J, rest, noise, used, joined)
    np.testing.assert_allclose(A, J[used].T @ kept @ J[used], rtol=1e-9)
    np.testing.assert_allclose(b, J[used].T @ kept @ rest[used], rtol=1e-9)


@pytest.mark.parametrize("offset_s", [0.07, -0.05])
@pytest.mark.parametrize("rate", [0.0, 1e-3])
def test_a_buffer_with_the_clock_known_gives_what_it_would_have_given_without_an_offset(offset_s, rate):
    right, late = MotionBuffer(), MotionBuffer()
    late.clock = ClockModel(5 * S, offset_s, rate)
    for k in range(500):
        t_ns = k * S // 50
        speed, _, yaw_rate, _ = brisk(t_ns * 1e-9)
        right.push(t_ns, float(speed), float(yaw_rate))
        late.push(late.clock.stamp(t_ns) + S, float(speed), float(yaw_rate)) if t_ns > 2 * S else None
    late.clock = ClockModel(5 * S, offset_s + 1.0, rate)
    for first_ns, last_ns in ((3 * S, 4 * S), (3 * S + 7, 8 * S + 12_345_678)):
        np.testing.assert_allclose(late.delta(first_ns, last_ns), right.delta(first_ns, last_ns), atol=2e-6)
    assert late.last_ns == pytest.approx(right.last_ns, abs=2)
    assert late.unknown_s(3 * S, 4 * S) == 0.0
    assert late.age_s(right.last_ns + S) == pytest.approx(1.0, abs=1e-6)
    assert MOST_S < 1.0  # the estimator never sets such a clock; the buffer does not care


def test_a_chain_of_steps_is_solved_as_scipys_banded_cholesky_does():
    rng = np.random.default_rng(4)
    for n in (1, 2, 300):
        beside, columns = np.where(rng.random(n - 1) < 0.9, SHARED, 0.0), rng.normal(size=(n, 6))
        band = np.stack([np.append(0.0, beside), np.ones(n)])
        expected = cho_solve_banded((cholesky_banded(band), False), columns)
        solve_chain(beside, np.ones(n), columns)
        np.testing.assert_allclose(columns, expected, rtol=0.0, atol=1e-14)


def test_integrals_of_samples_are_those_of_straight_lines_between_them():
    rng = np.random.default_rng(2)
    t = np.cumsum(rng.uniform(0.01, 0.03, 80))
    speed, yaw_rate = rng.normal(9.0, 1.0, 80), rng.normal(0.0, 0.2, 80)
    signal = MotionSignal.of(t, speed, yaw_rate)
    at = np.concatenate([[t[0], t[-1], t[40]], rng.uniform(t[0] - 0.5, t[-1] + 0.5, 60)])
    for found, y in zip(signal.integrals(at), (speed, yaw_rate), strict=True):
        for integral, end in zip(found, at, strict=True):
            knots = np.unique(np.concatenate([[t[0], end], t[(t > min(t[0], end)) & (t < max(t[0], end))]]))
            plain = np.trapezoid(np.interp(knots, t, y), knots) * (1.0 if end >= t[0] else -1.0)
            assert integral == pytest.approx(plain, abs=1e-11)
