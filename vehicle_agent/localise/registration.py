"""Point-to-Gaussian registration of a scan on the dense voxel grid: annealed robust Gauss-Newton (DESIGN 8)."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import exp_so3
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.localise.kernels import LEVER_M, descend, linearise, stand, without_hints
from gnd.vehicle_agent.localise.match_map import MatchMap
from gnd.vehicle_agent.localise.parameters import RegistrationParameters

_WIDE_SCALES: Final = (8.0, 4.0, 2.0)
"""The stages when the start is known to 1 m and 3 degrees."""
_CAPTURE_SCALES: Final = (30.0, 10.0, 4.0, 2.0)
"""To 2 m and 5 degrees."""
REGISTRATION_GATE_PER_SCALE: Final = 2.5
"""A point farther than this many scales from every Gaussian is no match."""
REGISTRATION_MIN_MATCHED: Final = 60
_DEGENERATE_SHARE: Final = 0.01
"""So is a horizontal one with less than this share of the strongest direction's information."""


Start = Literal["near", "wide", "capture"]

# Where a car's wheels touch the road, vehicle frame (origin on the road under the middle of the rear axle), metres.
WHEELS_M = np.array([[0.0, 0.8, 0.0], [0.0, -0.8, 0.0], [2.8, 0.8, 0.0], [2.8, -0.8, 0.0]])
WHEEL_SCALE = 10.0  # in sigmas of a point: a kerb or a road that was raised, but not a frame that lies elsewhere
SETTLING = 3


@dataclass(frozen=True, slots=True, eq=False)
class RegistrationResult:
    """A pose and how far to believe it.

    Attributes:
        T_map_vehicle: (4, 4).
        covariance: (6, 6) of a small motion of the vehicle in its own frame, rotation [rad] first, then position [m]
            (GTSAM's order).
        matching_ratio: matched share of the points in known voxels.
        fit: 1 - mean robust cost, 0 ... 1.
        known_ratio: share of the points that fell into known voxels.
        iterations: 0: a pose from outside, not of a match.
        degenerate: (K, 6) unit directions (rotation at 10 m, position; vehicle frame) that the scan does not constrain
            and along which nothing was moved.
    """

    T_map_vehicle: F64
    covariance: F64
    matching_ratio: float
    fit: float
    known_ratio: float
    iterations: int
    converged: bool
    degenerate: F64

    @property
    def sigma_m(self) -> F64:
        """(3,) forward, left, up."""
        return np.sqrt(np.diag(self.covariance)[3:])

    @property
    def sigma_rad(self) -> F64:
        """(3,) roll, pitch, yaw."""
        return np.sqrt(np.diag(self.covariance)[:3])


@dataclass(slots=True, eq=False)
class _State:
    """The pose being moved and the normal equations at it."""

    R: F64
    t: F64
    H: F64
    g: F64
    wheels_m: F64
    cost: float = 0.0
    matched: int = 0
    inside: int = 0


def register(
    points_m: F64,
    T_map_vehicle: ArrayLike,
    match_map: MatchMap,
    parameters: RegistrationParameters | None = None,
    start: Start = "near",
    wheels_m: F64 = WHEELS_M,
) -> RegistrationResult:
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
    state = _State(T[:3, :3].copy(), T[:3, 3].copy(), np.zeros((6, 6)), np.zeros(6), wheels_m)
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


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """The cost of points on the map around one pose, to second order.

    Attributes:
        T_map_vehicle: (4, 4) the pose.
        scale: robust scale in sigmas.
        H, g: (6, 6) and (6,) of a small motion of the vehicle in its own frame, rotation [rad] first; points count as
            independent.
        cost: sum of robust costs.
        matched, inside: points near a Gaussian, and in known voxels.
        constrained: (6, 6), projects a motion on the directions that the points constrain.
    """

    T_map_vehicle: F64
    scale: float
    H: F64
    g: F64
    cost: float
    matched: int
    inside: int
    constrained: F64

    def fit(self, scale: float) -> float:
        """1 - mean robust cost of the points in known voxels, 0 ... 1."""
        return 1.0 - self.cost / (scale**2 * max(self.inside, 1))


