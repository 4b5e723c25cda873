"""The graph by construction: a ring driven twice with drifting odometry, loops true and false, fixes good and bad."""

import numpy as np
import pytest

from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3
from gnd.vehicle_agent.map_build.loops import Loop
from gnd.vehicle_agent.map_build.pose_graph import GnssTies, bent, solve
from gnd.vehicle_agent.map_build.refine_poses import drift

NO_FIXES = GnssTies(np.empty(0, np.int64), np.empty((0, 3)), np.empty(0))
N = 60  # anchors of one round of 600 m


def ring() -> np.ndarray:
    """Two rounds: (2 N, 4, 4) true poses."""
    angle = 2 * np.pi * np.arange(2 * N) / N
    r = 600 / (2 * np.pi)
    R = exp_so3(np.c_[np.zeros((2 * N, 2)), angle + np.pi / 2])
    return T_from_R_t(R, np.c_[r * np.cos(angle), r * np.sin(angle), np.zeros(2 * N)])


def drifting(T: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    steps = T_inverse(T[:-1]) @ T[1:]
    steps[:, :3, 3] *= 1.004
    steps[:, :3, :3] = steps[:, :3, :3] @ exp_so3(np.radians(0.08) * rng.standard_normal((len(steps), 3)))
    found = [T[0]]
    for step in steps:
        found.append(found[-1] @ step)
    return np.stack(found)


def loop(T: np.ndarray, early: int, late: int, shift_m: float = 0.0) -> Loop:
    seen = T_inverse(T[early]) @ T[late]
    seen[0, 3] += shift_m
    return Loop(early, late, seen, np.diag([1e-3**2] * 3 + [0.02**2] * 3), 0.8)


def error_m(T: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(T[:, :3, 3] - truth[:, :3, 3], axis=1).max())


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_loops_bring_the_rounds_together_and_false_ones_are_left_out(seed: int) -> None:
    rng, truth = np.random.default_rng(seed), ring()
    T, drive = drifting(truth, rng), np.zeros(2 * N, np.int64)
    true = [loop(truth, k, k + N) for k in range(0, N, 3)]
    false = [loop(truth, k, k + N, shift_m=25.0) for k in range(1, N, 9)]
    solved = solve(drive, T, true + false, NO_FIXES)
    assert solved.loops[: len(true)].all()
    assert not solved.loops[len(true) :].any()
    assert error_m(solved.T, truth) < 0.55 * error_m(T, truth)
    before, after = drift(T, true), drift(solved.T, true)
    assert before is not None
    assert after is not None
    assert before.horizontal_m > 1.0
    assert after.horizontal_m < 0.05


def test_with_false_loops_alone_the_odometry_is_kept() -> None:
    """A few loops that neither the odometry nor each other can be bent to."""
    truth = ring()
    T, drive = drifting(truth, np.random.default_rng(4)), np.zeros(2 * N, np.int64)
    false = [loop(truth, k, k + N, shift_m=(-1) ** k * 40.0) for k in range(0, N, 10)]
    solved = solve(drive, T, false, NO_FIXES)
    assert not solved.loops.any()
    np.testing.assert_allclose(solved.T, T, atol=1e-6)


def test_fixes_place_a_drive_and_a_jump_of_theirs_does_not() -> None:
    truth = ring()
    rng, drive = np.random.default_rng(5), np.zeros(2 * N, np.int64)
    T = drifting(truth, rng)
    T = T_from_R_t(exp_so3([0.0, 0.0, 0.02]), np.array([8.0, -5.0, 0.0])) @ T
    at = np.arange(0, 2 * N, 2)
    p = truth[at, :3, 3] + 0.5 * rng.standard_normal((len(at), 3))
    p[10:16] += [120.0, 40.0, 0.0]
    solved = solve(drive, T, [], GnssTies(at, p, np.full(len(at), 1.0)))
    assert not solved.fixes[10:16].any()
    assert solved.fixes.sum() > 0.9 * (len(at) - 6)
    assert error_m(solved.T, truth) < 0.4 * error_m(T, truth)


def test_a_second_drive_is_laid_onto_the_first() -> None:
    truth = ring()
    drive = np.repeat([0, 1], N)
    T = truth.copy()
    T[N:] = T_from_R_t(exp_so3([0.0, 0.0, 0.03]), np.array([4.0, 3.0, -0.5])) @ T[N:]
    solved = solve(drive, T, [loop(truth, k, k + N) for k in range(0, N, 6)], NO_FIXES)
    assert error_m(solved.T, truth) < 0.1


def test_a_track_bends_with_its_anchors_and_stays_smooth() -> None:
    truth = ring()[:30]
    t_ns = np.arange(30) * 1_000_000_000
    fine = np.arange(0, 29_000_000_001, 100_000_000)
    track = Trajectory(fine, Trajectory(t_ns, truth).at(fine))
    at = np.arange(2, 30, 3)
    moved = truth[at].copy()
    moved[:, :3, 3] += np.c_[np.linspace(0, 3, len(at)), np.zeros(len(at)), np.linspace(0, -0.4, len(at))]
    found = bent(track, t_ns[at], truth[at], moved)
    np.testing.assert_allclose(found.at(t_ns[at]), moved, atol=1e-9)
    step = np.linalg.norm(np.diff(found.T_dst_vehicle[:, :3, 3], axis=0), axis=1)
    assert np.abs(step - 1.0).max() < 0.05
    same = bent(track, t_ns[at], truth[at], truth[at])
    np.testing.assert_allclose(same.T_dst_vehicle, track.T_dst_vehicle, atol=1e-9)
    one = bent(track, t_ns[at[:1]], truth[at[:1]], moved[1:2])
    np.testing.assert_allclose(one.at(t_ns[at[0]]), moved[1], atol=1e-9)
