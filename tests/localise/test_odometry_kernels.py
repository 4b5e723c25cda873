"""Motion by wheels and gyro against its plain twin."""

import numpy as np
import pytest

from gnd.vehicle_agent.localise.odometry import ClockModel
from gnd.vehicle_agent.localise.odometry_kernels import integrate, resampled


def plain_resampled(known, speed, yaw_rate, first_ns, last_ns):
    inner = known[(known > first_ns) & (known < last_ns)]
    t = np.array([first_ns, *inner, *([last_ns] if last_ns > first_ns else [])], np.int64)
    if not len(known):
        return t, np.zeros(len(t)), np.zeros(len(t))
    at, x = (t - first_ns).astype(np.float64), (known - first_ns).astype(np.float64)
    return t, np.interp(at, x, speed), np.interp(at, x, yaw_rate)


def plain_integral(t, speed, yaw_rate, course):
    dt = np.diff(t) * 1e-9
    dyaw, way = 0.5 * (yaw_rate[1:] + yaw_rate[:-1]) * dt, 0.5 * (speed[1:] + speed[:-1]) * dt
    yaw = np.concatenate([[0.0], np.cumsum(dyaw)])
    chord, middle = way * np.sinc(dyaw / (2 * np.pi)), yaw[:-1] + 0.5 * dyaw
    cos, sin = np.cos(middle), np.sin(middle)
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = np.cos(yaw), -np.sin(yaw), np.sin(yaw), np.cos(yaw)
    T[1:, 0, 3] = np.cumsum(chord * (cos - course[0] * sin))
    T[1:, 1, 3] = np.cumsum(chord * (sin + course[0] * cos))
    T[1:, 2, 3] = np.cumsum(way * course[1])
    return T


@pytest.mark.parametrize("n", [0, 1, 2, 40])
@pytest.mark.parametrize("span_ns", [0, 1, 90_000_000, 2_000_000_000])
def test_motion_equals_its_plain_twin(n, span_ns):
    """With spans before, within, across and beyond the samples, also of today's nanoseconds."""
    rng, start = np.random.default_rng(n), 1_790_000_000_000_000_000
    known = start + np.cumsum(rng.integers(1, 40_000_000, n))
    speed, yaw_rate = rng.normal(10.0, 3.0, n), rng.normal(0.0, 0.3, n)
    for first_ns in (start - 3_000_000_000, start - 10, start + 100_000_000, *known[:1], start + 5_000_000_000):
        found = resampled(known, speed, yaw_rate, int(first_ns), int(first_ns) + span_ns)
        for one, plain in zip(
            found, plain_resampled(known, speed, yaw_rate, first_ns, first_ns + span_ns), strict=True
        ):
            np.testing.assert_allclose(one, plain, rtol=1e-12, atol=1e-12)
        T, course = np.empty((len(found[0]), 4, 4)), np.array([0.02, -0.01])
        integrate(*found, course, T)
        np.testing.assert_allclose(T, plain_integral(*found, course), atol=1e-11)


@pytest.mark.parametrize("rate", [0.0, 1e-4, -3.7e-5])
def test_the_time_of_one_stamp_is_that_of_many(rate: float) -> None:
    clock = ClockModel(1_700_000_000_123_456_789, 0.0421, rate)
    stamps = clock.at_ns + np.random.default_rng(5).integers(-(10**12), 10**12, 500)
    assert [clock.of_stamp(int(one)) for one in stamps] == clock.of_stamps(stamps).tolist()
