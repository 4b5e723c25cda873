"""Point-to-Gaussian registration: its kernel against a plain twin, known motions, doubt where there should be doubt."""

from dataclasses import replace

import numpy as np
import pytest
import registration_twin
import small_gicp
from registration_twin import _principal, _solve
from yard import (
    GROUND_M,
    corridor,
    local_map_of,
    match_map_of,
    moved,
    offset,
    pose,
    seen_from,
)

from gnd.gnd_map.gaussian import full_matrices
from gnd.gnd_map.se3 import T_from_R_t, exp_so3
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.localise.kernels import (
    descend,
    linearise,
    newton_step,
    principal,
    stand,
    tapered_information,
    without_hints,
)
from gnd.vehicle_agent.localise.match_map import MatchMap
from gnd.vehicle_agent.localise.parameters import ON_MAP, RegistrationParameters
from gnd.vehicle_agent.localise.registration import WHEELS_M, linearised, register

UNIFORM = 1.0 / 12.0


def plain_linearise(points, R, t, m, scale2, gate_m2):
    """The kernel's twin: one point at a time, Jacobians and sums written out."""
    H, g, cost, matched, inside = np.zeros((6, 6)), np.zeros(6), 0.0, 0, 0
    steps = np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    for p in points:
        a = R @ p
        q = a + t
        w = m.A @ q + m.b
        if (w < 1).any() or (w >= np.array(m.index.shape) - 1).any() or m.index[tuple(w.astype(int))] < -1:
            continue
        inside += 1
        rows = [m.index[tuple(w.astype(int) + s)] for s in steps]
        found = [
            (float((q - m.mean_m[r]) @ full_matrices(m.information[r][None])[0] @ (q - m.mean_m[r])), r)
            for r in rows
            if r >= 0
        ]
        m2, row = min(found, default=(np.inf, -1))
        if m2 >= gate_m2:
            cost += scale2
            continue
        matched += 1
        cost += scale2 * m2 / (scale2 + m2)
        J = np.hstack([np.array([[0, a[2], -a[1]], [-a[2], 0, a[0]], [a[1], -a[0], 0]]), np.eye(3)])
        weight = (scale2 / (scale2 + m2)) ** 2
        omega = full_matrices(m.information[[row]])[0]
        H += weight * J.T @ omega @ J
        g += weight * J.T @ omega @ (q - m.mean_m[row])
    return H, g, cost, matched, inside


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.fixture
def scene(yard_map, yard_points, rng):
    """(match map, true pose, points seen from it)."""
    T = pose(-4.0, 2.0, 40.0, roll_deg=0.4, pitch_deg=-0.7)
    return match_map_of(yard_map), T, seen_from(rng, yard_points, T, 3000)


def test_information_is_that_beyond_an_even_voxel(rng):
    a = rng.normal(size=(200, 3, 3)) * rng.uniform(0.001, 0.4, (200, 1, 3))
    cov = a @ np.swapaxes(a, 1, 2)
    cov[:5] = np.diag([0.0, 0.01, 0.01]), np.eye(3) * 0.02, np.zeros((3, 3)), np.diag([1e-9, 1.0, 0.2]), np.eye(3)
    six = np.ascontiguousarray(cov[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]])
    found = np.empty_like(six)
    tapered_information(six, 0.04**2, UNIFORM, found)
    values, vectors = np.linalg.eigh(cov)
    kept = np.maximum(1 / (np.maximum(values, 0) + 0.04**2) - 1 / (UNIFORM + 0.04**2), 0)
    expected = np.einsum("nik,nk,njk->nij", vectors, kept, vectors)
    np.testing.assert_allclose(full_matrices(found), expected, atol=1e-7 * expected.max())


def test_an_evenly_filled_voxel_pulls_in_no_direction():
    six = np.array([[UNIFORM, 0, 0, UNIFORM, 0, UNIFORM]])
    found = np.empty_like(six)
    tapered_information(six, 0.04**2, UNIFORM, found)
    np.testing.assert_allclose(found, 0.0, atol=1e-9)


