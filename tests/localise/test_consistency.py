"""NEES and NIS: one where errors are as large as told, far from it where an estimator is wrong and sure."""

import numpy as np
import pytest

from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_from_R_t, exp_so3
from gnd.vehicle_agent.localise.consistency import Innovations, nees_of
from gnd.vehicle_agent.localise.estimates import PoseEstimate

SIGMAS = np.array([1e-3, 1e-3, 2e-3, 0.03, 0.02, 0.05])
REFERENCE = Trajectory(np.array([0, 10**9]), np.stack([np.eye(4), T_from_R_t(np.eye(3), [10.0, 0.0, 0.0])]))


def small(rng, sigmas):
    off = rng.normal(size=6) * sigmas
    return T_from_R_t(exp_so3(off[:3]), off[3:])


def estimates(grown, n=400, shift_m=0.0):
    rng, found = np.random.default_rng(0), []
    for t_ns in np.linspace(0, 10**9, n).astype(np.int64).tolist():
        T = REFERENCE.at(t_ns) @ small(rng, grown * SIGMAS)
        T[1, 3] += shift_m
        found.append(PoseEstimate(t_ns, T, 0.03, 2e-3, 1.0, "good", covariance=np.diag(SIGMAS**2)))
    return found


@pytest.mark.parametrize("grown", [0.5, 1.0, 3.0])
def test_nees_is_the_square_of_how_much_larger_errors_are(grown):
    nees = nees_of(estimates(grown), REFERENCE)
    assert nees.n == 400
    for value in (nees.place, nees.heading, nees.joint):
        assert value == pytest.approx(grown**2, rel=0.2)


def test_an_estimator_that_is_beside_the_road_and_sure_is_shown_up():
    assert nees_of(estimates(1.0, shift_m=1.2), REFERENCE).place > 1000.0


def test_without_covariances_or_a_reference_then_there_is_none():
    assert nees_of([], REFERENCE) is None
    late = [PoseEstimate(2 * 10**9, np.eye(4), 0.03, 2e-3, 1.0, "good", covariance=np.diag(SIGMAS**2))]
    assert nees_of(late, REFERENCE) is None
    assert nees_of([PoseEstimate(0, np.eye(4), 0.03, 2e-3, 1.0, "good")], REFERENCE) is None


@pytest.mark.parametrize("grown", [1.0, 4.0])
def test_nis_of_matches_against_the_prediction(grown):
    rng, seen, covariance = np.random.default_rng(1), Innovations(), np.diag(SIGMAS**2)
    assert seen.mean is None
    for _ in range(500):
        T = small(rng, np.ones(6))
        seen.see(T, covariance, T @ small(rng, grown * np.sqrt(2.0) * SIGMAS), covariance)
    assert seen.mean == pytest.approx(grown**2, rel=0.15)
