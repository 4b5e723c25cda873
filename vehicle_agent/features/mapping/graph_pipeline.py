"""A vehicle that maps features without a LiDAR map: by motion, a low-cost GNSS, a detector, and the lanes of the map.

The route of NFL, section 3: gather while driving; when the vehicle has stopped, one graph of the whole stretch gives
the features and how certain they are; they are reported, and gathering begins anew. Until then the place is known as
the GNSS has it: degraded, with the cause "hindsight".
"""

import logging
import math
from dataclasses import replace
from typing import Any, Final

import numpy as np

from gnd.schemas.drive import DriveItem, GnssFix, MotionSample, ReferencePose
from gnd.schemas.feature_layer import LayerParameters
from gnd.vehicle_agent.config import PipelineParameters
from gnd.vehicle_agent.errors import NewLayerError
from gnd.vehicle_agent.features.mapping.feature_drive import FeatureDrive
from gnd.vehicle_agent.features.mapping.held_map import HeldMap
from gnd.vehicle_agent.features.mapping.mapped import changes_of
from gnd.vehicle_agent.features.mapping.new_layer import map_new_layer
from gnd.vehicle_agent.features.without_lidar import VehicleWithoutLidar
from gnd.vehicle_agent.localise.estimates import PoseEstimate
from gnd.vehicle_agent.pipeline import FeatureTiles, Output
from gnd.vehicle_agent.place import HEADING_BASE_M
from gnd.vehicle_agent.report.feature_report import FeatureReporter
from gnd.vehicle_agent.report.reporter import Identity
from gnd.vehicle_agent.report.sink import ReportSink

STILL_MPS: Final = 0.1
STILL_S: Final = 3.0
LEAST_WAY_M: Final = 200.0
"""A stop after less way than this does not end a stretch: queues of cars stop often."""
OUTAGE_S: Final = 5.0
"""So long after the last fix the place is not known."""
ANY_HEADING_RAD: Final = math.pi / math.sqrt(3.0)
"""Standard deviation of a heading that may be any."""

_log = logging.getLogger(__name__)


class GraphPipeline(VehicleWithoutLidar):
    """One drive of one vehicle without LiDAR that maps feature layers stretch by stretch.

    Args:
        fix: the first position, which lays the map frame.
        parameters: of the feature layers.
        identity: who reports; the layers are put in here.
        outbox: where reports go; None: nowhere but into the `Output`.
        feature_tiles: the map's tiles of the layers and of lanes; None: no map.

    Attributes:
        counts: stretches mapped, refused and contradicting.
    """

    def __init__(
        self,
        fix: GnssFix,
        parameters: PipelineParameters,
        identity: Identity,
        outbox: ReportSink | None = None,
        feature_tiles: FeatureTiles | None = None,
    ) -> None:
        super().__init__(fix, outbox, "no_position")
        self._parameters, self._feature_tiles = parameters, feature_tiles
        longest_m = parameters.report.unchanged_m
        self._reporters = {
            layer.name: FeatureReporter(self._new_reports, replace(identity, layer=layer.name), fix.t_ns, longest_m)
            for layer in parameters.features.layers
        }
        self._held = HeldMap(self.place.frame)
        self._gathered: list[DriveItem] = []
        self._since_m = 0.0
        self._fix: GnssFix | None = None  # the last one with a sigma
        self._fix_m = 0.0
        self._still_since_ns: int | None = None

    def push(self, item: DriveItem) -> Output:
        """Take the next measurement; items come in time order. Where the vehicle has stopped, its stretch is mapped."""
        if isinstance(item, ReferencePose) or not self.guard.admits(item):
            return self._output()
        if self._feature_tiles is not None:
            for layer, tile in self._feature_tiles.follow(self.place):
                self._held.put(layer, tile.tile_id, tile)
        self._gathered.append(item)
        self.place.take(item, None)
        if isinstance(item, GnssFix) and item.sigma_m > 0:
            self._fix, self._fix_m = item, self.place.odometer_m
        self._note_health(item.t_ns)
        if isinstance(item, MotionSample):
            moves = abs(item.speed_mps) > STILL_MPS
            self._still_since_ns = None if moves else (self._still_since_ns or item.t_ns)
        if self._has_stopped:
            self._map_stretch()
        return self._output()

    def finish(self) -> Output:
        """The drive has ended: map the last stretch."""
        self._map_stretch()
        return self._output()

    def account(self) -> dict[str, Any]:
        """What the drive came to, as plain values."""
        names = ("stretches", "stretches_refused", "stretches_contradicting")
        return {
            **{name: self.counts[name] for name in names},
            "health": self.timeline.as_json(),
            "layers": {name: dict(reporter.counts) for name, reporter in self._reporters.items()},
        }

    @property
    def _has_stopped(self) -> bool:
        """Whether the vehicle has stood for some seconds after a stretch of way."""
        stood = self._still_since_ns is not None and self.place.t_ns - self._still_since_ns >= STILL_S * 1e9
        return stood and self.place.odometer_m - self._since_m >= LEAST_WAY_M

    def _map_stretch(self) -> None:
        """Map every layer over the stretch gathered, and report; a stretch that cannot be placed is left out."""
        items, self._gathered = self._gathered, []
        self._since_m = self.place.odometer_m
        for layer in self._parameters.features.layers:
            try:
                self._map(layer, items)
            except NewLayerError as error:
                self.counts["stretches_refused"] += 1
                _log.warning("no map of layer %s: %s", layer.name, error)

    def _map(self, layer: LayerParameters, items: list[DriveItem]) -> None:
        drive = FeatureDrive.of_items(items, self.place.frame, layer.name)
        if not drive.looks:
            return
        known = self._held.known(layer.name, layer.kinds)
        found = map_new_layer(drive, lanes=self._held.lanes(), known=known, trust_known=False)
        if found.strains:
            self.counts["stretches_contradicting"] += 1
            raise NewLayerError("the graph contradicts itself: " + "; ".join(map(str, found.strains)))
        self.counts["stretches"] += 1
        reporter = self._reporters[layer.name]
        for change in changes_of(found, drive, self._held, layer, self.place.height_m):
            reporter.add(change, drive.looks[0].t_ns, self.place.odometer_m)
        reporter.report_all(drive.looks[-1].t_ns)

    def _note_health(self, t_ns: int) -> None:
        self._online = self._gnss_pose(t_ns)
        self.place.health = "lost" if self._online is None else self._online.health
        self.timeline.note(t_ns, self.place.health)

    def _gnss_pose(self, t_ns: int) -> PoseEstimate | None:
        """The pose of the last fix, as uncertain as that and the way since; None: there is none of late."""
        fix = self._fix
        if fix is None or t_ns - fix.t_ns > OUTAGE_S * 1e9:
            return None
        place, T = self.place, np.eye(4)
        T[:3, 3] = place.position_map_m
        sigma_rad = ANY_HEADING_RAD
        if place.heading_rad is not None:
            c, s = math.cos(place.heading_rad), math.sin(place.heading_rad)
            T[:2, :2] = [[c, -s], [s, c]]
            sigma_rad = min(math.sqrt(2.0) * fix.sigma_m / HEADING_BASE_M, ANY_HEADING_RAD)  # of two fixes
        sigma_m = math.hypot(fix.sigma_m, place.odometer_m - self._fix_m)
        return PoseEstimate(t_ns, T, sigma_m, sigma_rad, 0.0, "degraded", "hindsight")
