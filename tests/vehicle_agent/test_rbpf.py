"""The particle filter: vectorised steps against plain twins, and against a Kalman filter where one is exact."""

from dataclasses import replace
from math import radians

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rbpf_plain import ekf, h, log_normal, unpacked

from gnd.vehicle_agent.features.errors import SlamcuParameterError
from gnd.vehicle_agent.features.slamcu import measurement
from gnd.vehicle_agent.features.slamcu.blind import GNSS_X, HEADING, X, Y
from gnd.vehicle_agent.features.slamcu.parameters import FilterParameters, MotionNoise, SlamcuParameters
from gnd.vehicle_agent.features.slamcu.rbpf import Rbpf, effective, systematic

VARIANCE = np.array([1.0, radians(2.5) ** 2])
NO_NOISE = MotionNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def rbpf_of(m: int, cov: np.ndarray | None = None, seed: int = 0, **filter_values: float) -> Rbpf:
    parameters = SlamcuParameters(filter=FilterParameters(particles=m, **filter_values), motion=NO_NOISE)
    cov = np.diag([0.3, 0.2, 1e-4]) if cov is None else cov
    return Rbpf(parameters, np.array([10.0, -4.0, 2.9]), cov, np.random.default_rng(seed))


def covariances(rng: np.random.Generator, m: int) -> np.ndarray:
    root = rng.normal(0.0, 1.0, (m, 2, 2))
    full = root @ root.swapaxes(1, 2) + 0.1 * np.eye(2)
    return full[:, [0, 0, 1], [0, 1, 1]]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_update_of_all_particles_is_the_textbook_update_of_each(seed: int) -> None:
    rng = np.random.default_rng(seed)
    m = 7
    pose = np.stack([rng.normal(0, 5, m), rng.normal(0, 5, m), rng.uniform(-3.2, 3.2, m)])
    mu = pose[:2].T + rng.uniform(8.0, 60.0, (m, 1)) * np.stack([np.cos(seed + pose[2]), np.sin(seed + pose[2])], 1)
    sigma = covariances(rng, m)
    z = h(pose[:, 0], mu[0]) + rng.normal(0.0, 1.0, 2) * np.sqrt(VARIANCE)
    new_mu, new_sigma, log_likelihood = measurement.update(pose, mu, sigma, z, VARIANCE)
    for k in range(m):
        want = ekf(pose[:, k], mu[k], unpacked(sigma[k]), z, np.diag(VARIANCE))
        assert np.allclose(new_mu[k], want[0], atol=1e-5)
        assert np.allclose(unpacked(new_sigma[k]), want[1], atol=1e-5)
        assert np.isclose(log_likelihood[k], want[2], rtol=1e-5, atol=1e-4)


def test_a_whole_sequence_agrees_with_a_loop_over_particles() -> None:
    """Weights, positions and covariances after three measurements, of a filter that may not resample."""
    rbpf = rbpf_of(40, floor=0.0, resample_below=0.0)
    truth, rng = np.array([-20.0, 6.0]), np.random.default_rng(3)
    poses = rbpf.state[:3].copy()
    plain: list[tuple[np.ndarray, np.ndarray, float]] = []
    for step in range(4):
        z = h(np.array([10.0, -4.0, 2.9]), truth) + rng.normal(0.0, 1.0, 2) * np.sqrt(VARIANCE)
        if step == 0:
            rbpf.add(z, VARIANCE)
            plain = [(rbpf.mu[0, k].copy(), unpacked(rbpf.sigma[0, k]), 0.0) for k in range(40)]
            continue
        rbpf.measure(0, z, VARIANCE, weigh=True)
        after = [ekf(poses[:, k], mu, sigma, z, np.diag(VARIANCE)) for k, (mu, sigma, _) in enumerate(plain)]
        plain = [(*new[:2], old[2] + new[2]) for new, old in zip(after, plain, strict=True)]
    assert np.allclose(rbpf.mu[0], [one[0] for one in plain], atol=1e-4)
    assert np.allclose([unpacked(row) for row in rbpf.sigma[0]], [one[1] for one in plain], atol=1e-4)
    assert np.allclose(rbpf.log_weight, [one[2] for one in plain], atol=1e-3)


def test_the_first_measurement_places_a_feature() -> None:
    rbpf = rbpf_of(5)
    z = np.array([30.0, 0.2])
    rbpf.add(z, VARIANCE)
    for k in range(5):
        assert np.allclose(h(rbpf.state[:3, k], rbpf.mu[0, k]), z)
        want = ekf(rbpf.state[:3, k], rbpf.mu[0, k], 1e9 * np.eye(2), z, np.diag(VARIANCE))
        assert np.allclose(unpacked(rbpf.sigma[0, k]), want[1], rtol=1e-3)


