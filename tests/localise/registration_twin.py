"""The plain twin of `registration`: the same steps with numpy's own algebra between the passes over the points."""

from dataclasses import dataclass

import numpy as np

from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.localise.kernels import LEVER_M, descend, linearise, stand, without_hints
from gnd.vehicle_agent.localise.parameters import RegistrationParameters
from gnd.vehicle_agent.localise.registration import (
    _CAPTURE_SCALES,
    _WIDE_SCALES,
    DEGENERATE_SHARE,
    REGISTRATION_GATE_PER_SCALE,
    REGISTRATION_MIN_MATCHED,
    WHEEL_SCALE,
    WHEELS_M,
    Linearised,
    RegistrationResult,
)


@dataclass(slots=True, eq=False)
class State:
    """The pose being moved and the normal equations at it."""

    R: np.ndarray
    t: np.ndarray
    H: np.ndarray
    g: np.ndarray
    wheels_m: np.ndarray
    cost: float = 0.0
    matched: int = 0
    inside: int = 0


def register(
    points_m,
    T_map_vehicle,
    match_map,
    parameters=None,
    start="near",
    wheels_m=WHEELS_M,
):
    """Move the scan onto the map.

    Args:
        points_m: (N, 3) float64 points in the vehicle frame, sweep motion removed.
        T_map_vehicle: (4, 4) where to start.
        match_map: the map window.
        parameters: defaults if None.
        start: how far off that may be: "near" some 10 cm, "wide" 1 m and 3°, "capture" 2 m and 5°.
        wheels_m: (W, 3) points of the vehicle frame that lie on the road.

    Raises:
        RegistrationError: fewer than `min_matched` points have a Gaussian nearby.
    """
    par = parameters or RegistrationParameters()
    T = np.array(T_map_vehicle, dtype=np.float64)
    state = State(T[:3, :3].copy(), T[:3, 3].copy(), np.zeros((6, 6)), np.zeros(6), wheels_m)
    points = np.ascontiguousarray(points_m, dtype=np.float64)
    scales = {"near": par.rules.scales, "wide": _WIDE_SCALES, "capture": _CAPTURE_SCALES}[start]
    iterations, converged = 0, False
    for stage, scale in enumerate(scales):
        coarse = 1.0 if stage == len(scales) - 1 else 10.0
        used, converged = _descend(points, state, match_map, par, scale, coarse)
        iterations += used
    _linearise(points, state, match_map, par, scales[-1])
    if _unmoved(state, T, par):
        _linearise(points, state, match_map, par, scales[-1])
    return _result(state, len(points), scales[-1], par, iterations, converged)


def linearised(
    points_m,
    T_map_vehicle,
    match_map,
    parameters,
    scale,
    wheels_m=WHEELS_M,
):
    """Points (N, 3) and the wheels (W, 3) on the map at a pose (4, 4); nothing is moved.

    Horizontal directions that the scan hardly constrains beside the others are left out: along an even wall it is the
    noise of the map that fits, and with many scans that would add up.
    """
    T = np.asarray(T_map_vehicle, dtype=np.float64)
    state = State(T[:3, :3].copy(), T[:3, 3].copy(), np.zeros((6, 6)), np.zeros(6), wheels_m)
    m, gate_m2 = match_map, (REGISTRATION_GATE_PER_SCALE * scale) ** 2
    state.cost, state.matched, state.inside = linearise(
        np.ascontiguousarray(points_m), state.R, state.t, m.index, m.A, m.b, m.mean_m, m.information, scale**2, gate_m2,
        state.H, state.g,
    )  # fmt: skip
    _add_wheels(state, m, parameters, scale)
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = state.R
    H, g = turn.T @ state.H @ turn, turn.T @ state.g
    constrained = np.empty((6, 6))
    if without_hints(H, DEGENERATE_SHARE, constrained):
        H, g = constrained.T @ H @ constrained, constrained.T @ g
    return Linearised(
        T.copy(),
        scale,
        H,
        g,
        state.cost,
        state.matched,
        state.inside,
        constrained,
    )


def _linearise(points, s, m, par, scale):
    """Refresh the normal equations of `s`; RegistrationError when too little matches."""
    gate_m2 = (REGISTRATION_GATE_PER_SCALE * scale) ** 2
    s.cost, s.matched, s.inside = linearise(
        points, s.R, s.t, m.index, m.A, m.b, m.mean_m, m.information, scale**2, gate_m2, s.H, s.g
    )
    _add_wheels(s, m, par, scale)
    _check_matched(s, len(points))


