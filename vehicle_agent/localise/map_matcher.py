"""Matches of scans with the local map, for the mount in use."""

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.localise import level
from gnd.vehicle_agent.localise.graph import MapMatch, SmoothedPose
from gnd.vehicle_agent.localise.health import HealthMonitor
from gnd.vehicle_agent.localise.match_map import MatchMapCache
from gnd.vehicle_agent.localise.neighbours import FAR_M, UNSURE_M, hedged, weakest
from gnd.vehicle_agent.localise.parameters import RegistrationParameters
from gnd.vehicle_agent.localise.registration import RegistrationResult, Start, register
from gnd.vehicle_agent.localise.remount import Mounting


class MapMatcher:
    """Matches points in the axes of the mount in use; the wheels keep the vehicle on the map's road.

    Attributes:
        maps: the local map, ready for registration.
    """

    def __init__(self, maps: MatchMapCache, parameters: RegistrationParameters, mounting: Mounting) -> None:
        self.maps = maps
        self._par, self._mounting = parameters, mounting

    def match(self, points_m: F64, T_start: F64, start: Start) -> RegistrationResult | None:
        """Return the match of points (N, 3) begun at a pose (4, 4); None where there is nothing to match with."""
        try:
            return register(
                points_m, T_start, self.maps.near(T_start[:3, 3]), self._par, start, self._mounting.wheels_m
            )
        except RegistrationError:
            return None

    def gated(
        self, monitor: HealthMonitor, points_m: F64, T_predicted: F64, sigmas: F64, t_ns: int
    ) -> tuple[RegistrationResult | None, bool]:
        """Return the match of points (N, 3), and whether `monitor` believes it.

        It is sought near the prediction (4, 4), with one sigma (6,) of where it may lie; if the monitor doubts that
        match, a wider one is tried.
        """
        near = self.match(points_m, T_predicted, "near")
        if near is not None:
            near, _ = hedged(
                points_m, near, self.maps.near(T_predicted[:3, 3]), self._par, wheels_m=self._mounting.wheels_m
            )
        wide = None
        doubtful = monitor.doubtful(near)
        if doubtful:
            wide = self.match(points_m, T_predicted, "wide")
        monitor.see_wider(near, wide)
        result, believed = near, monitor.believe(near, T_predicted, sigmas, t_ns)
        if doubtful and not believed:
            result, believed = wide, monitor.believe(wide, T_predicted, sigmas, t_ns)
        monitor.see_verdict(result, believed)
        return result, believed

    def first(self, points_m: F64, result: RegistrationResult) -> tuple[F64, bool]:
        """Return the covariance (6, 6) of a first pose, and whether the scans to come must confirm it.

        They must where a neighbouring minimum fits as well, or where so little holds the pose that there may be one
        elsewhere. A pose from outside is no match (no iterations), and has no neighbours.
        """
        if not result.iterations:
            return result.covariance, False
        m = self.maps.near(result.T_map_vehicle[:3, 3])
        known, contested = hedged(points_m, result, m, self._par, FAR_M, 0.0, self._mounting.wheels_m)
        return known.covariance, contested or weakest(result)[0] > UNSURE_M

    def by_wheels(self, T_map_vehicle: F64) -> MapMatch | None:
        """Return a pose (4, 4) with height and tilt by the wheels alone; None where the map has no ground."""
        m = self.maps.near(T_map_vehicle[:3, 3])
        return level.settled(T_map_vehicle, m, self._par, self._mounting.wheels_m)

    def on_the_road(self, pose: SmoothedPose) -> SmoothedPose:
        """Return the pose with height, roll and pitch by the wheels alone (`level.on_the_road`)."""
        m = self.maps.near(pose.T_map_vehicle[:3, 3])
        return level.on_the_road(pose, m, self._par, self._mounting.wheels_m)
