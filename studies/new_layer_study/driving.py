"""One drive along a route of the new layer study, mapped without and with the lanes of the HD map; localisation."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.cloud_merger.features import merge_layer
from gnd.fleet_sim.drives import EPOCH_NS
from gnd.fleet_sim.roads.drive import RoadDrive, RoadDriveOptions, drive_route
from gnd.fleet_sim.roads.hard_noise import HardNoise
from gnd.fleet_sim.roads.looks import DetectorNoise
from gnd.fleet_sim.roads.recording import items_of
from gnd.fleet_sim.roads.route import Route
from gnd.fleet_sim.roads.streetlights import streetlight_motorway
from gnd.fleet_sim.roads.test_track import test_track
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.features import Feature, FeatureTile, feature_id_of, pieces_of, prior
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import Detections, DriveItem, GnssFix
from gnd.schemas.feature_layer import LayerParameters
from gnd.schemas.features import FeatureReport
from gnd.vehicle_agent.config import PipelineParameters
from gnd.vehicle_agent.features.layer import pose_of
from gnd.vehicle_agent.features.layer_parameters import FeatureParameters
from gnd.vehicle_agent.features.mapping.graph_pipeline import GraphPipeline
from gnd.vehicle_agent.features.slamcu.camera_pipeline import CameraPipeline
from gnd.vehicle_agent.report.reporter import Identity
from gnd.vehicle_agent.sources.recording import first_fix
from studies.feature_study.pipelines import TilesAtOnce, found_in, in_route_frame, joined, reports_of
from studies.new_layer_study.layers import DriveLayers, Layer, LayerLocalised, LayerTruth

TRACK: Final = "track"
MOTORWAY: Final = "motorway"
STRAIGHT: Final = "straight"
NOISES: Final = ("hard", "kind")
CONFIDENCE: Final = 0.9
"""λ of a detector that misses one in ten."""
_HOUR_NS: Final = 3_600 * 1_000_000_000
_LINE_STEP_M: Final = 0.5
_LANE_COV_M2: Final = 1e-4 * np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class RouteTask:
    """A route and how noisy its drives are.

    Attributes:
        kind: `TRACK`, `MOTORWAY` or `STRAIGHT`.
        seed: of the route.
        km: length of a motorway; of the test track the way driven, 0 for one lap.
        beacon: noise level of the detector of point features.
        lane: noise level of the lane camera.
        gnss_bias_m: standard deviation of a drive's constant GNSS error, each axis.
        noise: of `NOISES`.
    """

    kind: str
    seed: int
    km: float
    beacon: float = 1.0
    lane: float = 1.0
    gnss_bias_m: float = 0.0
    noise: str = "hard"

    @property
    def route(self) -> Route:
        """The route itself."""
        if self.kind == TRACK:
            return test_track(self.seed)
        return streetlight_motorway(self.seed, straight=self.kind == STRAIGHT, length_m=1e3 * self.km)

    @property
    def is_usual(self) -> bool:
        """Whether both sensors have noise level 1."""
        return self.beacon == self.lane == 1.0

    @property
    def name(self) -> str:
        """What the progress bar says, and the folder."""
        levels = "" if self.is_usual else f"-beacon-{self.beacon:g}-lane-{self.lane:g}"
        return f"{self.kind}{levels}-{self.noise}"


def drive_of(task: RouteTask, vehicle: int) -> RoadDrive:
    """Return the drive of a vehicle; with other noise levels it drives the same way with the same luck."""
    options = RoadDriveOptions(
        points=DetectorNoise(level=task.beacon),
        lanes=DetectorNoise(level=task.lane, false_alarms=0.0),
        hard=HardNoise() if task.noise == "hard" else None,
        length_m=1e3 * task.km if task.kind == TRACK and task.km else None,
        gnss_bias_m=task.gnss_bias_m,
        start_ns=EPOCH_NS + vehicle * _HOUR_NS,
    )
    return drive_route(task.route, vehicle, options)


def layer_truth(route: Route) -> LayerTruth:
    """Return where the features of a route are, and which way the route goes beside each."""
    way = np.arange(0.0, route.length_m, _LINE_STEP_M)
    line, heading = route.line.at(way)
    xy_m = route.features.xy_m
    nearest = np.array([int(np.argmin(np.sum((line - one) ** 2, axis=1))) for one in xy_m], np.int64)
    return LayerTruth(xy_m, np.column_stack([np.cos(heading[nearest]), np.sin(heading[nearest])]))


def mapped(task: RouteTask, vehicle: int) -> tuple[DriveLayers, list[FeatureReport]]:
    """Return the layers that a drive reports without and with HD map, and the reports of the latter.

    Without map only at the usual noise: Figure 8 is of mapping with it.
    """
    drive = drive_of(task, vehicle)
    without = graph_reports(drive, vehicle, None) if task.is_usual else None
    with_map = graph_reports(drive, vehicle, lane_tiles(drive.route))
    layers = DriveLayers(None if without is None else _reported(drive.route, without), _reported(drive.route, with_map))
    return layers, with_map


def lane_tiles(route: Route) -> list[FeatureTile]:
    """Return the lane markings of a route as the layer "lanes" of a map."""
    tiles: dict[TileId, list[Feature]] = defaultdict(list)
    for number, lane in enumerate(route.lanes()):
        line = np.column_stack([lane, np.zeros(len(lane))])
        marking = Feature(feature_id_of("lane", number), "lane_boundary", line[:2], _LANE_COV_M2, prior(0.95))
        for tile, piece in pieces_of(marking, *route.frame.geodetic_from_enu(line)):
            tiles[tile].append(piece)
    return [FeatureTile.of(tile, 1, found) for tile, found in tiles.items()]


def graph_reports(drive: RoadDrive, vehicle: int, lanes: Sequence[FeatureTile] | None) -> list[FeatureReport]:
    """Return what a vehicle reports that maps by a graph (`gnd agent --localise-by graph`); lanes None: without map."""
    fix, parameters, who, items = _vehicle(drive, vehicle)
    tiles = None if lanes is None else TilesAtOnce({"lanes": lanes})
    pipeline = GraphPipeline(fix, parameters, who, feature_tiles=tiles)
    return reports_of([*map(pipeline.push, items), pipeline.finish()])


def _vehicle(drive: RoadDrive, vehicle: int) -> tuple[GnssFix, PipelineParameters, Identity, Iterator[DriveItem]]:
    """The first fix, the layer of the route as its detector looks for it, who drives, and what was measured."""
    route, view = drive.route, drive.view
    layer = LayerParameters(
        route.layer,
        "camera",
        tuple(sorted(set(route.features.kinds))),
        field_deg=float(np.degrees(view.width_rad)),
        range_m=view.range_m,
        detection_confidence=CONFIDENCE,
    )
    fix, items = first_fix(items_of(drive), route.name)
    parameters = PipelineParameters(features=FeatureParameters((layer,)))
    return fix, parameters, Identity(f"car-{vehicle}", route.name, "none", route.layer), items


def _reported(route: Route, reports: list[FeatureReport]) -> Layer:
    return Layer(*found_in(route.frame, [change for report in reports for change in report.tiles]))


def published(reports: list[FeatureReport]) -> dict[TileId, tuple[Feature, ...]]:
    """Return the layer that the cloud publishes, by tile."""
    return {tile: one.features for tile, one in merge_layer({}, reports).items()}


def integrated(route: Route, reports: list[FeatureReport]) -> Layer:
    """Return the layer that the cloud publishes, in the route's frame."""
    return Layer(
        *joined(
            in_route_frame(route.frame, tile, [(one.position_m, one.cov_m2) for one in features])
            for tile, features in published(reports).items()
        )
    )