def linearised(
    points_m: F64,
    T_map_vehicle: F64,
    match_map: MatchMap,
    parameters: RegistrationParameters,
    scale: float,
    wheels_m: F64 = WHEELS_M,
) -> Linearised:
    """Points (N, 3) and the wheels (W, 3) on the map at a pose (4, 4); nothing is moved.

    Horizontal directions that the scan hardly constrains beside the others are left out: along an even wall it is the
    noise of the map that fits, and with many scans that would add up.
    """
    T = np.asarray(T_map_vehicle, dtype=np.float64)
    state = _State(T[:3, :3].copy(), T[:3, 3].copy(), np.zeros((6, 6)), np.zeros(6), wheels_m)
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
    if without_hints(H, _DEGENERATE_SHARE, constrained):
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


def fit_of(points_m: F64, T_map_vehicle: F64, match_map: MatchMap, parameters: RegistrationParameters) -> float:
    """How well points (N, 3) lie on the map at a pose, 0 ... 1: 1 - mean robust cost at the narrowest scale; a point in
    voxels that are not known counts as off.
    """
    if not len(points_m):
        return 0.0
    R, t = np.ascontiguousarray(T_map_vehicle[:3, :3]), np.ascontiguousarray(T_map_vehicle[:3, 3])
    m, scale = match_map, parameters.rules.scales[-1]
    cost, _, inside = linearise(
        np.ascontiguousarray(points_m), R, t, m.index, m.A, m.b, m.mean_m, m.information, scale**2,
        (REGISTRATION_GATE_PER_SCALE * scale) ** 2, np.empty((6, 6)), np.empty(6),
    )  # fmt: skip
    return (inside - cost / scale**2) / len(points_m)


def settle(
    T_map_vehicle: ArrayLike,
    match_map: MatchMap,
    parameters: RegistrationParameters | None = None,
    wheels_m: F64 = WHEELS_M,
) -> RegistrationResult:
    """Set the vehicle on the map's ground: height, roll and pitch by its wheels alone, the rest stays as it is.

    What a scan that matches nothing, or only what has changed, still knows. Directions that are not moved have a sigma
    of 10 m (turns at 10 m) in the covariance.

    Raises:
        RegistrationError: fewer than three wheels stand on ground that the map knows.
    """
    par = parameters or RegistrationParameters()
    T = np.array(T_map_vehicle, dtype=np.float64)
    state = _State(T[:3, :3].copy(), T[:3, 3].copy(), np.zeros((6, 6)), np.zeros(6), wheels_m)
    for _ in range(SETTLING):
        state.H[:], state.g[:] = 0.0, 0.0
        on_ground = _add_wheels(state, match_map, par, WHEEL_SCALE)
        if on_ground < 3:
            raise RegistrationError(f"{on_ground} of {len(wheels_m)} wheels stand on ground that the map knows, 3 must")
        step = _solve(state.H, state.g, par)
        state.R, state.t = exp_so3(step[:3]) @ state.R, state.t + step[3:]
    return _result(state, len(wheels_m), WHEEL_SCALE, par, SETTLING, converged=True)


def _linearise(points: F64, s: _State, m: MatchMap, par: RegistrationParameters, scale: float) -> None:
    """Refresh the normal equations of `s`; RegistrationError when too little matches."""
    gate_m2 = (REGISTRATION_GATE_PER_SCALE * scale) ** 2
    s.cost, s.matched, s.inside = linearise(
        points, s.R, s.t, m.index, m.A, m.b, m.mean_m, m.information, scale**2, gate_m2, s.H, s.g
    )
    _add_wheels(s, m, par, scale)
    _check_matched(s, len(points))


def _check_matched(s: _State, n_points: int) -> None:
    if s.matched < REGISTRATION_MIN_MATCHED:
        raise RegistrationError(
            f"{s.matched} of {n_points} points have a Gaussian nearby ({s.inside} lie in known voxels),"
            f" {REGISTRATION_MIN_MATCHED} are needed: is the start within 2 m, is the map loaded?"
        )


def _add_wheels(s: _State, m: MatchMap, par: RegistrationParameters, scale: float) -> int:
    """The wheels stand on the map's ground: points of their own weight, as uncertain as springs and tyres are; gives
    how many do.
    """
    return stand(
        s.wheels_m, s.R, s.t, m.index, m.A, m.b, m.mean_m, m.information, max(scale, WHEEL_SCALE),
        REGISTRATION_GATE_PER_SCALE, _wheel_weight(par), s.H, s.g,
    )  # fmt: skip


