"""Point-to-Gaussian registration of a scan on the dense voxel grid: annealed robust Gauss-Newton (DESIGN 8)."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import exp_so3
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.localise.kernels import linearise, newton_step, stand
from gnd.vehicle_agent.localise.match_map import MatchMap
from gnd.vehicle_agent.localise.parameters import RegistrationParameters
from gnd.vehicle_agent.localise.register_kernels import believed, linearise_pose, registered

_WIDE_SCALES: Final = (8.0, 4.0, 2.0)
"""The stages when the start is known to 1 m and 3 degrees."""
_CAPTURE_SCALES: Final = (30.0, 10.0, 4.0, 2.0)
"""To 2 m and 5 degrees."""
REGISTRATION_GATE_PER_SCALE: Final = 2.5
"""A point farther than this many scales from every Gaussian is no match."""
REGISTRATION_MIN_MATCHED: Final = 60
DEGENERATE_SHARE: Final = 0.01
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
    par, m = parameters or RegistrationParameters(), match_map
    T, rules = np.array(T_map_vehicle, dtype=np.float64), par.rules
    R, t = T[:3, :3].copy(), T[:3, 3].copy()
    scales = {"near": rules.scales, "wide": _WIDE_SCALES, "capture": _CAPTURE_SCALES}[start]
    covariance, degenerate = np.empty((6, 6)), np.empty((6, 6))
    steps, converged, cost, matched, inside, n_degenerate = registered(
        np.ascontiguousarray(points_m, dtype=np.float64), wheels_m, R, t, m.index, m.A, m.b, m.mean_m, m.information,
        np.array(scales), WHEEL_SCALE, REGISTRATION_GATE_PER_SCALE, wheel_weight(par), _least_information(par),
        DEGENERATE_SHARE, rules.correlation, rules.floor_rad, rules.floor_m, rules.stop_rad, rules.stop_m,
        rules.max_iterations, REGISTRATION_MIN_MATCHED, covariance, degenerate,
    )  # fmt: skip
    if n_degenerate < 0:
        raise RegistrationError(
            f"{matched} of {len(points_m)} points have a Gaussian nearby ({inside} lie in known voxels),"
            f" {REGISTRATION_MIN_MATCHED} are needed: is the start within 2 m, is the map loaded?"
        )
    return RegistrationResult(
        T_map_vehicle=_pose(R, t),
        covariance=covariance,
        matching_ratio=matched / max(inside, 1),
        fit=1.0 - cost / (scales[-1] ** 2 * max(inside, 1)),
        known_ratio=inside / len(points_m),
        iterations=steps,
        converged=converged,
        degenerate=degenerate[:n_degenerate],
    )


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
    T, m = np.array(T_map_vehicle, dtype=np.float64), match_map
    H, g, constrained = np.empty((6, 6)), np.empty(6), np.empty((6, 6))
    cost, matched, inside = linearise_pose(
        np.ascontiguousarray(points_m), wheels_m, T[:3, :3].copy(), T[:3, 3].copy(), m.index, m.A, m.b, m.mean_m,
        m.information, scale, max(scale, WHEEL_SCALE), REGISTRATION_GATE_PER_SCALE, wheel_weight(parameters),
        DEGENERATE_SHARE, H, g, constrained,
    )  # fmt: skip
    return Linearised(T, scale, H, g, cost, matched, inside, constrained)


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
    par, m = parameters or RegistrationParameters(), match_map
    T, rules = np.array(T_map_vehicle, dtype=np.float64), par.rules
    R, t, H, g, step = T[:3, :3].copy(), T[:3, 3].copy(), np.empty((6, 6)), np.empty(6), np.empty(6)
    for _ in range(SETTLING):
        H[:], g[:] = 0.0, 0.0
        on_ground = stand(
            wheels_m, R, t, m.index, m.A, m.b, m.mean_m, m.information, WHEEL_SCALE, REGISTRATION_GATE_PER_SCALE,
            wheel_weight(par), H, g,
        )  # fmt: skip
        if on_ground < 3:
            raise RegistrationError(f"{on_ground} of {len(wheels_m)} wheels stand on ground that the map knows, 3 must")
        newton_step(H, g, _least_information(par), step)
        R, t = exp_so3(step[:3]) @ R, t + step[3:]
    covariance, degenerate = np.empty((6, 6)), np.empty((6, 6))
    n = believed(
        R, H, g, _least_information(par), DEGENERATE_SHARE, rules.correlation, rules.floor_rad, rules.floor_m,
        covariance, degenerate,
    )  # fmt: skip
    return RegistrationResult(_pose(R, t), covariance, 0.0, 1.0, 0.0, SETTLING, True, degenerate[:n])


def _pose(R: F64, t: F64) -> F64:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def wheel_weight(par: RegistrationParameters) -> float:
    """How many points a wheel counts for; 0: wheels are no witness."""
    sigma_m = par.rules.wheel_sigma_m
    return par.rules.correlation * (par.noise_m / sigma_m) ** 2 if sigma_m > 0 else 0.0


def _least_information(par: RegistrationParameters) -> float:
    """That a direction must have to be moved along, 1/m²."""
    return par.rules.correlation / par.rules.degenerate_m**2
