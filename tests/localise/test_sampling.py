"""The points that are matched: few, spread, usable."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnd.vehicle_agent.localise.parameters import SamplingParameters
from gnd.vehicle_agent.localise.sampling import sample_candidates, sample_scan, stride_of


def cloud(n, seed=0, reach=50.0):
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(n, 3)) * [reach / 2, reach / 2, 2.0]).astype(np.float32)


@settings(deadline=None, max_examples=30)
@given(n=st.integers(0, 60_000), seed=st.integers(0, 5), wanted=st.integers(100, 3000))
def test_at_most_the_wanted_number_in_firing_order(n, seed, wanted):
    chosen = sample_scan(cloud(n, seed), SamplingParameters(n_points=wanted))
    assert len(chosen) <= wanted + 1
    assert (np.diff(chosen) > 0).all()
    assert not len(chosen) or (chosen[0] >= 0 and chosen[-1] < n)


def test_enough_points_give_about_the_wanted_number():
    assert len(sample_scan(cloud(60_000), SamplingParameters(n_points=2500))) == pytest.approx(2500, abs=1)


@pytest.mark.parametrize("n", [0, 1, 999, 60_000, 130_001])
def test_the_candidates_alone_give_the_same_points(n):
    points, parameters = cloud(n), SamplingParameters(n_points=600)
    candidates = points[:: stride_of(n, 600)]
    np.testing.assert_array_equal(
        candidates[sample_candidates(candidates, parameters)], points[sample_scan(points, parameters)]
    )


def test_few_points_are_all_looked_at():
    points = np.array([[5.0, 0.0, 0.0], [0.0, 5.0, 0.0], [5.01, 0.0, 0.0]], np.float32)
    assert sample_scan(points, SamplingParameters(), leaf_m=0.5).tolist() == [0, 1]


def test_near_far_and_broken_points_are_left_out():
    points = np.array([[1, 0, 0], [70, 0, 0], [np.nan, 5, 0], [np.inf, 0, 0], [0, 10, 0]], np.float32)
    assert sample_scan(points, SamplingParameters()).tolist() == [4]


def test_no_points_give_none():
    assert len(sample_scan(np.empty((0, 3), np.float32), SamplingParameters())) == 0


def test_points_are_spread_over_cubes():
    points = cloud(40_000, reach=12.0)
    chosen = sample_scan(points, SamplingParameters(n_points=20_000), leaf_m=1.0)
    cubes = np.unique(np.floor(points[chosen]).astype(int), axis=0)
    assert len(cubes) > 0.8 * len(chosen)  # a cube may come twice when another took its slot


def test_every_ring_of_a_sensor_is_sampled():
    """32 lasers fire in turn; a stride of 2, 4, 8 … would see few of them."""
    ring = np.tile(np.arange(32), 3000)
    azimuth = np.repeat(np.linspace(0, 2 * np.pi, 3000, endpoint=False), 32)
    points = np.column_stack([20 * np.cos(azimuth), 20 * np.sin(azimuth), ring * 0.4]).astype(np.float32)
    assert set(ring[sample_scan(points, SamplingParameters())]) == set(range(32))


def test_parameters_that_cannot_work_are_refused():
    with pytest.raises(ValueError, match=r"max_range_m = 2\.0 lies outside > 2\.5"):
        SamplingParameters(max_range_m=2.0)


def test_a_number_that_does_not_divide_the_cubes_evenly():
    """9120 cubes, 4000 wanted: steps of 2.28 added up 4000 times come out just below 9120."""
    points = np.zeros((9120, 3), np.float32)
    points[:, 0], points[:, 1] = 3.0 + np.arange(9120) % 100 * 0.5, np.arange(9120) // 100 * 0.5
    chosen = sample_scan(points, SamplingParameters(n_points=4000, max_range_m=500.0))
    assert len(chosen) <= 4000
    assert chosen.max() < 9120
