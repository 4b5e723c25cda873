"""The rays of a scan that waits: what comes back, against a plain twin and its own bounds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnd.vehicle_agent.packed_rays import PackedRays


def rays(n: int, seed: int, spread_m: float = 5.0):
    rng = np.random.default_rng(seed)
    starts = np.array([812.3, -4711.0, 31.2]) + rng.uniform(-spread_m, spread_m, (n, 3))
    return starts + rng.normal(0.0, 40.0, (n, 3)), starts


def plain(points, starts):
    """The twin in numpy."""
    centre = starts.mean(axis=0) if len(starts) else np.zeros(3)
    near = (starts - centre).astype(np.float32)
    step_m = max(float(np.abs(near).max(initial=0.0)) / 32767, 1e-4)
    packed = np.rint(near.astype(np.float64) / step_m).astype(np.int16)
    return centre, (points - centre).astype(np.float32), near, packed, step_m


@pytest.mark.parametrize("n", [0, 1, 5000])
def test_packing_equals_its_plain_twin(n: int) -> None:
    points, starts = rays(n, 3)
    centre, near_points, near_starts, packed, step_m = plain(points, starts)
    found = PackedRays.of(points, starts)
    np.testing.assert_allclose(found.centre_m, centre, atol=1e-9)
    np.testing.assert_allclose(found.points_m, near_points, atol=1e-5)
    np.testing.assert_allclose(found.from_centre()[1], near_starts, atol=0.51 * step_m + 1e-5)
    starts_of = np.repeat(found.starts, np.diff(found.until, prepend=0), axis=0)
    assert np.abs(starts_of.astype(int) - packed).max(initial=0) <= 1
    assert found.step_m == pytest.approx(step_m, rel=1e-5)
    assert (found.points_m.dtype, found.starts.dtype, found.until.dtype) == (np.float32, np.int16, np.int32)


@given(n=st.integers(0, 60), seed=st.integers(0, 2**32 - 1), spread_m=st.floats(0.0, 50.0))
def test_what_comes_back_is_near_what_came(n: int, seed: int, spread_m: float) -> None:
    points, starts = rays(n, seed, spread_m)
    packed = PackedRays.of(points, starts)
    ends, begins = packed.restore()
    assert ends.shape == begins.shape == (n, 3)
    assert np.abs(ends - points).max(initial=0.0) < 3e-5  # float32 within 300 m
    assert np.abs(begins - starts).max(initial=0.0) <= 0.51 * packed.step_m + 1e-5


def test_of_integers_and_views_too() -> None:
    points, starts = rays(40, 9)
    packed = PackedRays.of(points[::2], starts[::2].astype(np.float32))
    assert np.abs(packed.restore()[0] - points[::2]).max() < 1e-3


def test_rays_that_start_at_one_place_keep_it_once() -> None:
    points, starts = rays(300, 5)
    starts = np.repeat(starts[:100], 3, axis=0)
    starts[150] = starts[0]  # a place that comes again is a run of its own
    packed = PackedRays.of(points, starts)
    assert len(packed.starts) == len(packed.until) == 101
    assert packed.until[-1] == 300
    alone = PackedRays.of(points, starts + np.arange(300)[:, None] * 1e-3)
    assert len(alone.starts) == 300
    assert np.abs(packed.restore()[1] - starts).max() <= 0.51 * packed.step_m + 1e-5