@pytest.mark.parametrize("scale", [2.0, 30.0])
def test_kernel_equals_its_plain_twin(scene, rng, scale):
    m, T, points = scene
    start = moved(rng, T, 0.3, 1.0)
    H, g = np.zeros((6, 6)), np.zeros(6)
    R, t = np.ascontiguousarray(start[:3, :3]), np.ascontiguousarray(start[:3, 3])
    sums = linearise(points[:400], R, t, m.index, m.A, m.b, m.mean_m, m.information, scale**2, 6 * scale**2, H, g)
    H_plain, g_plain, *sums_plain = plain_linearise(points[:400], R, t, m, scale**2, 6 * scale**2)
    np.testing.assert_allclose(H, H_plain, rtol=1e-9, atol=1e-9 * np.abs(H_plain).max())
    np.testing.assert_allclose(g, g_plain, rtol=1e-9, atol=1e-9 * np.abs(g_plain).max())
    np.testing.assert_allclose(sums, sums_plain, rtol=1e-12)
    assert sums_plain[1] > 100


def corridor_scene(rng):
    points = corridor(rng)
    T = pose(3.0, 0.7, 2.0)
    return match_map_of(local_map_of(points)), T, seen_from(rng, points, T, 3000)


@pytest.mark.parametrize("start", ["near", "wide", "capture"])
@pytest.mark.parametrize("where", ["yard", "corridor"])
def test_a_registration_equals_its_plain_twin(scene, rng, where, start):
    """All numbers of the result, in a corridor also which direction nothing constrains and that it is not moved."""
    m, T, points = scene if where == "yard" else corridor_scene(rng)
    for _ in range(5):
        begin = moved(rng, T, *{"near": (0.1, 0.3), "wide": (0.5, 1.5), "capture": (1.0, 3.0)}[start])
        found, plain = (module(points, begin, m, None, start) for module in (register, registration_twin.register))
        assert (found.iterations, found.converged) == (plain.iterations, plain.converged)
        assert found.matching_ratio == plain.matching_ratio
        assert found.known_ratio == plain.known_ratio
        assert found.fit == pytest.approx(plain.fit, abs=1e-10)
        np.testing.assert_allclose(found.T_map_vehicle, plain.T_map_vehicle, atol=1e-9)
        np.testing.assert_allclose(found.covariance, plain.covariance, rtol=1e-6, atol=1e-12)
        weak, weak_plain = (one.degenerate.T @ one.degenerate for one in (found, plain))
        np.testing.assert_allclose(weak, weak_plain, atol=1e-6)
        assert len(found.degenerate) == (1 if where == "corridor" else 0)


@pytest.mark.parametrize("where", ["yard", "corridor"])
def test_normal_equations_of_a_pose_equal_their_plain_twin(scene, rng, where):
    m, T, points = scene if where == "yard" else corridor_scene(rng)
    for scale in (2.0, 8.0):
        at = moved(rng, T, 0.1, 0.5)
        found, plain = (
            module(points, at, m, RegistrationParameters(), scale)
            for module in (linearised, registration_twin.linearised)
        )
        assert (found.matched, found.inside) == (plain.matched, plain.inside)
        assert found.cost == pytest.approx(plain.cost, rel=1e-12)
        np.testing.assert_allclose(found.H, plain.H, atol=1e-9 * np.abs(plain.H).max())
        np.testing.assert_allclose(found.g, plain.g, atol=1e-9 * np.abs(plain.g).max())
        np.testing.assert_allclose(found.constrained, plain.constrained, atol=1e-6)


def spectrum(rng, values):
    """A symmetric matrix (6, 6) with these eigenvalues once its turns are measured at 10 m."""
    vectors = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    levers = np.array([10.0] * 3 + [1.0] * 3)
    return (vectors * values) @ vectors.T * levers * levers[:, None]


