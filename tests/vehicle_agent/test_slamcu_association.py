"""Association of measurements with features, against enumeration of all ways."""

from itertools import product

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from gnd.vehicle_agent.features.slamcu.association import FORBIDDEN, associate, pair_costs


def cheapest(cost: np.ndarray, alone: float) -> float:
    """The cost of the best of all one-to-one ways, by trying each."""
    z, f = cost.shape
    best = np.inf
    for way in product(range(-1, f), repeat=z):
        used = [j for j in way if j >= 0]
        if len(used) == len(set(used)):
            best = min(best, sum(alone if j < 0 else cost[i, j] for i, j in enumerate(way)))
    return float(best)


@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 4))
@settings(max_examples=60)
def test_no_way_is_cheaper(seed: int, z: int, f: int) -> None:
    rng = np.random.default_rng(seed)
    cost = rng.uniform(-3.0, 12.0, (z, f))
    cost[rng.random((z, f)) < 0.3] = FORBIDDEN
    found = associate(cost, 5.0)
    total = 5.0 * len(found.alone) + cost[found.measurement, found.feature].sum()
    assert np.isclose(total, cheapest(cost, 5.0))
    assert len(set(found.feature.tolist())) == len(found.feature)
    assert sorted([*found.measurement.tolist(), *found.alone.tolist()]) == list(range(z))


def test_nothing_measured_and_nothing_known() -> None:
    assert len(associate(np.zeros((0, 3)), 1.0).alone) == 0
    assert associate(np.zeros((2, 0)), 1.0).alone.tolist() == [0, 1]


def test_a_measurement_goes_to_the_nearer_of_two_and_the_other_gets_the_other() -> None:
    """Taken one by one both measurements would belong to the first feature."""
    cost = np.array([[0.0, 4.0], [0.5, 1.0]])
    assert associate(cost, 10.0).feature.tolist() == [0, 1]


def test_costs_are_negative_log_likelihoods_within_the_gate() -> None:
    rng = np.random.default_rng(3)
    nu = rng.normal(0.0, 1.0, (3, 2, 2))
    root = rng.normal(0.0, 1.0, (3, 2, 2, 2))
    cov = root @ root.swapaxes(-1, -2) + 0.5 * np.eye(2)
    same = np.array([[True, True], [True, False], [True, True]])
    cost = pair_costs(nu, cov, same, 9.0)
    for i, j in product(range(3), range(2)):
        squared = nu[i, j] @ np.linalg.solve(cov[i, j], nu[i, j])
        want = -multivariate_normal(np.zeros(2), cov[i, j]).logpdf(nu[i, j])
        assert np.isclose(cost[i, j], want if same[i, j] and squared <= 9.0 else FORBIDDEN)