def localised(task: RouteTask, vehicle: int, before: list[FeatureReport] | None) -> LayerLocalised:
    """Return the errors of the poses that a vehicle has at its looks while it drives (`--localise-by slamcu`).

    Args:
        task: the route.
        vehicle: whose drive.
        before: reports of earlier drives, of which the cloud has published the layer; None: the map has no such layer.
    """
    drive = drive_of(task, vehicle)
    fix, parameters, who, items = _vehicle(drive, vehicle)
    layer = [FeatureTile.of(tile, 1, features) for tile, features in published(before or []).items() if features]
    pipeline = CameraPipeline(fix, parameters, who, feature_tiles=TilesAtOnce({drive.route.layer: layer}), seed=vehicle)
    T, seconds, errors, looks = drive.route.frame.T_self_other(pipeline.place.frame), [], [], 0
    for item in items:
        online = pipeline.push(item).online
        if not isinstance(item, Detections):
            continue
        if online is not None:
            true = drive.truth.look_poses[looks]
            errors.append(along_and_across(pose_of(T @ online.T_map_vehicle)[None], true[None])[0])
            seconds.append((item.t_ns - drive.motion.t_ns[0]) * 1e-9)
        looks += 1
    return LayerLocalised(np.array(seconds), np.array(errors))


def along_and_across(pose: F64, true: F64) -> F64:
    """Return errors (S, 2) of poses (S, 3): along and to the left of the true heading, m."""
    dx, dy = (pose - true)[:, :2].T
    c, s = np.cos(true[:, 2]), np.sin(true[:, 2])
    return np.column_stack([c * dx + s * dy, c * dy - s * dx])
