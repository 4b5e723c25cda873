"""The fitted trees: the library that fitted them is their oracle, they act as physics asks, and know what they know."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.errors import ShapeError
from gnd.gnd_map.gaussian import Gaussians
from gnd.vehicle_agent.detect.shape_change import (
    FEATURES,
    MONOTONE,
    SIMILARITY,
    Forest,
    PlainShapeRule,
    ShapeModel,
    ShapeModelError,
    fitted,
    shape_features,
)
from studies.modified_study.rules import boosted, forest_of


def examples(n: int = 3000) -> tuple[F64, np.ndarray]:
    rng = np.random.default_rng(4)
    features = rng.uniform(0.0, 1.0, (n, len(FEATURES)))
    return features, features[:, 0] - features[:, 2] + 0.3 * rng.normal(size=n) > 0.1


def test_the_trees_give_what_the_fitting_library_gives() -> None:
    features, modified = examples()
    model = boosted(features, modified, np.ones(len(features)))
    np.testing.assert_allclose(forest_of(model).log_odds(features), model.decision_function(features))


def plain_log_odds(forest: Forest, row: F64) -> float:
    """The sum of the leaves, one node after the other."""
    total = forest.baseline
    for node in forest.root:
        at = int(node)
        while forest.feature[at] >= 0:
            at = int((forest.left if row[forest.feature[at]] <= forest.threshold[at] else forest.right)[at])
        total += forest.threshold[at]
    return float(total)


def test_the_kernel_gives_what_its_plain_twin_gives() -> None:
    model, rng = fitted(), np.random.default_rng(1)
    features = rng.uniform(model.low, model.high, (40, len(FEATURES)))
    expected = [plain_log_odds(model.forest, row) for row in features]
    np.testing.assert_allclose(model.forest.log_odds(features), expected)


def test_a_model_survives_its_file_to_the_bit() -> None:
    model, (features, _) = fitted(), examples(200)
    again = ShapeModel.from_json(model.to_json())
    np.testing.assert_array_equal(again.forest.log_odds(features), model.forest.log_odds(features))
    np.testing.assert_array_equal(again.low, model.low)
    assert (again.limit, again.alike, again.plain) == (model.limit, model.alike, model.plain)


@given(st.integers(0, 2**32 - 1), st.integers(0, len(FEATURES) - 1), st.floats(0.0, 1.0))
def test_each_feature_acts_in_its_direction(seed: int, which: int, step: float) -> None:
    features = np.random.default_rng(seed).uniform(0.0, 1.0, (20, len(FEATURES)))
    features[:, 6:8] = -9.0 + 7.0 * features[:, 6:8]  # logarithms of variances
    features[:, 5] = 3.0 + 3.0 * features[:, 5]  # logarithm of sub-cells
    more = features.copy()
    more[:, which] += step
    change = fitted().forest.log_odds(more) - fitted().forest.log_odds(features)
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
    found = fitted().reshaped(shape_features(plates(0.0), now, n_bi, n_bo, n_pi))
    assert found.tolist() == [reshaped]


def always(log_odds: float, plain: PlainShapeRule, alike: float = 2.0) -> ShapeModel:
    """Trees that say the same of everything, fitted on features from 0 to 1."""
    empty = np.empty(0, np.int32)
    forest = Forest(log_odds, empty, empty, np.empty(0), empty, empty)
    n = len(FEATURES)
    return ShapeModel(forest, 0.0, alike, np.zeros(n), np.ones(n), plain)


@pytest.mark.parametrize(
    ("value", "reshaped"),
    [(0.5, True), (1.0, True), (1.2, False), (-0.1, False)],
    ids=["within", "at the end", "above", "below"],
)
def test_outside_of_what_they_were_fitted_on_wrong_trees_do_not_decide(value: float, reshaped: bool) -> None:
    """The trees are wrong everywhere; the plain rule is asked as soon as one feature is none that they know."""
    model = always(5.0, PlainShapeRule(0, 0.9, below=False))
    features = np.full((1, len(FEATURES)), 0.5)
    features[0, 7] = value
    assert model.reshaped(features).tolist() == [reshaped]
    assert model.knows(features).tolist() == [reshaped]


def test_wrong_trees_do_not_make_a_change_of_what_is_alike() -> None:
    model = always(5.0, PlainShapeRule(0, 0.9, below=False), alike=0.6)
    features = np.full((2, len(FEATURES)), 0.5)
    features[1, SIMILARITY] = 0.7
    assert model.reshaped(features).tolist() == [True, False]


def test_features_that_are_no_numbers_are_refused() -> None:
    features = np.full((2, len(FEATURES)), 0.5)
    features[1, 3] = np.nan
    with pytest.raises(ShapeError, match="not finite"):
        always(5.0, PlainShapeRule(0, 0.9, below=False)).reshaped(features)


def test_the_plain_rule_calls_changed_what_its_threshold_says() -> None:
    features = np.zeros((3, len(FEATURES)))
    features[:, 2] = (0.2, 0.7, 0.5)
    assert PlainShapeRule(2, 0.5, below=True).reshaped(features).tolist() == [True, False, False]
    assert PlainShapeRule(2, 0.5, below=False).reshaped(features).tolist() == [False, True, False]


def test_a_gaussian_thicker_than_any_example_is_left_to_the_plain_rule() -> None:
    """A surface smeared over the whole voxel, as when the poses are lost: the trees have no such example."""
    smeared = replace(plates(0.0), cov_m2=np.array([[3.0, 0.0, 0.0, 3.0, 0.0, 3.0]], np.float32))
    n = np.array([200], np.int32)
    features = shape_features(plates(0.0), smeared, n, n, n)
    assert fitted().knows(features).tolist() == [False]
    assert fitted().reshaped(features).tolist() == fitted().plain.reshaped(features).tolist()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"features": ["other"]}, "asks? about"),
        ({"root": [10**6]}, "root names other nodes"),
        ({"left": [0]}, "left names other nodes"),
        ({"baseline": "x"}, "damaged"),
        ({"low": [0.0]}, "low"),
        ({"limit": float("nan")}, "limit nan"),
        ({"plain": {"feature": 99, "threshold": 0.1, "below": True}}, "feature 99"),
        ({"plain": {}}, "damaged"),
    ],
)
def test_a_damaged_model_is_refused(change: dict[str, object], message: str) -> None:
    text = json.dumps(json.loads(fitted().to_json()) | change)
    with pytest.raises((ShapeModelError, ShapeError), match=message):
        ShapeModel.from_json(text)


def test_a_model_that_leads_in_circles_is_refused() -> None:
    data = json.loads(fitted().to_json())
    data["right"][0] = 0
    with pytest.raises(ShapeModelError, match="leads back"):
        ShapeModel.from_json(json.dumps(data))


def test_a_truncated_model_is_refused() -> None:
    with pytest.raises(ShapeModelError, match="damaged"):
        ShapeModel.from_json(fitted().to_json()[:500])
