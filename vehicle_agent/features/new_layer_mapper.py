"""The vehicle's side of a new feature layer: gather while driving, map when stopped (Kim et al. 2018, section 2)."""

from gnd_map.geodesy import LocalFrame
from schemas.drive import DriveItem, GnssFix, MotionSample
from vehicle_agent.features.feature_drive import FeatureDrive
from vehicle_agent.features.lane_map import LaneMap
from vehicle_agent.features.look import MapFeatures
from vehicle_agent.features.new_layer import NewLayer, map_new_layer
from vehicle_agent.features.new_layer_parameters import NewLayerParameters


class NewLayerMapper:
    """Takes a vehicle's items one by one; gives the features of the way since the last stop at each, and at the end."""

    def __init__(
        self,
        frame: LocalFrame,
        layer: str,
        parameters: NewLayerParameters | None = None,
        lanes: LaneMap | None = None,
        known: MapFeatures | None = None,
        *,
        trust_known: bool = False,
    ) -> None:
        """Arguments as of `FeatureDrive.of_items` and `map_new_layer`."""
        self.frame, self.layer, self.parameters = frame, layer, parameters or NewLayerParameters()
        self.lanes, self.known, self.trust_known = lanes, known, trust_known
        self._begin()

    def _begin(self) -> None:
        self._items: list[DriveItem] = []
        self._way_m, self._stood_s = 0.0, 0.0
        self._motion: list[MotionSample] = []
        self._fixes = 0

    @property
    def way_m(self) -> float:
        """Driven since the last stop."""
        return self._way_m

    def push(self, item: DriveItem) -> NewLayer | None:
        """Take an item, in order of time. The features when the vehicle has just stopped, else None.

        Raises:
            NewLayerError: as `map_new_layer`; what was gathered is dropped.
        """
        self._items.append(item)
        self._fixes += isinstance(item, GnssFix)
        if not isinstance(item, MotionSample):
            return None
        self._move(item)
        p, t_s = self.parameters, (item.t_ns - self._motion[0].t_ns) * 1e-9
        stopped = self._stood_s >= p.stop_s and self._way_m >= p.least_m
        return self.finish() if stopped or t_s >= p.longest_s else None

    def _move(self, sample: MotionSample) -> None:
        dt_s = (sample.t_ns - self._motion[-1].t_ns) * 1e-9 if self._motion else 0.0
        self._motion = [*self._motion[:1], sample]
        self._way_m += abs(sample.speed_mps) * dt_s
        self._stood_s = self._stood_s + dt_s if abs(sample.speed_mps) < self.parameters.stop_mps else 0.0

    def finish(self) -> NewLayer | None:
        """Map what was gathered and begin anew; None when it is too short a way, or without a fix.

        Raises:
            NewLayerError: as `map_new_layer`; what was gathered is dropped.
        """
        items, ready = self._items, self._way_m >= self.parameters.least_m and self._fixes > 0
        self._begin()
        if not ready:
            return None
        drive = FeatureDrive.of_items(items, self.frame, self.layer)
        return map_new_layer(drive, self.parameters, self.lanes, self.known, trust_known=self.trust_known)
