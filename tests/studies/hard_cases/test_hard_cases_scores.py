"""What poses of a hard case are worth: limits, shares, and a NEES that knows its covariance."""

from dataclasses import replace

import numpy as np
import pytest

from gnd.gnd_map.motion import Trajectory
from gnd.vehicle_agent.localise.estimates import PoseEstimate
from studies.hard_cases.localising import HEALTHS, Poses
from studies.hard_cases.scores import is_wrong, joined, nees_of, row_of

GOOD, DEGRADED, LOST = (HEALTHS.index(name) for name in ("good", "degraded", "lost"))
COVARIANCE = np.array([[4e-4, 1e-4, 1e-5], [1e-4, 1e-4, 0.0], [1e-5, 0.0, 4e-6]])


def poses(error, health=GOOD, covariance=COVARIANCE):
    error = np.atleast_2d(np.asarray(error, dtype=float))
    healths = np.full(len(error), health, np.uint8) if np.isscalar(health) else np.array(health, np.uint8)
    return Poses(np.arange(len(error), dtype=np.int64), error, np.tile(covariance, (len(error), 1, 1)), healths)


def test_a_pose_is_wrong_by_its_horizontal_distance_or_its_heading():
    off = np.array([[0.43, 0.0, 0.0], [0.32, 0.32, 0.0], [0.45, 0.0, 0.0], [0.0, 0.0, 0.0086], [0.0, 0.0, -0.0089]])
    assert is_wrong(poses(off)).tolist() == [False, True, True, False, True]


def test_wrong_called_good_and_right_called_bad_are_counted():
    error = np.array([[1.0, 0, 0], [1.0, 0, 0], [0.1, 0, 0], [0.1, 0, 0], [0.1, 0, 0], [5.0, 0, 0]])
    row = row_of(poses(error, [GOOD, DEGRADED, GOOD, DEGRADED, LOST, LOST]), 7)
    assert row["wrong_called_good"] == 1
    assert row["wrong_called_good_share"] == pytest.approx(1 / 4)
    assert row["right_called_bad_poses"] == 2
    assert row["right_called_bad"] == pytest.approx(2 / 6)
    assert (row["poses"], row["good_poses"], row["scans"]) == (4, 2, 7)


def test_errors_are_of_all_poses_that_are_not_called_lost():
    row = row_of(poses([[0.1, 0.2, np.radians(0.3)], [-0.1, -0.2, 0.0], [50.0, 50.0, 1.0]], [GOOD, DEGRADED, LOST]), 3)
    assert row["longitudinal_m"]["max"] == pytest.approx(0.1)
    assert row["lateral_m"]["p95"] == pytest.approx(0.2)
    assert row["heading_deg"]["max"] == pytest.approx(0.3)
    assert row["p95_good"]["lateral_m"] == pytest.approx(0.2)


def test_without_poses_there_are_no_figures():
    row = row_of(poses(np.empty((0, 3))), 5)
    assert row["longitudinal_m"] is None
    assert row["nees"] is None
    assert row["p95_good"] == {"longitudinal_m": None, "lateral_m": None, "heading_deg": None}
    assert (row["poses"], row["wrong_called_good"], row["right_called_bad"]) == (0, 0, 0.0)


@pytest.mark.parametrize(("factor", "expected"), [(1.0, 1.0), (0.25, 4.0), (4.0, 0.25)])
def test_nees_is_one_for_honest_covariances_and_more_for_those_that_claim_too_much(factor, expected):
    drawn = np.random.default_rng(1).multivariate_normal(np.zeros(3), COVARIANCE, 20_000)
    found = poses(drawn, covariance=factor * COVARIANCE)
    nees = nees_of(found, np.ones(len(found), bool))
    for name in ("place", "heading", "joint"):
        assert nees[name] == pytest.approx(expected, rel=0.03)


def test_nees_leaves_out_poses_without_a_covariance_and_those_that_were_not_chosen():
    known, unknown = poses([[0.02, 0.0, 0.0]]), poses([[9.0, 9.0, 9.0]], covariance=np.full((3, 3), np.nan))
    both = joined([known, unknown, poses([[9.0, 0.0, 0.0]])])
    nees = nees_of(both, np.array([True, True, False]))
    assert nees["poses"] == 1
    assert nees["place"] == nees_of(known, np.ones(1, bool))["place"]
    assert nees_of(unknown, np.ones(1, bool)) is None


def test_poses_are_compared_in_the_vehicle_frame_with_the_covariance_in_the_same_order():
    turn = np.eye(4)
    turn[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]  # the vehicle looks north
    true = Trajectory(np.array([0, 100], np.int64), np.stack([turn, turn]))
    T = turn.copy()
    T[1, 3] = 0.3  # farther north: ahead
    claimed = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    estimate = PoseEstimate(50, T, 0.1, 0.01, 1.0, "good", covariance=claimed)
    found = Poses.of([estimate, replace(estimate, t_ns=500), replace(estimate, t_ns=80, covariance=None)], true)
    assert len(found) == 2
    assert found.error[0] == pytest.approx([0.3, 0.0, 0.0], abs=1e-12)
    assert np.diag(found.covariance[0]).tolist() == [4.0, 5.0, 3.0]
    assert np.isnan(found.covariance[1]).all()
