"""The ray kernel against its plain twin, and the properties of its walk."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from plain_rays import PlainDetector, PlainMap

from gnd.vehicle_agent.detect.kernel import (
    cast_rays,
    confidence,
    kernel_parameters,
    quantile,
    window_affine,
)
from gnd.vehicle_agent.detect.parameters import MEASURED_RULES, DetectParameterError, DetectParameters
from gnd.vehicle_agent.detect.records import N_BI, N_BO, N_PI, N_PO, make_records
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty
from gnd.vehicle_agent.local_map import EMPTY, UNKNOWN

SHAPE = (14, 12, 9)
A_GRID = np.array([[1.021, 0.013, 0.0], [-0.011, 1.018, 0.0002], [0.0, 0.0001, 1.0]])  # a grid turned and stretched
EXACT, VAGUE = PoseUncertainty(), PoseUncertainty(0.06, 0.02)
ANCHOR = np.array([3.0, -2.0, 30.0])


def random_world(rng: np.random.Generator, n: int = 260) -> PlainMap:
    """Planes, lines and clutter in random voxels, some voxels unknown."""
    index = np.full(SHAPE, EMPTY, np.int32)
    voxels = rng.choice(np.prod(SHAPE), n, replace=False)
    index.reshape(-1)[voxels] = np.arange(n)
    index[0:2, 0:3] = np.where(index[0:2, 0:3] >= 0, index[0:2, 0:3], UNKNOWN)
    centre = np.stack(np.unravel_index(voxels, SHAPE), axis=1) + 0.5
    mean = np.linalg.solve(A_GRID, (centre + rng.uniform(-0.3, 0.3, (n, 3))).T).T
    spread = np.sort(rng.choice([0.01, 0.05, 0.15, 0.3], (n, 3)), axis=1)
    turn = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    return PlainMap(SHAPE, mean, turn @ (spread[:, :, None] ** 2 * np.eye(3)) @ turn.transpose(0, 2, 1), index)


def kernel_run(
    world: PlainMap, p: DetectParameters, points: np.ndarray, origins: np.ndarray, b: np.ndarray, moving: np.ndarray,
    pose: PoseUncertainty,
):  # fmt: skip
    cov6 = world.cov[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    records = make_records(world.mean, cov6, np.zeros(3), p)
    state, kept = world.index.copy(), np.zeros(len(points), np.uint8)
    cast = cast_rays(
        points, origins, np.zeros(3), A_GRID, b, state.reshape(-1), state.shape, records.words, records.floats,
        records.block, kernel_parameters(p, pose), moving, kept,
    )  # fmt: skip
    return records.words, state, kept, cast


@pytest.mark.parametrize("rule", ["ml", "ahead", "plane"])
@pytest.mark.parametrize(("seed", "pose"), [(1, EXACT), (2, EXACT), (3, VAGUE), (4, VAGUE)])
def test_kernel_counts_what_the_plain_twin_counts(rule: str, seed: int, pose: PoseUncertainty) -> None:
    rng = np.random.default_rng(seed)
    world = random_world(rng)
    p = DetectParameters(range_min_m=1.0, range_max_m=11.0, own_rules=replace(MEASURED_RULES, passing_rule=rule))
    n = 500
    inside = rng.uniform([1, 1, 1], np.array(SHAPE) - 1, (n, 3))
    origins = np.linalg.solve(A_GRID, (np.array([7.0, 6.0, 4.0]) + rng.uniform(-0.5, 0.5, (n, 3))).T).T
    points = np.linalg.solve(A_GRID, inside.T).T
    points[: n // 3] = world.mean[rng.integers(0, len(world.mean), n // 3)] + rng.normal(0, 0.15, (n // 3, 3))
    points[-40:] += rng.normal(0, 20, (40, 3))  # beyond the range and the window
    b, moving = np.zeros(3), rng.random(n) < 0.15

    words, state, kept, _ = kernel_run(world, p, points, origins, b, moving, pose)

    plain = PlainDetector(world, p, quantile, A_GRID, b, pose)
    for origin, point, moves in zip(origins, points, moving, strict=True):
        plain.ray(origin, point, moves)
    for column, expected in ((N_BI, plain.bi), (N_BO, plain.bo), (N_PI, plain.pi), (N_PO, plain.po)):
        np.testing.assert_array_equal(words[:, column], expected)
    assert min(plain.bi.sum(), plain.bo.sum(), plain.pi.sum(), plain.po.sum(), plain.pe.sum()) > 5
    np.testing.assert_array_equal(np.where(world.index == EMPTY, EMPTY - state, 0), plain.pe)
    np.testing.assert_array_equal(state[world.index != EMPTY], world.index[world.index != EMPTY])
    np.testing.assert_array_equal(kept.astype(bool), plain.kept)


def walked(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Voxels (K, 3) that the kernel counts as passed between two points of window coordinates, each with its count."""
    p = kernel_parameters(replace(DetectParameters(), range_min_m=0.0, range_max_m=400.0))
    state = np.full((40, 40, 40), EMPTY, np.int32)
    nothing = make_records(np.empty((0, 3)), np.empty((0, 6)), np.zeros(3), DetectParameters())
    cast_rays(
        end[None], start[None], np.zeros(3), np.eye(3), np.zeros(3), state.reshape(-1), state.shape, nothing.words,
        nothing.floats, nothing.block, p, np.zeros(1, np.bool_), np.zeros(1, np.uint8),
    )  # fmt: skip
    assert state.max() == EMPTY
    assert state.min() >= EMPTY - 1, "a voxel was passed twice"
    return np.argwhere(state == EMPTY - 1)


