"""The fitted trees: the library that fitted them is their oracle, and they act as physics asks."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnd.gnd_map.gaussian import Gaussians
from gnd.vehicle_agent.detect.classify import DETECT_RESHAPED_LOG_ODDS
from gnd.vehicle_agent.detect.shape_change import FEATURES, MONOTONE, Forest, ShapeModelError, fitted, shape_features
from studies.fit_shape_change import Examples, fit, forest_of


def examples(n: int = 3000) -> Examples:
    rng = np.random.default_rng(4)
    features = rng.uniform(0.0, 1.0, (n, len(FEATURES)))
    chance = features[:, 0] - features[:, 2] + 0.3 * rng.normal(size=n)
    return Examples(features, chance > 0.1, rng.random(n) < 0.5)


def test_the_trees_give_what_the_fitting_library_gives() -> None:
    found = examples()
    model = fit(found)
    np.testing.assert_allclose(forest_of(model).log_odds(found.features), model.decision_function(found.features))


def test_a_model_survives_its_file_to_the_bit() -> None:
    forest, features = fitted(), examples(200).features
    again = Forest.from_json(forest.to_json())
    np.testing.assert_array_equal(again.log_odds(features), forest.log_odds(features))


@given(st.integers(0, 2**32 - 1), st.integers(0, len(FEATURES) - 1), st.floats(0.0, 1.0))
def test_each_feature_acts_in_its_direction(seed: int, which: int, step: float) -> None:
    features = np.random.default_rng(seed).uniform(0.0, 1.0, (20, len(FEATURES)))
    features[:, 6:8] = -9.0 + 7.0 * features[:, 6:8]  # logarithms of variances
    features[:, 5] = 3.0 + 3.0 * features[:, 5]  # logarithm of sub-cells
    more = features.copy()
    more[:, which] += step
    change = fitted().log_odds(more) - fitted().log_odds(features)
    assert (change * MONOTONE[which] >= -1e-12).all()


def plates(offset_m: float, normal: int = 0) -> Gaussians:
    cov = np.full(3, 0.08)
    cov[normal] = 0.0004
    six = np.array([[cov[0], 0.0, 0.0, cov[1], 0.0, cov[2]]], np.float32)
    mean = np.array([[offset_m, 0.0, 0.0]], np.float32)
    return Gaussians(np.array([5], np.int32), np.array([300], np.int32), np.array([90], np.int32), mean, six)


@pytest.mark.parametrize(
    ("now", "outside", "reshaped"),
    [
        (plates(0.02), 5, False),
        (plates(0.05), 40, False),
        (plates(0.35), 200, True),
        (plates(0.3, normal=1), 240, True),
    ],
    ids=["2 cm off", "5 cm off", "35 cm off", "turned by 90 degrees, 30 cm off"],
)
def test_a_plate_that_moved_or_turned_is_of_another_shape(now: Gaussians, outside: int, reshaped: bool) -> None:
    n_bi, n_bo, n_pi = (np.array([n], np.int32) for n in (250 - outside, outside, 0))
    odds = fitted().log_odds(shape_features(plates(0.0), now, n_bi, n_bo, n_pi))
    assert (odds[0] > DETECT_RESHAPED_LOG_ODDS) == reshaped


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"features": ["other"]}, "asks? about"),
        ({"root": [10**6]}, "root names other nodes"),
        ({"left": [0]}, "left names other nodes"),
        ({"baseline": "x"}, "damaged"),
    ],
)
def test_a_damaged_model_is_refused(change: dict[str, object], message: str) -> None:
    text = json.dumps(json.loads(fitted().to_json()) | change)
    with pytest.raises(ShapeModelError, match=message):
        Forest.from_json(text)


def test_a_model_that_leads_in_circles_is_refused() -> None:
    data = json.loads(fitted().to_json())
    data["right"][0] = 0
    with pytest.raises(ShapeModelError, match="leads back"):
        Forest.from_json(json.dumps(data))


def test_a_truncated_model_is_refused() -> None:
    with pytest.raises(ShapeModelError, match="damaged"):
        Forest.from_json(fitted().to_json()[:500])
