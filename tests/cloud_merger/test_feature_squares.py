"""Recursive least squares against least squares of everything at once, and covariances that mean what they say."""

import numpy as np
import pytest
from feature_cloud import TILE, change, found, merge, report
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from gnd.cloud_merger.features import FeatureMergeParameters
from gnd.cloud_merger.features.rls import PlaceEstimate, estimate, fused, step
from gnd.cloud_merger.features.window import LayerMerger, LayerState, LayerWindow
from gnd.gnd_map.features import full_covariance, hit, six_of
from gnd.schemas.features import Found

RUNS = 100


def some_places(seed, n, scale=1.0):
    """Measurements of one point with full covariances, some of them 10 times as wide along one axis."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(n):
        A = rng.normal(size=(3, 3)) * scale * np.array([1.0, 1.0, rng.choice([1.0, 10.0])])
        out.append(PlaceEstimate(rng.normal(size=(1, 3)) * 5.0, A @ A.T + 1e-2 * np.eye(3)))
    return out


def batch(places):
    """Weighted least squares of all at once, each equation divided by its Cholesky factor: numpy's lstsq."""
    whitened = [np.linalg.inv(np.linalg.cholesky(place.cov_m2)) for place in places]
    A = np.vstack(whitened)
    b = np.concatenate([W @ place.points_m[0] for W, place in zip(whitened, places, strict=True)])
    x, *_ = np.linalg.lstsq(A, b, rcond=None)
    return x, np.linalg.inv(A.T @ A)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 12), st.randoms(use_true_random=False))