def assert_is_a_walk(start: np.ndarray, end: np.ndarray) -> None:
    first, last = np.floor(start).astype(int), np.floor(end).astype(int)
    passed = walked(start, end)
    assert len(passed) == np.abs(last - first).sum()
    route = np.vstack([passed, last])
    route = route[np.argsort(np.abs(route - first).sum(axis=1), kind="stable")]
    np.testing.assert_array_equal(route[0], first)
    assert (np.abs(np.diff(route, axis=0)).sum(axis=1) == 1).all(), "a step does not change one index by one"


def test_every_step_changes_one_index_by_one_and_no_voxel_comes_twice() -> None:
    rng = np.random.default_rng(3)
    for _ in range(300):
        assert_is_a_walk(rng.uniform(0, 40, 3), rng.uniform(0, 40, 3))


@pytest.mark.parametrize(
    ("start", "end"),
    [
        ((0.5, 0.5, 0.5), (39.5, 0.5, 0.5)),
        ((39.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
        ((3.5, 7.5, 2.5), (3.5, 7.5, 38.25)),
        ((3.5, 38.5, 2.5), (3.5, 1.0, 2.5)),
        ((3.0, 3.0, 3.0), (30.0, 30.0, 30.0)),  # through every corner
        ((30.0, 30.0, 30.0), (3.0, 3.0, 3.0)),
        ((3.0, 3.0, 3.0), (30.0, 3.0, 30.0)),  # along faces and through edges
        ((5.0, 5.0, 5.0), (5.0, 5.0, 30.5)),  # along an edge
        ((5.5, 5.5, 5.5), (5.6, 5.4, 5.9)),  # inside one voxel
        ((1.0, 1.0, 1.0), (np.nextafter(39.0, 40.0), np.nextafter(39.0, 0.0), 1.0)),
    ],
)
def test_degenerate_rays_walk_as_well(start: tuple[float, ...], end: tuple[float, ...]) -> None:
    assert_is_a_walk(np.array(start), np.array(end))


def test_rays_from_outside_the_window_are_cut_at_its_faces() -> None:
    passed = walked(np.array([-20.0, 5.5, 5.5]), np.array([60.0, 5.5, 5.5]))
    np.testing.assert_array_equal(passed[:, 0], np.arange(39))  # the voxel in which the cut ray ends is no pass
    assert len(walked(np.array([-20.0, 5.5, 5.5]), np.array([60.0, 300.5, 5.5]))) == 0


def test_the_affine_is_rewritten_for_window_and_anchor() -> None:
    rng = np.random.default_rng(5)
    b, origin, p = rng.normal(size=3) * 1e7, np.array([100, 200, -3]), rng.normal(size=3) * 50
    A, b_window = window_affine(A_GRID, b, ANCHOR, origin)
    np.testing.assert_allclose(A @ (p - ANCHOR) + b_window, A_GRID @ p + b - origin, atol=1e-7)


@pytest.mark.parametrize("eta", [0.05, 0.5, 0.9, 0.95, 0.999])
def test_quantile_is_scipys_chi_square_with_three_degrees_of_freedom(eta: float) -> None:
    assert quantile(eta) == pytest.approx(scipy.stats.chi2.ppf(eta, 3), abs=1e-9)
    assert confidence(quantile(eta)) == pytest.approx(eta, abs=1e-12)


@pytest.mark.parametrize("bad", [{"range_min_m": -0.1}, {"range_max_m": 1.0}, {"new_cells": 9}])
def test_parameters_out_of_range_are_refused_with_their_value(bad: dict[str, float]) -> None:
    (name, value) = next(iter(bad.items()))
    with pytest.raises(DetectParameterError, match=f"{name} = {value}"):
        DetectParameters(**bad)