@pytest.mark.parametrize("weak", [0, 1, 3, 6])
def test_a_step_leaves_out_weak_directions_as_its_plain_twin(rng, weak):
    least = 10.0 / ON_MAP.degenerate_m**2
    for _ in range(20):
        values = least * np.concatenate([rng.uniform(0.0, 0.99, weak), 10.0 ** rng.uniform(0.01, 5.0, 6 - weak)])
        H, g, step = spectrum(rng, values), rng.normal(size=6) * 100.0, np.empty(6)
        newton_step(H, g, least, step)
        plain = _solve(H, g, RegistrationParameters())
        np.testing.assert_allclose(step, plain, atol=1e-9 * max(np.abs(plain).max(), 1e-12))


def test_principal_directions_equal_numpys(rng):
    for _ in range(20):
        S = spectrum(rng, 10.0 ** rng.uniform(-3.0, 6.0, 6))
        values, V = S.copy(), np.empty((6, 6))
        principal(values, V)
        np.testing.assert_allclose(np.sort(np.diag(values)), np.linalg.eigvalsh(S), atol=1e-9 * np.abs(S).max())
        np.testing.assert_allclose((V * np.diag(values)) @ V.T, S, atol=1e-9 * np.abs(S).max())


def plain_without_hints(H, share):
    values, vectors, scale = _principal(H)
    horizontal = vectors[3] ** 2 + vectors[4] ** 2 > 0.5
    strongest = float(values[horizontal].max(initial=0.0))
    constrained = ~horizontal | (values > share * strongest)
    along = vectors[:, constrained]
    return np.eye(6) if constrained.all() else (along @ along.T) * scale[:, None] / scale


def test_hints_are_taken_out_as_by_the_plain_twin(scene, rng):
    m, T, points = scene
    H, g, found, taken = np.zeros((6, 6)), np.zeros(6), np.empty((6, 6)), 0
    for share in (0.01, 0.5, 0.9, 1.1):
        for start in (T, moved(rng, T, 0.2, 2.0)):
            R, t = np.ascontiguousarray(start[:3, :3]), np.ascontiguousarray(start[:3, 3])
            linearise(points, R, t, m.index, m.A, m.b, m.mean_m, m.information, 4.0, 25.0, H, g)
            plain = plain_without_hints(H, share)
            assert without_hints(H, share, found) == (not np.array_equal(plain, np.eye(6)))
            np.testing.assert_allclose(found, plain, atol=1e-9 * np.abs(plain).max())
            taken += not np.array_equal(plain, np.eye(6))
    assert taken > 2


def test_wheels_tell_height_roll_and_pitch_only(scene):
    m, T, _ = scene
    R, t, H, g = T[:3, :3].copy(), T[:3, 3].copy(), np.zeros((6, 6)), np.zeros(6)
    on_ground = stand(WHEELS_M, R, t, m.index, m.A, m.b, m.mean_m, m.information, 10.0, 2.5, 40.0, H, g)
    H_plain, g_plain, _, matched, _ = plain_linearise(WHEELS_M, R, t, m, 100.0, 625.0)
    told = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 1.0])
    assert on_ground == matched == 4
    np.testing.assert_allclose(H, 40.0 * H_plain * told * told[:, None], atol=1e-9 * np.abs(H_plain).max())
    np.testing.assert_allclose(g, 40.0 * g_plain * told, atol=1e-9 * np.abs(g_plain).max())


@pytest.mark.parametrize("scale", [2.0, 10.0])
def test_descent_equals_its_plain_twin(scene, rng, scale):
    """The same steps written out: normal equations, wheels, a step, a turn, until it is small."""
    m, T, points = scene
    start, least = moved(rng, T, 0.3, 1.0), 10.0 / ON_MAP.degenerate_m**2
    rest = (m.index, m.A, m.b, m.mean_m, m.information)
    R, t = np.ascontiguousarray(start[:3, :3]), np.ascontiguousarray(start[:3, 3])
    R_plain, t_plain, H, g = R.copy(), t.copy(), np.zeros((6, 6)), np.zeros(6)
    found = descend(points, WHEELS_M, R, t, *rest, scale, 10.0, 2.5, 40.0, least, 1e-4, 5e-4, 15, 60)
    steps, small = 0, False
    while not small:
        steps += 1
        _, matched, inside = linearise(points, R_plain, t_plain, *rest, scale**2, (2.5 * scale) ** 2, H, g)
        stand(WHEELS_M, R_plain, t_plain, *rest, 10.0, 2.5, 40.0, H, g)
        step = _solve(H, g, RegistrationParameters())
        R_plain, t_plain = exp_so3(step[:3]) @ R_plain, t_plain + step[3:]
        small = np.abs(step[:3]).max() < 1e-4 and np.abs(step[3:]).max() < 5e-4
    assert found == (steps, True, matched, inside)
    np.testing.assert_allclose(R, R_plain, atol=1e-9)
    np.testing.assert_allclose(t, t_plain, atol=1e-8)