def test_settling_is_weighing_with_eq_17_when_the_map_has_no_error() -> None:
    """Ten measurements of a feature of the map: each weighed by Eq. (17), or compared with the map once, together."""
    at, rng = np.array([-15.0, 2.0]), np.random.default_rng(9)
    rbpf = rbpf_of(200, cov=np.diag([0.02, 0.02, 1e-5]), floor=0.0, resample_below=0.0)
    variance = np.array([0.2, radians(0.5)]) ** 2
    want = np.zeros(200)
    for step in range(10):
        z = h(np.array([10.0, -4.0, 2.9]), at) + rng.normal(0.0, 1.0, 2) * np.sqrt(variance)
        want += [log_normal(z - h(rbpf.state[:3, k], at), np.diag(variance)) for k in range(200)]  # Eq. (17)
        if step == 0:
            rbpf.add(z, variance, (at, np.zeros(3)))
        else:
            rbpf.measure(0, z, variance, weigh=True)
    provisional = rbpf.weights()
    rbpf.settle(0)
    weights = np.exp(want - want.max())
    assert np.allclose(rbpf.weights(), provisional, atol=1e-4)
    assert np.allclose(provisional, weights / weights.sum(), atol=2e-3)
    assert np.abs(rbpf.mu[0] - at).max() < 1e-9
    assert np.abs(rbpf.sigma[0]).max() < 1e-9


def test_fusing_is_adding_information() -> None:
    rng = np.random.default_rng(5)
    mu, sigma, at, cov = rng.normal(0, 3, (6, 2)), covariances(rng, 6), rng.normal(0, 3, 2), covariances(rng, 1)[0]
    got_mu, got_sigma = measurement.fused(mu, sigma, at, cov)
    log = measurement.agreement(mu, sigma, at, cov)
    for k in range(6):
        one, other = np.linalg.inv(unpacked(sigma[k])), np.linalg.inv(unpacked(cov))
        both = np.linalg.inv(one + other)
        assert np.allclose(unpacked(got_sigma[k]), both)
        assert np.allclose(got_mu[k], both @ (one @ mu[k] + other @ at))
        assert np.isclose(log[k], log_normal(mu[k] - at, unpacked(sigma[k]) + unpacked(cov)))


def test_moments_are_those_of_the_mixture() -> None:
    rbpf = rbpf_of(50)
    rbpf.add(np.array([20.0, 0.1]), VARIANCE)
    rbpf.log_weight = np.random.default_rng(1).normal(0.0, 1.0, 50)
    weights = rbpf.weights()
    mean, cov = rbpf.moments(0, weights)
    want = sum(w * mu for w, mu in zip(weights, rbpf.mu[0], strict=True))
    second = sum(
        w * (unpacked(s) + np.outer(mu, mu)) for w, mu, s in zip(weights, rbpf.mu[0], rbpf.sigma[0], strict=True)
    )
    assert np.allclose(mean, want)
    assert np.allclose(cov, second - np.outer(want, want), atol=1e-9)