def test_the_recursion_is_batch_least_squares_in_any_order(seed, n, shuffler):
    places = some_places(seed, n)
    x, P = batch(places)
    shuffler.shuffle(places)
    got = estimate(places)
    np.testing.assert_allclose(got.points_m[0], x, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(got.cov_m2, P, rtol=1e-9, atol=1e-9)


def test_what_was_known_before_is_one_more_measurement():
    known, *places = some_places(3, 6)
    x, P = batch([known, *places])
    got = estimate(places, known)
    np.testing.assert_allclose(got.points_m[0], x, atol=1e-9)
    np.testing.assert_allclose(got.cov_m2, P, atol=1e-9)


def test_the_covariance_stays_positive_where_the_plain_form_fails():
    """A measurement far better than what was known: (I - K) P loses all digits, the Joseph form none."""
    state = PlaceEstimate(np.zeros((1, 3)), np.diag([1e8, 1e8, 1e8]) + 9.9e7 * (1 - np.eye(3)))
    for _ in range(20):
        state = step(state, PlaceEstimate(np.ones((1, 3)), np.diag([1e-8, 1e-8, 1e4])))
    assert np.linalg.eigvalsh(state.cov_m2)[0] > 0
    assert np.array_equal(state.cov_m2, state.cov_m2.T)


@pytest.mark.parametrize("correlation", [0.0, 0.5, 1.0])
def test_repeats_of_one_vehicle_weigh_what_correlated_errors_leave(correlation):
    """Against generalised least squares with the full covariance of n equally good, equally correlated errors."""
    parameters = FeatureMergeParameters(repeat_correlation=correlation)
    (one,) = some_places(4, 1)
    repeats = [PlaceEstimate(one.points_m + k, one.cov_m2) for k in range(4)]
    got = fused(estimate(repeats), 4, parameters.information_of(4))
    joint = np.kron(np.full((4, 4), correlation) + (1 - correlation) * np.eye(4), one.cov_m2)
    H = np.vstack([np.eye(3)] * 4)
    inverse = np.linalg.pinv(joint)
    P = np.linalg.pinv(H.T @ inverse @ H)
    np.testing.assert_allclose(got.cov_m2, P, rtol=1e-6)
    np.testing.assert_allclose(got.points_m[0], one.points_m[0] + 1.5, rtol=1e-9)


def band(runs, dimensions):
    """Where the mean of `runs` normalised squared errors lies in 95 of 100 cases."""
    low, high = chi2.ppf([0.025, 0.975], runs * dimensions)
    return low / runs, high / runs


@pytest.mark.parametrize(("vehicles", "repeats"), [(6, 1), (4, 3)])
def test_published_covariances_are_honest_over_100_runs(vehicles, repeats):
    """Errors as told, those of one vehicle's repeats half in common: the normalised squared error is χ² of 2."""
    squares = []
    for seed in range(RUNS):
        rng = np.random.default_rng([11, seed])
        truth = rng.uniform(-8, 8, 2)
        reports = []
        for vehicle in range(vehicles):
            angle, long, short = rng.uniform(0, np.pi), rng.uniform(0.5, 1.0), rng.uniform(0.1, 0.4)
            R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ np.diag([long, short])
            common = R @ rng.normal(size=2)
            for repeat in range(repeats):
                error = (common + R @ rng.normal(size=2)) * 0.5**0.5 if repeats > 1 else common
                cov = np.zeros((3, 3))
                cov[:2, :2], cov[2, 2] = R @ R.T, 1e4
                one = Found("traffic_sign", np.array([[*(truth + error), 0.0]]), six_of(cov), hit(0.97), 4)
                reports.append(report(vehicle * repeats + repeat, change(one), vehicle=f"car-{vehicle}"))
        (got,) = merge((), reports, FeatureMergeParameters(renewal_gain=1.0)).features
        error = got.points_m[0, :2] - truth
        squares.append(error @ np.linalg.solve(full_covariance(got.cov_m2)[:2, :2], error))
    low, high = band(RUNS, 2)
    assert low < np.mean(squares) < high


def test_more_vehicles_more_accurate():
    errors = {}
    for vehicles in (2, 8, 32):
        squares = []
        for seed in range(30):
            rng = np.random.default_rng([12, seed])
            measured = rng.normal(0, 0.5, (vehicles, 2))
            reports = [report(n, change(found(*at, sigma_m=0.5))) for n, at in enumerate(measured)]
            (got,) = merge((), reports, FeatureMergeParameters(renewal_gain=1.0)).features
            squares.append((got.points_m[0, :2] ** 2).sum())
        errors[vehicles] = np.mean(squares) ** 0.5
    assert errors[8] < 0.7 * errors[2]
    assert errors[32] < 0.7 * errors[8]


@pytest.mark.parametrize(("vehicles", "repeats"), [(24, 1), (12, 4)])
def test_covariances_stay_honest_over_windows(vehicles, repeats):
    """The same, in windows of four reports, of vehicles that come by again when eight others have been there."""
    squares, wide = [], []
    for seed in range(RUNS):
        rng = np.random.default_rng([13, seed])
        truth = rng.uniform(-8, 8, 2)
        common = rng.normal(0, 0.3, (vehicles, 2))
        finds = []
        for number in range(vehicles * repeats):
            error = common[number % vehicles]
            error = (error + rng.normal(0, 0.3, 2)) * 0.5**0.5 if repeats > 1 else error
            finds.append(report(number, change(found(*(truth + error))), vehicle=f"car-{number % vehicles}"))
        merger = LayerMerger(TILE, FeatureMergeParameters(renewal_gain=1.0), {}, {})
        state = LayerState(())
        for first in range(0, len(finds), 4):
            window = LayerWindow(tuple(finds[first : first + 4]), 1)
            merged = merger.merge(state, window)
            state = merger.fold(state, merged, window)
        got = max(merged.estimates, key=lambda one: one.vehicles)  # one find in a thousand misses the gate
        error = got.points_m[0, :2] - truth
        squares.append(error @ np.linalg.solve(full_covariance(got.cov_m2)[:2, :2], error))
        assert vehicles - 1 <= got.vehicles <= vehicles
        wide.append(got.cov_m2[0] / (0.09 * (1 + 0.5 * (repeats - 1)) / repeats / vehicles))
    # no vehicle is forgotten; drives that happen to scatter by more than they claim make it a little less sure
    assert np.mean(wide) < 1.2
    assert max(wide) < 2.5
    low, high = band(RUNS, 2)
    assert low < np.mean(squares) < high
