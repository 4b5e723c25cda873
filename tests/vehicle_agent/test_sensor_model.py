"""What a vehicle learns of its camera, and that a camera that is mounted wrongly is named."""

from collections import Counter
from copy import deepcopy
from math import radians

import numpy as np
import pytest
from sign_road import Road, driven

from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters
from gnd.vehicle_agent.features.slamcu.sensor_model import (
    CONFUSED,
    DETECTED,
    LN_SIGN,
    ScaleBelief,
    SensorModel,
    Tally,
)
from gnd.vehicle_agent.features.slamcu.slamcu import Slamcu


@pytest.mark.parametrize("sigma", [0.01, 0.05, 0.1])
def test_a_standard_deviation_is_learnt_from_noisy_errors(sigma: float) -> None:
    rng, belief = np.random.default_rng(3), ScaleBelief(0.03, 0.8, 0.002, 0.15)
    for _ in range(100):
        beside = rng.uniform(0.01, 0.03)
        belief.add(float(rng.normal(0.0, np.hypot(sigma, beside))), beside**2)
    assert belief.value == pytest.approx(sigma, rel=0.4)


def test_beyond_its_bounds_nothing_is_learnt() -> None:
    belief = ScaleBelief(0.03, 0.8, 0.002, 0.15)
    for _ in range(200):
        belief.add(5.0, 1e-6)
    assert belief.value <= 0.15 + 1e-9


def test_as_long_as_nothing_is_known_errors_may_be_large() -> None:
    """What is claimed of a place goes by the mean square, which doubt about a sigma makes larger; many signs end it."""
    sensor, rng = SensorModel(0.9), np.random.default_rng(4)
    assert sensor.claimed[0] > 4.0 * sensor.held[0]
    for error in rng.normal(0.0, 0.05, 60):
        sensor.settled(np.array([error, 0.0]), np.full(2, 1e-6), np.full(2, 1.0))
    assert np.sqrt(sensor.claimed[0]) == pytest.approx(0.05, rel=0.3)
    assert sensor.claimed[0] == pytest.approx(sensor.held[0], rel=0.1)


def test_white_noise_is_followed_when_it_changes() -> None:
    rng, sensor, stated = np.random.default_rng(5), SensorModel(0.9), np.array([1.0, radians(2.5) ** 2])
    for factor in (1.0, 2.0):
        for _ in range(2500):
            sensor.measured(factor * rng.standard_normal(2) * np.sqrt(stated), np.zeros(2), stated)
        assert np.sqrt(sensor.white) == pytest.approx([factor, factor], rel=0.1)


def tally_of(looks: int, hits: int, range_m: float = 45.0) -> Tally:
    tally = Tally()
    for i in range(looks):
        tally.count(range_m, hit=i < hits)
    return tally


def test_detection_is_learnt_by_range_within_bounds_and_a_miss_counts_less_where_many_miss() -> None:
    sensor = SensorModel(0.9)
    assert (sensor.detects(75.0), sensor.miss(75.0)) == pytest.approx((0.9, 1.0))
    sensor.passed(tally_of(1000, 500, 75.0), Counter(a=500), "a")
    assert sensor.detects(75.0) == pytest.approx(0.5, abs=0.02)
    assert sensor.miss(75.0) == pytest.approx(0.3, abs=0.02)
    assert sensor.detects(35.0) == pytest.approx(0.9)  # of other ranges nothing was learnt
    sensor.passed(tally_of(10_000, 0, 75.0), Counter(), "a")
    assert sensor.detects(75.0) == DETECTED[0]


def test_kinds_are_confused_as_often_as_they_were() -> None:
    sensor = SensorModel(0.9)
    before = sensor.kind_cost({"stop": 10.0}, "yield")
    sensor.passed(tally_of(100, 80), Counter(stop=800, **{"yield": 150}), "stop")
    assert sensor.confused == pytest.approx(0.155, abs=0.01)
    assert sensor.kind_cost({"stop": 10.0}, "yield") < before
    sensor.passed(tally_of(100, 80), Counter({"yield": 100_000}), "stop")
    assert sensor.confused == CONFUSED[1]
    assert SensorModel(0.9, learns=False).kind_cost({"stop": 1.0}, "yield") == np.inf


@pytest.mark.parametrize(
    ("looks", "hits", "named", "is_sign"),
    [
        (40, 36, {"a": 35, "b": 1}, True),
        (40, 26, {"a": 25, "b": 1}, True),  # backlight: seen more seldom, always the same
        (30, 28, {"a": 20, "b": 4, "c": 4}, True),  # its kind is confused, but it is always seen
        (40, 12, {"a": 12}, False),  # seen now and then
        (40, 22, {"a": 13, "b": 5, "c": 4}, False),  # and every time as something else
    ],
)
def test_what_is_seen_now_and_then_is_no_sign(looks: int, hits: int, named: dict[str, int], is_sign: bool) -> None:
    assert (SensorModel(0.9).ln_sign(tally_of(looks, hits), named) > LN_SIGN) == is_sign


def test_a_copy_learns_for_itself() -> None:
    sensor = SensorModel(0.9)
    copied = deepcopy(sensor)
    copied.passed(tally_of(100, 10), Counter(a=10), "a")
    copied.settled(np.array([0.1, 0.05]), np.full(2, 1e-6), np.full(2, 1.0))
    assert sensor.detects(45.0) == pytest.approx(0.9)
    assert (copied.held > sensor.held).all()


SIGNS = [(x, y) for x in range(60, 960, 60) for y in (-7.0, 7.0)]


def drive_of(yaw_deg: float, share: float) -> Slamcu:
    road = Road(SIGNS, SIGNS, end_m=960.0)
    return driven(
        road, 4, SlamcuParameters(particles=1000), sensor=SensorModel(0.9), yaw_rad=radians(yaw_deg), share=share
    )


@pytest.mark.slow
def test_the_cameras_calibration_is_found() -> None:
    slamcu = drive_of(1.5, -0.04)
    mean, cov = slamcu.camera
    assert np.abs(mean - [-0.04, radians(1.5)]).max() < 0.02
    squared = float((mean - [-0.04, radians(1.5)]) @ np.linalg.solve(cov, mean - [-0.04, radians(1.5)]))
    assert squared < 13.8  # χ² of 2 degrees of freedom, 99.9 %
    assert not slamcu.camera_is_wrong
    assert all(state.feature_class == 0 for state in slamcu.known_states() if state.hits + state.misses)


@pytest.mark.slow
def test_a_camera_that_is_mounted_wrongly_is_named() -> None:
    """6° are more than any camera may be off: the filter follows, and says so."""
    slamcu = drive_of(6.0, 0.0)
    assert slamcu.camera_is_wrong
    assert not drive_of(0.0, 0.0).camera_is_wrong
