"""Height and tilt of final poses of sensors that do not see them: the vehicle stands on the map's road.

A few layers close to level meet every facade at one height. Where a Gaussian is not quite evenly filled from bottom to
top they are drawn to its middle, and at 20 to 30 m that tilts the vehicle by half a degree, always to the same side;
rays then seem to pass the road. Place and heading do not suffer. Such poses take height, roll and pitch from the map's
ground under the wheels, which many layers know better than four wheels do.
"""

from dataclasses import replace
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt

from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.localise.graph import MapMatch, SmoothedPose
from gnd.vehicle_agent.localise.initialise import quantile_of
from gnd.vehicle_agent.localise.match_map import MatchMap
from gnd.vehicle_agent.localise.parameters import RegistrationParameters
from gnd.vehicle_agent.localise.registration import WHEELS_M, settle

LEAST_SPREAD_DEG: Final = 8.0
"""A sensor whose rays lie within so much of elevation does not see its tilt: a Scala has 3.2°, a VLP-16 30°."""
SIGMA_RAD: Final = 2.5e-3
SIGMA_M: Final = 0.01
"""Of tilt and height by the wheels: the errors are those of the map's ground, not of springs."""
_LOOKED_AT: Final = 500
_TILT_AND_HEIGHT: Final = np.array([0, 1, 5])  # roll, pitch, z of a covariance, rotation first


Points = TypeVar("Points", bound=np.generic)


def sees_tilt(points_lidar: npt.NDArray[np.generic]) -> bool:
    """Return whether the rays to points (N, 3) of a scan, LiDAR frame, any unit, spread enough in elevation."""
    return spreads(looked_at(points_lidar))


def looked_at(points: npt.NDArray[Points]) -> npt.NDArray[Points]:
    """Those of the points (N, 3) of a scan that are enough to tell; a view."""
    return points[:: 1 + len(points) // _LOOKED_AT]


def spreads(rays: npt.NDArray[np.generic]) -> bool:
    """Whether rays (N, 3), LiDAR frame, any unit, spread enough in elevation."""
    some = rays.astype(np.float64)
    horizontal = np.hypot(some[:, 0], some[:, 1])
    far = horizontal > 0.0
    if not far.any():
        return True
    rising = np.sort(np.arctan2(some[far, 2], horizontal[far]))
    return bool(np.degrees(quantile_of(rising, 0.95) - quantile_of(rising, 0.05)) >= LEAST_SPREAD_DEG)


def settled(
    T_map_vehicle: npt.NDArray[np.float64],
    match_map: MatchMap,
    parameters: RegistrationParameters,
    wheels_m: npt.NDArray[np.float64] = WHEELS_M,
) -> MapMatch | None:
    """Return a pose (4, 4) with height and tilt by the wheels (W, 3) alone; None where the map has no ground there."""
    try:
        found = settle(T_map_vehicle, match_map, parameters, wheels_m)
    except RegistrationError:
        return None
    return MapMatch(found.T_map_vehicle, found.covariance)


def on_the_road(
    pose: SmoothedPose,
    match_map: MatchMap,
    parameters: RegistrationParameters,
    wheels_m: npt.NDArray[np.float64] = WHEELS_M,
) -> SmoothedPose:
    """Return the pose with height, roll and pitch by the wheels alone; as it is where the map has no ground there."""
    found = settled(pose.T_map_vehicle, match_map, parameters, wheels_m)
    if found is None:
        return pose
    covariance = pose.covariance.copy()
    covariance[_TILT_AND_HEIGHT] = covariance[:, _TILT_AND_HEIGHT] = 0.0
    covariance[_TILT_AND_HEIGHT, _TILT_AND_HEIGHT] = SIGMA_RAD**2, SIGMA_RAD**2, SIGMA_M**2
    return replace(pose, T_map_vehicle=found.T_map_vehicle, covariance=covariance)