def test_descent_ends_where_too_little_matches(scene):
    m, T, points = scene
    R, t = T[:3, :3].copy(), T[:3, 3] + [0.0, 0.0, 500.0]
    found = descend(
        points, WHEELS_M, R, t, m.index, m.A, m.b, m.mean_m, m.information, 2.0, 10.0, 2.5, 40.0, 250.0, 1e-4, 5e-4,
        15, 60,
    )  # fmt: skip
    assert found == (1, False, 0, 0)


def test_gradient_is_the_slope_of_the_cost(scene):
    """Central differences, with the Gaussian of each point held by looking only where no point changes its own."""
    m, T, points = scene
    R, t, H, g = T[:3, :3].copy(), T[:3, 3].copy(), np.zeros((6, 6)), np.zeros(6)

    def cost_of(one, step):
        moved_R, moved_t = np.ascontiguousarray(exp_so3(step[:3]) @ R), t + step[3:]
        return linearise(one, moved_R, moved_t, m.index, m.A, m.b, m.mean_m, m.information, 1e4, 1e4, H, g)[0]

    checked = 0
    for p in points[:60]:
        one = np.ascontiguousarray(p[None])
        linearise(one, R, t, m.index, m.A, m.b, m.mean_m, m.information, 1e4, 1e4, H, g)
        slope = 2.0 * g.copy()
        h = 1e-5
        numeric = np.array([(cost_of(one, h * e) - cost_of(one, -h * e)) / (2 * h) for e in np.eye(6)])
        if np.abs(numeric).max() < 1e-3 or np.abs(slope - numeric).max() > 0.05 * np.abs(numeric).max():
            continue  # the nearest Gaussian changes within the step: no slope to compare with
        checked += 1
    assert checked > 45


@pytest.mark.parametrize(
    ("start", "metres", "degrees"), [("near", 0.1, 0.2), ("wide", 0.8, 2.0), ("capture", 2.0, 5.0)]
)
def test_known_motion_is_recovered(scene, rng, start, metres, degrees):
    m, T, points = scene
    for _ in range(6):
        result = register(points, moved(rng, T, metres, degrees), m, start=start)
        off_m, off_deg = offset(T, result.T_map_vehicle)
        assert result.converged
        assert off_m < 0.01
        assert off_deg < 0.03
        assert result.matching_ratio > 0.95
        assert len(result.degenerate) == 0


def test_agrees_with_small_gicp(scene, yard_points, rng):
    m, T, points = scene
    start = moved(rng, T, 0.3, 1.0)
    ours = register(points, start, m, start="wide").T_map_vehicle
    oracle = small_gicp.align(
        yard_points, points, init_T_target_source=start, registration_type="GICP", downsampling_resolution=0.2,
        max_iterations=50, translation_epsilon=1e-5, rotation_epsilon=1e-6,
    )  # fmt: skip
    off_m, off_deg = offset(oracle.T_target_source, ours)
    assert oracle.converged
    assert off_m < 0.02
    assert off_deg < 0.05


def test_covariance_says_how_wrong_the_pose_is(yard_map, yard_points):
    """Normalised errors of many registrations. The yard has none of the errors that scans share (mount, motion), for
    which the covariance makes room: errors reach a tenth of the sigmas here, half to all of them on simulated streets.
    """
    m, squares = match_map_of(yard_map), []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        T = pose(rng.uniform(-10, 10), rng.uniform(-5, 5), rng.uniform(0, 360))
        result = register(seen_from(rng, yard_points, T, 2500), T, m)
        error = np.linalg.inv(T) @ result.T_map_vehicle
        small = np.array([error[2, 1], error[0, 2], error[1, 0], *error[:3, 3]])
        squares.append(small @ np.linalg.solve(result.covariance, small))
    assert 0.05**2 < np.mean(squares) / 6 < 1.0


