"""The particle filter: vectorised steps against plain twins, and against a Kalman filter where one is exact."""

from math import radians

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from particle_filter_plain import ekf, full, h, log_normal, measured, unpacked

from gnd.vehicle_agent.features.errors import SlamcuParameterError
from gnd.vehicle_agent.features.slamcu import measurement, noise, particle_filter
from gnd.vehicle_agent.features.slamcu.blind import BIAS, GNSS_X, HEADING, SCALE, X, Y
from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters
from gnd.vehicle_agent.features.slamcu.particle_filter import ParticleFilter, effective, systematic

VARIANCE = np.array([1.0, radians(2.5) ** 2])


def particles_of(m: int, cov: np.ndarray | None = None, seed: int = 0) -> ParticleFilter:
    """A filter whose wheels and gyro have no lasting error."""
    cov = np.diag([0.3, 0.2, 1e-4]) if cov is None else cov
    made = ParticleFilter(m, np.array([10.0, -4.0, 2.9]), cov, np.random.default_rng(seed))
    made.state[[SCALE, BIAS]] = 0.0
    return made


@pytest.fixture
def no_floor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measurements are never another feature's: the textbook's weights."""
    monkeypatch.setattr(particle_filter, "_FLOOR", 0.0)


@pytest.fixture
def no_resampling(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(particle_filter, "_RESAMPLE_BELOW", 0.0)


def covariances(rng: np.random.Generator, m: int) -> np.ndarray:
    root = rng.normal(0.0, 1.0, (m, 2, 2))
    full = root @ root.swapaxes(1, 2) + 0.1 * np.eye(2)
    return full[:, [0, 0, 1], [0, 1, 1]]


def features_of(rng: np.random.Generator, m: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses (3, M), features (M, 4) some way ahead of them, and covariances (M, 10)."""
    pose = np.stack([rng.normal(0, 5, m), rng.normal(0, 5, m), rng.uniform(-3.2, 3.2, m)])
    angle, range_m = pose[2] + rng.uniform(-0.3, 0.3, m), rng.uniform(8.0, 60.0, m)
    place = pose[:2].T + range_m[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    root = rng.normal(0.0, 1.0, (m, 4, 4)) * np.array([1.0, 1.0, 0.05, 0.02])[:, None]
    whole = root @ root.swapaxes(1, 2) + np.diag([0.1, 0.1, 1e-4, 1e-5])
    rows, columns = np.array(measurement.PACKED).T
    return pose, np.hstack([place, rng.normal(0.0, [0.05, 0.02], (m, 2))]), whole[:, rows, columns]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_update_of_all_particles_is_the_textbook_update_of_each(seed: int) -> None:
    rng, m = np.random.default_rng(seed), 7
    pose, mean, cov = features_of(rng, m)
    camera = rng.normal(0.0, [[0.03], [0.02]], (2, m))
    z = measured(pose[:, 0], mean[0], camera[:, 0]) + rng.normal(0.0, 1.0, 2) * np.sqrt(VARIANCE)
    new_mean, new_cov, log_likelihood = measurement.update(pose, mean, cov, z, VARIANCE, camera)
    for k in range(m):
        want = ekf(pose[:, k], mean[k], full(cov[k]), z, np.diag(VARIANCE), camera[:, k])
        assert np.allclose(new_mean[k], want[0], atol=1e-5)
        assert np.allclose(full(new_cov[k]), want[1], atol=1e-5)
        assert np.isclose(log_likelihood[k], want[2], rtol=1e-5, atol=1e-4)


@pytest.mark.usefixtures("no_floor", "no_resampling")
@pytest.mark.parametrize("held", [(0.0, 0.0), (0.05**2, radians(1.0) ** 2)])
def test_a_whole_sequence_agrees_with_a_loop_over_particles(held: tuple[float, float]) -> None:
    """Weights, positions and covariances after three measurements, of a filter that may not resample."""
    particles = particles_of(40)
    particles.held = np.array(held)
    particles.calibrate(np.array([0.02, radians(0.5)]))
    truth, rng = np.array([-20.0, 6.0]), np.random.default_rng(3)
    poses = particles.state[:3].copy()
    plain: list[tuple[np.ndarray, np.ndarray, float]] = []
    for step in range(4):
        z = h(np.array([10.0, -4.0, 2.9]), truth) + rng.normal(0.0, 1.0, 2) * np.sqrt(VARIANCE)
        if step == 0:
            particles.add(z, VARIANCE)
            plain = [(particles.mean[0, k].copy(), full(particles.cov[0, k]), 0.0) for k in range(40)]
            continue
        particles.measure(0, z, VARIANCE, weigh=True)
        ways = [(*one[:2], z, np.diag(VARIANCE), particles.camera[:, k]) for k, one in enumerate(plain)]
        after = [ekf(poses[:, k], *way) for k, way in enumerate(ways)]
        plain = [(*new[:2], old[2] + new[2]) for new, old in zip(after, plain, strict=True)]
    assert np.allclose(particles.mean[0], [one[0] for one in plain], atol=1e-4)
    assert np.allclose([full(row) for row in particles.cov[0]], [one[1] for one in plain], atol=1e-4)
    assert np.allclose(particles.log_weight, [one[2] for one in plain], atol=1e-3)


@pytest.mark.parametrize("held", [(0.0, 0.0), (0.05**2, radians(1.0) ** 2)])
def test_the_first_measurement_places_a_feature(held: tuple[float, float]) -> None:
    particles, none = particles_of(5), np.zeros(2)
    z, particles.held = np.array([30.0, 0.2]), np.array(held)
    particles.calibrate(np.array([0.02, radians(0.5)]))
    particles.add(z, VARIANCE)
    for k in range(5):
        pose, camera = particles.state[:3, k], particles.camera[:, k]
        assert np.allclose(measured(pose, particles.mean[0, k], camera), z)
        before = np.diag([1e9, 1e9, *held])
        want = ekf(pose, np.array([*particles.mu[0, k], *none]), before, z, np.diag(VARIANCE), camera)
        assert np.allclose(full(particles.cov[0, k]), want[1], rtol=1e-3, atol=1e-5)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_another_prior_is_that_of_a_filter_which_had_it_from_the_start(seed: int) -> None:
    """Of a linear feature, as the information filter has it: Σ'⁻¹ = Σ⁻¹ + D'⁻¹ - D⁻¹ in the errors that stay."""
    rng, m = np.random.default_rng(seed), 5
    _, mean, cov = features_of(rng, m)
    before, after = cov[:, [7, 9]].max(axis=0) * rng.uniform(1.2, 3.0, 2), rng.uniform(1e-4, 5e-2, 2)
    new_mean, new_cov = measurement.with_prior(mean, cov, before, after)
    for k in range(m):
        information = np.linalg.inv(full(cov[k]))
        changed = information + np.diag([0.0, 0.0, *(1.0 / after - 1.0 / before)])
        if np.linalg.eigvalsh(changed)[0] <= 1e-6:
            continue  # no prior of that size can have led here: the two errors go together too closely
        assert np.allclose(full(new_cov[k]), np.linalg.inv(changed), rtol=1e-5, atol=1e-9)
        assert np.allclose(new_mean[k], np.linalg.solve(changed, information @ mean[k]), rtol=1e-5, atol=1e-7)
    same = measurement.with_prior(mean, cov, before, before)
    assert np.allclose(same[0], mean)
    assert np.allclose(same[1], cov)


@pytest.mark.usefixtures("no_floor", "no_resampling")
def test_settling_is_weighing_with_eq_17_when_the_map_has_no_error() -> None:
    """Ten measurements of a feature of the map: each weighed by Eq. (17), or compared with the map once, together."""
    at, rng = np.array([-15.0, 2.0]), np.random.default_rng(9)
    particles = particles_of(200, cov=np.diag([0.02, 0.02, 1e-5]))
    variance = np.array([0.2, radians(0.5)]) ** 2
    want = np.zeros(200)
    for step in range(10):
        z = h(np.array([10.0, -4.0, 2.9]), at) + rng.normal(0.0, 1.0, 2) * np.sqrt(variance)
        want += [log_normal(z - h(particles.state[:3, k], at), np.diag(variance)) for k in range(200)]  # Eq. (17)
        if step == 0:
            particles.add(z, variance, (at, np.zeros(3)))
        else:
            particles.measure(0, z, variance, weigh=True)
    provisional = particles.weights()
    particles.settle(0)
    weights = np.exp(want - want.max())
    assert np.allclose(particles.weights(), provisional, atol=1e-4)
    assert np.allclose(provisional, weights / weights.sum(), atol=2e-3)
    assert np.abs(particles.mu[0] - at).max() < 1e-9
    assert np.abs(particles.sigma[0]).max() < 1e-9


def test_fusing_is_adding_information() -> None:
    rng = np.random.default_rng(5)
    (_, mean, cov), at, other = features_of(rng, 6), rng.normal(0, 3, 2), covariances(rng, 1)[0]
    got_mean, got_cov = measurement.fused(mean, cov, at, other)
    log = measurement.agreement(mean[:, :2], cov[:, :3], at, other)
    for k in range(6):
        told = np.zeros((4, 4))
        told[:2, :2] = np.linalg.inv(unpacked(other))
        both = np.linalg.inv(np.linalg.inv(full(cov[k])) + told)
        assert np.allclose(full(got_cov[k]), both, atol=1e-6)
        assert np.allclose(
            got_mean[k], both @ (np.linalg.inv(full(cov[k])) @ mean[k] + told @ [*at, 0.0, 0.0]), atol=1e-6
        )
        assert np.isclose(log[k], log_normal(mean[k, :2] - at, full(cov[k])[:2, :2] + unpacked(other)))


def test_moments_are_those_of_the_mixture() -> None:
    particles = particles_of(50)
    particles.add(np.array([20.0, 0.1]), VARIANCE)
    particles.log_weight = np.random.default_rng(1).normal(0.0, 1.0, 50)
    weights = particles.weights()
    mean, cov = particles.moments(0, weights)
    want = sum(w * mu for w, mu in zip(weights, particles.mu[0], strict=True))
    second = sum(
        w * (unpacked(s) + np.outer(mu, mu))
        for w, mu, s in zip(weights, particles.mu[0], particles.sigma[0], strict=True)
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
    particles = particles_of(20_000, cov=np.array([[1.0, 0.6, 0.0], [0.6, 1.0, 0.0], [0.0, 0.0, 0.01]]))
    particles.add(np.array([20.0, 0.1]), VARIANCE)
    together = np.concatenate([particles.state[:3], particles.mu[0].T])
    mean, cov = together.mean(axis=1), np.cov(together)
    particles._resample(np.full(particles.m, 1.0 / particles.m))
    again = np.concatenate([particles.state[:3], particles.mu[0].T])
    assert not np.isclose(again[0], together[0], atol=1e-3).all()
    assert np.allclose(again.mean(axis=1), mean, atol=1e-6)
    assert np.allclose(np.cov(again), cov, rtol=0.02, atol=0.03)


def test_gnss_against_a_kalman_filter() -> None:
    """A standing vehicle: position and the slow error of the GNSS are linear, so the exact posterior is known."""
    particles = particles_of(20_000, cov=np.diag([4.0, 4.0, 1e-6]), seed=2)
    rng, sigma = np.random.default_rng(8), 2.0
    white, slow = noise.gnss_variances_m2(sigma)
    mean, P = np.array([10.0, 0.0]), np.diag([4.0, slow])
    H = np.array([[1.0, 1.0]])
    for step in range(12):
        fade = np.exp(-5.0 / noise.GNSS_CORRELATION_S) if step else 1.0
        F = np.diag([1.0, fade])
        mean, P = F @ mean, F @ P @ F + np.diag([0.0, (1 - fade**2) * slow])
        fix = np.array([11.0, -4.0]) + rng.normal(0.0, 1.5, 2)
        S = (H @ P @ H.T).item() + white
        K = P @ H.T / S
        mean, P = mean + K[:, 0] * (fix[0] - mean.sum()), P - K @ H @ P
        particles.gnss(fix, sigma, 5.0 if step else 0.5)
        particles.resample_if_needed()
    weights = particles.weights()
    x = particles.state[X] @ weights
    assert x == pytest.approx(mean[0], abs=0.15)
    assert np.sqrt(np.square(particles.state[X] - x) @ weights) == pytest.approx(np.sqrt(P[0, 0]), rel=0.08)
    assert particles.state[GNSS_X] @ weights == pytest.approx(mean[1], abs=0.15)


def test_prediction_turns_and_drives() -> None:
    """A quarter of a circle of radius 10 m."""
    particles = particles_of(1, cov=np.zeros((3, 3)))  # one particle has no noise
    for _ in range(1000):
        particles.predict(1e-3 * np.pi / 2, 10.0, 1.0)
    start = np.array([10.0, -4.0])
    left = np.array([-np.sin(2.9), np.cos(2.9)])
    ahead = np.array([np.cos(2.9), np.sin(2.9)])
    assert np.allclose(particles.state[[X, Y], 0], start + 10.0 * ahead + 10.0 * left, atol=1e-3)
    assert np.allclose(particles.state[HEADING], 2.9 + np.pi / 2)


def test_noise_of_prediction_does_not_depend_on_the_rate() -> None:
    spread = []
    for steps in (10, 100):
        particles = ParticleFilter(4000, np.zeros(3), np.zeros((3, 3)), np.random.default_rng(1))
        for _ in range(steps):
            particles.predict(4.0 / steps, 20.0, 0.0)
        spread.append(particles.state[:3].std(axis=1))
    assert np.allclose(spread[0], spread[1], rtol=0.15)


def test_standing_still_nothing_moves() -> None:
    particles = particles_of(30)
    before = particles.state.copy()
    particles.predict(10.0, 0.0, 0.01)
    assert np.array_equal(particles.state, before)


@pytest.mark.usefixtures("no_floor")
def test_a_likelihood_that_decides_alone_is_taken_in_steps() -> None:
    """3 m uncertain, measured to 5 cm against the map: the posterior is that of the Kalman filter, not a few copies."""
    particles = particles_of(2000, cov=np.diag([9.0, 9.0, 1e-8]))
    at = np.array([-20.0, -4.0])
    variance = np.array([0.05**2, (0.05 / 30.0) ** 2])
    particles.add(h(np.array([10.5, -4.3, 2.9]), at), variance, (at, np.full(3, 0.0)))
    particles.settle(0)
    weights = particles.weights()
    pose, cov = particles.pose(weights)
    assert np.allclose(pose[:2], [10.5, -4.3], atol=0.03)
    assert np.allclose(np.sqrt(np.diag(cov)[:2]), 0.05, rtol=0.35)
    assert effective(weights) > 500.0


def test_parameters_out_of_range_are_refused() -> None:
    with pytest.raises(SlamcuParameterError, match="particles = 0"):
        SlamcuParameters(particles=0)
    with pytest.raises(SlamcuParameterError, match="detection_confidence = 1"):
        SlamcuParameters(detection_confidence=1.0)
    with pytest.raises(SlamcuParameterError, match="detection_confidence = nan"):
        SlamcuParameters(detection_confidence=float("nan"))


def test_eq_17_is_the_line_of_the_paper_with_the_factor_that_it_lacks() -> None:
    rng = np.random.default_rng(17)
    pose, sign = np.stack([rng.normal(0, 2, 50), rng.normal(0, 2, 50), rng.normal(0, 0.1, 50)]), np.array([40.0, 5.0])
    z, R = np.array([39.0, 0.1]), np.diag(VARIANCE)
    got = measurement.map_log_likelihood(pose, sign, z, VARIANCE, np.zeros((2, 50)))
    for k in range(50):
        x, y, heading = pose[:, k]
        off = np.arctan2(sign[1] - y, sign[0] - x) - heading
        nu = z - np.array([np.hypot(sign[0] - x, sign[1] - y), off])
        printed = float(nu @ np.linalg.inv(R) @ nu)  # (z - ẑ)ᵀ R⁻¹ (z - ẑ), what stands in the exponent
        weight = np.linalg.det(2.0 * np.pi * R) ** -0.5 * np.exp(-0.5 * printed)
        assert np.exp(got[k]) == pytest.approx(weight, rel=1e-9)
    near_and_far = np.array([[1.0, 9.0], [1.0, 9.0], [0.0, 0.0]])
    near, far = measurement.map_log_likelihood(near_and_far, sign, z, VARIANCE, np.zeros((2, 2)))
    assert near > far  # without the factor the particle that fits worst would win


@pytest.mark.usefixtures("no_floor", "no_resampling")
def test_as_printed_a_sign_of_the_map_weighs_at_each_look_and_not_again_when_it_is_settled() -> None:
    filter_, sign = particles_of(60), np.array([-20.0, 4.0])
    filter_.as_printed = True
    z = np.array(h(np.array([10.0, -4.0, 2.9]), sign))
    filter_.add(z, VARIANCE, (sign, np.array([0.04, 0.0, 0.04])))
    before = filter_.log_weight.copy()
    expected = 3 * measurement.map_log_likelihood(filter_.state[:3], sign, z, VARIANCE, filter_.camera)
    for _ in range(3):
        filter_.measure(0, z, VARIANCE, weigh=True)
    assert filter_.log_weight - before == pytest.approx(expected)
    assert filter_.weights() == pytest.approx(np.exp(expected) / np.exp(expected).sum())
    filter_.settle(0)
    assert filter_.log_weight - before == pytest.approx(expected)


@pytest.mark.usefixtures("no_resampling")
def test_as_printed_a_wrong_sign_of_the_map_is_believed_more_than_it_knows() -> None:
    """A map sign 1.5 m off, of sigma 1 m, looked at 60 times: Eq. 17 takes its place as exact at each look, and the
    vehicle is certain of a pose that is off; taken in once, the map's error stays in what the vehicle claims.
    """
    true, sign = np.array([10.0, -4.0, 2.9]), np.array([-20.0, 4.0])
    wrong = sign + np.array([1.5 * np.cos(2.9), 1.5 * np.sin(2.9)])  # along the way
    z, claimed = np.array(h(true, sign)), {}
    for as_printed in (False, True):
        filter_ = particles_of(4000, np.diag([1.0, 1.0, 1e-6]))
        filter_.as_printed = as_printed
        filter_.add(z, VARIANCE, (wrong, np.array([1.0, 0.0, 1.0])))
        for _ in range(60):
            filter_.measure(0, z, VARIANCE, weigh=True)
        pose, cov = filter_.pose(filter_.weights())
        off = pose[:2] - true[:2]
        claimed[as_printed] = float(off @ np.linalg.inv(cov[:2, :2]) @ off)
    assert claimed[False] < 6.0 < 13.8 < claimed[True]  # chi-square of two: 95 % and 99.9 %