def _wheel_weight(par: RegistrationParameters) -> float:
    """How many points a wheel counts for; 0: wheels are no witness."""
    sigma_m = par.rules.wheel_sigma_m
    return par.rules.correlation * (par.noise_m / sigma_m) ** 2 if sigma_m > 0 else 0.0


def _descend(
    points: F64, s: _State, m: MatchMap, par: RegistrationParameters, scale: float, coarse: float
) -> tuple[int, bool]:
    """Gauss-Newton steps at one robust scale until they are small; (steps, converged)."""
    rules = par.rules
    steps, converged, s.matched, s.inside = descend(
        points, s.wheels_m, s.R, s.t, m.index, m.A, m.b, m.mean_m, m.information, scale, max(scale, WHEEL_SCALE),
        REGISTRATION_GATE_PER_SCALE, _wheel_weight(par), _least_information(par), coarse * rules.stop_rad,
        coarse * rules.stop_m, rules.max_iterations, REGISTRATION_MIN_MATCHED,
    )  # fmt: skip
    _check_matched(s, len(points))
    return steps, converged


def _least_information(par: RegistrationParameters) -> float:
    """That a direction must have to be moved along, 1/m²."""
    return par.rules.correlation / par.rules.degenerate_m**2


def _solve(H: F64, g: F64, par: RegistrationParameters) -> F64:
    """-H^-1 g, leaving out the directions that are degenerate (solution remapping, Zhang et al. 2016)."""
    values, vectors, scale = _principal(H)
    strong = values > _least_information(par)
    along = vectors[:, strong]
    return np.asarray(-(along @ ((along.T @ (g * scale)) / values[strong])) * scale)


def _principal(H: F64) -> tuple[F64, F64, F64]:
    """Eigenvalues and vectors of H with turns measured as motion at `LEVER_M`, and the scale that does so."""
    scale = np.array([1.0 / LEVER_M] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(H * scale * scale[:, None])
    return values, vectors, scale


def _strong(values: F64, vectors: F64, par: RegistrationParameters) -> NDArray[np.bool_]:
    """(6,) which principal directions are constrained: by enough information, and a horizontal one by more than what
    the noise of a map gives along an even wall.
    """
    horizontal = vectors[3] ** 2 + vectors[4] ** 2 > 0.5
    least = _least_information(par)
    strongest = float(values[horizontal].max(initial=0.0))  # not the vertical, which wheels on the road hold firmly
    return np.asarray(values > np.where(horizontal, max(least, _DEGENERATE_SHARE * strongest), least))


def _unmoved(s: _State, T_start: F64, par: RegistrationParameters) -> bool:
    """Take back what was moved along horizontal directions that the scan does not constrain; True if there were any."""
    values, vectors, _ = _principal(s.H)
    weak = vectors[3:, ~_strong(values, vectors, par) & (values > _least_information(par))]
    if not weak.size:
        return False
    weak = weak / np.linalg.norm(weak, axis=0)
    s.t = s.t - weak @ (weak.T @ (s.t - T_start[:3, 3]))
    return True


def _result(
    s: _State, n: int, scale: float, par: RegistrationParameters, iterations: int, converged: bool
) -> RegistrationResult:
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


def _in_vehicle_axes(H: F64, R_map_vehicle: F64) -> F64:
    """H of a motion along map axes as H of the same motion along the vehicle's axes."""
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = R_map_vehicle
    return np.asarray(turn.T @ H @ turn)


def _covariance(values: F64, vectors: F64, par: RegistrationParameters) -> F64:
    """Inverse Hessian, enlarged because points share errors, plus the floor; a free direction gets 10 m."""
    scale = np.array([1.0 / LEVER_M] * 3 + [1.0] * 3)
    free = 1e2
    shared = vectors @ (np.minimum(par.rules.correlation / np.maximum(values, 1e-9), free)[:, None] * vectors.T)
    floor = np.diag([par.rules.floor_rad**2] * 3 + [par.rules.floor_m**2] * 3)
    return np.asarray(shared * scale * scale[:, None] + floor)