def test_a_corridor_does_not_tell_where_along_it_one_is(rng):
    surfaces = corridor(rng)
    m, T = match_map_of(local_map_of(surfaces)), pose(0.0, 0.3, 0.0)
    start = T @ T_from_R_t(np.eye(3), [0.35, 0.1, 0.0])
    result = register(seen_from(rng, surfaces, T), start, m, start="wide")
    error = np.linalg.inv(T) @ result.T_map_vehicle
    assert abs(error[1, 3]) < 0.01
    assert error[0, 3] == pytest.approx(0.35, abs=0.05)  # not moved along
    assert len(result.degenerate) == 1
    assert abs(result.degenerate[0, 3]) > 0.99
    assert result.sigma_m[0] > 0.2 > 10 * result.sigma_m[1]


def test_changed_half_of_the_walls_does_not_move_the_pose(yard_points, rng):
    """What stands 0.5 m elsewhere in the map is not what the pose is found by."""
    T = pose(-4.0, 2.0, 40.0)
    changed = yard_points.copy()
    far = (changed[:, 0] > 8.0) & (changed[:, 2] > GROUND_M + 0.05)
    changed[far] += [0.35, 0.35, 0.0]
    result = register(
        seen_from(rng, yard_points, T, 3000), moved(rng, T, 0.05, 0.1), match_map_of(local_map_of(changed))
    )
    off_m, off_deg = offset(T, result.T_map_vehicle)
    assert off_m < 0.02
    assert off_deg < 0.06
    assert result.fit < 0.92


def test_where_nothing_matches_the_error_names_numbers(scene):
    m, T, points = scene
    with pytest.raises(RegistrationError, match=r"0 of 3000 points have a Gaussian nearby .* 60 are needed"):
        register(points, T @ T_from_R_t(np.eye(3), [500.0, 0.0, 0.0]), m)


def test_points_in_tiles_that_are_not_held_do_not_count_against_the_match(yard_points, rng):
    T = pose(0.0, 0.0, 0.0)
    points = seen_from(rng, yard_points, T, 3000)
    local_map = local_map_of(yard_points)
    whole = register(points, T, match_map_of(local_map))
    farthest = max(local_map.tiles, key=lambda tile: np.linalg.norm(local_map.grid_frame.centre_map_m(
        local_map.grid_frame.grid_of_voxel(tile, np.zeros(1, np.int32)))[0, :2]))  # fmt: skip
    nearest = min(local_map.tiles, key=lambda tile: np.linalg.norm(local_map.grid_frame.centre_map_m(
        local_map.grid_frame.grid_of_voxel(tile, np.zeros(1, np.int32)))[0, :2] - [20, 0]))  # fmt: skip
    assert farthest != nearest
    local_map.remove_tile(nearest)
    part = register(points, T, match_map_of(local_map))
    assert whole.known_ratio == pytest.approx(1.0, abs=0.02)
    assert part.known_ratio < whole.known_ratio - 0.1
    assert part.matching_ratio > 0.95


@pytest.mark.parametrize("values", [{"scales": ()}, {"scales": (4.0, -1.0)}, {"max_iterations": 0}])
def test_parameters_that_cannot_work_are_refused(values):
    with pytest.raises(ValueError, match="required"):
        replace(ON_MAP, **values)
    with pytest.raises(ValueError, match="lies outside"):
        RegistrationParameters(noise_m=0.0)


def test_map_of_plain_arrays_is_copied_into_the_layout_of_the_kernel():
    cov = [[1e-3, 0, 0, 1e-3, 0, 1e-3]]
    m = MatchMap.of(np.zeros((2, 2, 2), np.int64), np.eye(3), np.zeros(3), [[0, 0, 0]], cov, 0.04)
    assert (m.index.dtype, m.mean_m.dtype, len(m)) == (np.int32, np.float64, 1)