def _check_matched(s, n_points):
    if s.matched < REGISTRATION_MIN_MATCHED:
        raise RegistrationError(
            f"{s.matched} of {n_points} points have a Gaussian nearby ({s.inside} lie in known voxels),"
            f" {REGISTRATION_MIN_MATCHED} are needed: is the start within 2 m, is the map loaded?"
        )


def _add_wheels(s, m, par, scale):
    """The wheels stand on the map's ground: points of their own weight, as uncertain as springs and tyres are; gives
    how many do.
    """
    return stand(
        s.wheels_m, s.R, s.t, m.index, m.A, m.b, m.mean_m, m.information, max(scale, WHEEL_SCALE),
        REGISTRATION_GATE_PER_SCALE, _wheel_weight(par), s.H, s.g,
    )  # fmt: skip


def _wheel_weight(par):
    """How many points a wheel counts for; 0: wheels are no witness."""
    sigma_m = par.rules.wheel_sigma_m
    return par.rules.correlation * (par.noise_m / sigma_m) ** 2 if sigma_m > 0 else 0.0


def _descend(points, s, m, par, scale, coarse):
    """Gauss-Newton steps at one robust scale until they are small; (steps, converged)."""
    rules = par.rules
    steps, converged, s.matched, s.inside = descend(
        points, s.wheels_m, s.R, s.t, m.index, m.A, m.b, m.mean_m, m.information, scale, max(scale, WHEEL_SCALE),
        REGISTRATION_GATE_PER_SCALE, _wheel_weight(par), _least_information(par), coarse * rules.stop_rad,
        coarse * rules.stop_m, rules.max_iterations, REGISTRATION_MIN_MATCHED,
    )  # fmt: skip
    _check_matched(s, len(points))
    return steps, converged


def _least_information(par):
    """That a direction must have to be moved along, 1/m²."""
    return par.rules.correlation / par.rules.degenerate_m**2


def _solve(H, g, par):
    """-H^-1 g, leaving out the directions that are degenerate (solution remapping, Zhang et al. 2016)."""
    values, vectors, scale = _principal(H)
    strong = values > _least_information(par)
    along = vectors[:, strong]
    return np.asarray(-(along @ ((along.T @ (g * scale)) / values[strong])) * scale)


def _principal(H):
    """Eigenvalues and vectors of H with turns measured as motion at `LEVER_M`, and the scale that does so."""
    scale = np.array([1.0 / LEVER_M] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(H * scale * scale[:, None])
    return values, vectors, scale


def _strong(values, vectors, par):
    """(6,) which principal directions are constrained: by enough information, and a horizontal one by more than what
    the noise of a map gives along an even wall.
    """
    horizontal = vectors[3] ** 2 + vectors[4] ** 2 > 0.5
    least = _least_information(par)
    strongest = float(values[horizontal].max(initial=0.0))  # not the vertical, which wheels on the road hold firmly
    return np.asarray(values > np.where(horizontal, max(least, DEGENERATE_SHARE * strongest), least))


def _unmoved(s, T_start, par):
    """Take back what was moved along horizontal directions that the scan does not constrain; True if there were any."""
    values, vectors, _ = _principal(s.H)
    weak = vectors[3:, ~_strong(values, vectors, par) & (values > _least_information(par))]
    if not weak.size:
        return False
    weak = weak / np.linalg.norm(weak, axis=0)
    s.t = s.t - weak @ (weak.T @ (s.t - T_start[:3, 3]))
    return True


def _result(s, n, scale, par, iterations, converged):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = s.R, s.t
    H = _in_vehicle_axes(s.H, s.R)
    values, vectors, _ = _principal(H)
    return RegistrationResult(
        T_map_vehicle=T,
        covariance=_covariance(np.where(_strong(values, vectors, par), values, 0.0), vectors, par),
        matching_ratio=s.matched / max(s.inside, 1),
        fit=1.0 - s.cost / (scale**2 * max(s.inside, 1)),
        known_ratio=s.inside / n,
        iterations=iterations,
        converged=converged,
        degenerate=vectors[:, ~_strong(values, vectors, par)].T,
    )


def _in_vehicle_axes(H, R_map_vehicle):
    """H of a motion along map axes as H of the same motion along the vehicle's axes."""
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = R_map_vehicle
    return np.asarray(turn.T @ H @ turn)


def _covariance(values, vectors, par):
    """Inverse Hessian, enlarged because points share errors, plus the floor; a free direction gets 10 m."""
    scale = np.array([1.0 / LEVER_M] * 3 + [1.0] * 3)
    free = 1e2
    shared = vectors @ (np.minimum(par.rules.correlation / np.maximum(values, 1e-9), free)[:, None] * vectors.T)
    floor = np.diag([par.rules.floor_rad**2] * 3 + [par.rules.floor_m**2] * 3)
    return np.asarray(shared * scale * scale[:, None] + floor)