@given(st.integers(0, 2**32 - 1), st.integers(1, 60))
@settings(max_examples=50)
def test_systematic_resampling_takes_each_as_often_as_it_weighs(seed: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    weights = rng.random(m) ** 4 + 1e-9
    weights /= weights.sum()
    counts = np.bincount(systematic(weights, float(rng.random())), minlength=m)
    assert counts.sum() == m
    assert (np.abs(counts - m * weights) < 1.0 + 1e-9).all()


def test_effective_number_of_particles() -> None:
    assert effective(np.full(8, 0.125)) == pytest.approx(8.0)
    assert effective(np.eye(8)[0]) == pytest.approx(1.0)


def test_jitter_keeps_mean_and_covariance_of_poses_and_features_together() -> None:
    rbpf = rbpf_of(20_000, cov=np.array([[1.0, 0.6, 0.0], [0.6, 1.0, 0.0], [0.0, 0.0, 0.01]]), jitter=0.5)
    rbpf.add(np.array([20.0, 0.1]), VARIANCE)
    together = np.concatenate([rbpf.state[:3], rbpf.mu[0].T])
    mean, cov = together.mean(axis=1), np.cov(together)
    rbpf._resample(np.full(rbpf.m, 1.0 / rbpf.m))
    again = np.concatenate([rbpf.state[:3], rbpf.mu[0].T])
    assert not np.isclose(again[0], together[0], atol=1e-3).all()
    assert np.allclose(again.mean(axis=1), mean, atol=1e-6)
    assert np.allclose(np.cov(again), cov, rtol=0.02, atol=0.03)


def test_gnss_against_a_kalman_filter() -> None:
    """A standing vehicle: position and the slow error of the GNSS are linear, so the exact posterior is known."""
    rbpf = rbpf_of(20_000, cov=np.diag([4.0, 4.0, 1e-6]), seed=2)
    noise = SlamcuParameters().gnss
    rng, sigma = np.random.default_rng(8), 2.0
    white, slow = noise.white_share * sigma**2, (1.0 - noise.white_share) * sigma**2
    mean, P = np.array([10.0, 0.0]), np.diag([4.0, slow])
    H = np.array([[1.0, 1.0]])
    for step in range(12):
        fade = np.exp(-5.0 / noise.correlation_s) if step else 1.0
        F = np.diag([1.0, fade])
        mean, P = F @ mean, F @ P @ F + np.diag([0.0, (1 - fade**2) * slow])
        fix = np.array([11.0, -4.0]) + rng.normal(0.0, 1.5, 2)
        S = (H @ P @ H.T).item() + white
        K = P @ H.T / S
        mean, P = mean + K[:, 0] * (fix[0] - mean.sum()), P - K @ H @ P
        rbpf.gnss(fix, sigma, 5.0 if step else 0.5)
        rbpf.resample_if_needed()
    weights = rbpf.weights()
    x = rbpf.state[X] @ weights
    assert x == pytest.approx(mean[0], abs=0.15)
    assert np.sqrt(np.square(rbpf.state[X] - x) @ weights) == pytest.approx(np.sqrt(P[0, 0]), rel=0.08)
    assert rbpf.state[GNSS_X] @ weights == pytest.approx(mean[1], abs=0.15)


def test_prediction_turns_and_drives() -> None:
    """A quarter of a circle of radius 10 m."""
    rbpf = rbpf_of(3, cov=np.zeros((3, 3)))
    for _ in range(1000):
        rbpf.predict(1e-3 * np.pi / 2, 10.0, 1.0)
    start = np.array([10.0, -4.0])
    left = np.array([-np.sin(2.9), np.cos(2.9)])
    ahead = np.array([np.cos(2.9), np.sin(2.9)])
    assert np.allclose(rbpf.state[[X, Y], 0], start + 10.0 * ahead + 10.0 * left, atol=1e-3)
    assert np.allclose(rbpf.state[HEADING], 2.9 + np.pi / 2)


def test_noise_of_prediction_does_not_depend_on_the_rate() -> None:
    spread = []
    for steps in (10, 100):
        parameters = SlamcuParameters(filter=FilterParameters(particles=4000))
        rbpf = Rbpf(parameters, np.zeros(3), np.zeros((3, 3)), np.random.default_rng(1))
        for _ in range(steps):
            rbpf.predict(4.0 / steps, 20.0, 0.0)
        spread.append(rbpf.state[:3].std(axis=1))
    assert np.allclose(spread[0], spread[1], rtol=0.15)


def test_standing_still_nothing_moves() -> None:
    rbpf = rbpf_of(30)
    before = rbpf.state.copy()
    rbpf.predict(10.0, 0.0, 0.01)
    assert np.array_equal(rbpf.state, before)


def test_a_likelihood_that_decides_alone_is_taken_in_steps() -> None:
    """3 m uncertain, measured to 5 cm against the map: the posterior is that of the Kalman filter, not a few copies."""
    rbpf = rbpf_of(2000, cov=np.diag([9.0, 9.0, 1e-8]), floor=0.0)
    at = np.array([-20.0, -4.0])
    variance = np.array([0.05**2, (0.05 / 30.0) ** 2])
    rbpf.add(h(np.array([10.5, -4.3, 2.9]), at), variance, (at, np.full(3, 0.0)))
    rbpf.settle(0)
    weights = rbpf.weights()
    pose, cov = rbpf.pose(weights)
    assert np.allclose(pose[:2], [10.5, -4.3], atol=0.03)
    assert np.allclose(np.sqrt(np.diag(cov)[:2]), 0.05, rtol=0.35)
    assert effective(weights) > 500.0


def test_parameters_out_of_range_are_refused() -> None:
    with pytest.raises(SlamcuParameterError, match=r"filter\.jitter = 1\.5"):
        FilterParameters(jitter=1.5)
    with pytest.raises(SlamcuParameterError, match="detection_confidence = 1"):
        SlamcuParameters(detection_confidence=1.0)
    with pytest.raises(SlamcuParameterError, match=r"motion\.scale = nan"):
        MotionNoise(scale=float("nan"))
    with pytest.raises(SlamcuParameterError, match=r"gnss\.white_share = 0"):
        replace(SlamcuParameters().gnss, white_share=0.0)
