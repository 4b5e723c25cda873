"""Pairs of estimated and true features, averages over seeds, honesty of covariances."""

import numpy as np
import pytest

from studies.feature_study.truth import Honesty, match_one_to_one, nees
from studies.frame.averages import distances_plain, mean_over, rounded, std_over
from studies.frame.targets import Target, judged


def xy(*points: tuple[float, float]) -> np.ndarray:
    return np.array(points, np.float64).reshape(-1, 2)


def test_each_feature_has_one_partner_and_what_is_left_is_told() -> None:
    found = match_one_to_one(xy((0.1, 0.0), (0.4, 0.0), (50.0, 0.0)), xy((0.0, 0.0), (20.0, 0.0)))
    assert found.true.tolist() == [0]
    assert found.estimate.tolist() == [0]
    assert found.missed.tolist() == [1]
    assert found.false.tolist() == [1, 2]


def test_two_near_features_share_their_estimates_so_that_both_have_one() -> None:
    # the estimate at 1.1 m is nearest to both; the greedy pair would leave the other without
    found = match_one_to_one(xy((1.1, 0.0), (-3.0, 0.0)), xy((0.0, 0.0), (2.0, 0.0)))
    assert found.true.tolist() == [0, 1]
    assert found.estimate.tolist() == [1, 0]


def test_a_pair_beyond_the_radius_is_missed_and_false() -> None:
    found = match_one_to_one(xy((5.1, 0.0)), xy((0.0, 0.0)))
    assert (found.missed.tolist(), found.false.tolist()) == ([0], [0])
    assert len(match_one_to_one(xy((4.9, 0.0)), xy((0.0, 0.0))).true) == 1


@pytest.mark.parametrize(("estimates", "truth"), [(0, 0), (0, 3), (2, 0)])
def test_nothing_found_or_nothing_there(estimates: int, truth: int) -> None:
    found = match_one_to_one(np.zeros((estimates, 2)), np.zeros((truth, 2)))
    assert (len(found.true), len(found.missed), len(found.false)) == (0, truth, estimates)


def test_pairs_are_the_best_of_all_permutations() -> None:
    from itertools import permutations

    rng = np.random.default_rng(3)
    for _ in range(20):
        estimates, truth = rng.uniform(0, 8, (4, 2)), rng.uniform(0, 8, (4, 2))
        cost = np.minimum(np.linalg.norm(truth[:, None] - estimates[None], axis=2), 3.0)
        best = min(sum(cost[i, p] for i, p in enumerate(order)) for order in permutations(range(4)))
        found = match_one_to_one(estimates, truth, 3.0)
        ours = np.linalg.norm(truth[found.true] - estimates[found.estimate], axis=1)
        assert (ours < 3.0).all()
        assert ours.sum() + 3.0 * len(found.missed) == pytest.approx(best)


def test_means_and_deviations_keep_the_form_of_the_results() -> None:
    results = [{"a": {"b": 1.0, "c": None}, "m": [[1, 2], [3, 4]]}, {"a": {"b": 3.0, "c": 5}, "m": [[3, 2], [3, 8]]}]
    assert mean_over(results) == {"a": {"b": 2.0, "c": 5.0}, "m": [[2.0, 2.0], [3.0, 6.0]]}
    assert std_over(results)["a"] == {"b": pytest.approx(np.sqrt(2.0)), "c": None}
    assert mean_over([{"a": None}, {"a": None}]) == {"a": None}
    assert mean_over([{"a": None}, {"a": {"b": 2}}]) == {"a": {"b": 2.0}}
    assert rounded({1: 0.12345678, "x": [0.5, None, "n"]}) == {"1": 0.123457, "x": [0.5, None, "n"]}


def test_distances_of_none_have_no_mean() -> None:
    assert distances_plain(np.zeros(0))["mean"] is None
    assert distances_plain(np.array([1.0, 3.0])) == {
        "mean": 2.0, "std": 1.0, "median": 2.0, "p95": pytest.approx(2.9), "found": 2,
    }  # fmt: skip


def test_nees_of_right_covariances_is_the_dimension_and_of_small_ones_more() -> None:
    rng = np.random.default_rng(5)
    cov = np.array([[2.0, 0.7], [0.7, 0.5]])
    error = rng.multivariate_normal((0.0, 0.0), cov, 4000)
    told = np.broadcast_to(cov, (4000, 2, 2))
    assert nees(error[:1], told[:1])[0] == pytest.approx(error[0] @ np.linalg.inv(cov) @ error[0])
    right = Honesty.of(error, told)
    assert right is not None
    assert right.band[0] < right.mean < right.band[1]
    assert right.within == pytest.approx(0.95, abs=0.01)
    small = Honesty.of(error, 0.25 * told)
    assert small is not None
    assert small.mean == pytest.approx(4 * right.mean)
    assert small.within < 0.6
    assert Honesty.of(np.zeros((0, 2)), np.zeros((0, 2, 2))) is None


def test_targets_are_judged_by_their_own_direction_and_left_out_without_value() -> None:
    targets = (
        Target("share", "a.share", "%", "92", 92.0, 99.0, larger=True),
        Target("error", "a.error", "m", "0.8", 0.8, 0.4),
        Target("none", "a.none", "m", "", 1.0, 1.0),
    )
    rows = judged({"a": {"share": 95.0, "error": 0.9, "none": None}}, targets)
    assert set(rows) == {"share", "error"}
    assert (rows["share"]["met"], rows["share"]["aim_met"]) == (True, False)
    assert (rows["error"]["met"], rows["error"]["paper"]) == (False, "0.8")
