"""What a drive reports of its signs, and what the cloud makes of many drives' reports."""

from collections.abc import Sequence

import numpy as np

from gnd.cloud_merger.features import merge_layer
from gnd.fleet_sim.roads.drive import RoadDrive
from gnd.fleet_sim.roads.route import MAP_ERROR_M, Route
from gnd.gnd_map.arrays import F64
from gnd.schemas.features import FeatureReport
from gnd.vehicle_agent.features.layer import bounded, of_counts
from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters
from gnd.vehicle_agent.features.slamcu.tracked_feature import FeatureClass
from gnd.vehicle_agent.features.view import TYPICAL_HEIGHT_M
from studies.feature_study.reporting import (
    BaseLayer,
    Discovered,
    Judged,
    coverage_along,
    in_route_frame,
    reports_of,
)
from studies.slamcu_study.driving import Driven, occlusion_of, said_lost, sensor_view
from studies.slamcu_study.signs import MergedSigns


def base_layer(route: Route) -> BaseLayer:
    """Return the signs of the HD map as tiles."""
    mapped = route.features.mapped
    return BaseLayer.of(route.frame, mapped.feature_id, mapped.kinds, mapped.mapped_xy_m, MAP_ERROR_M)


def sign_reports(drive: RoadDrive, driven: Driven, vehicle: int, parameters: SlamcuParameters) -> list[FeatureReport]:
    """Return what a vehicle sends after its drive: its own evidence on the map's signs, and the new ones it found."""
    told = ~said_lost(driven)  # of a stretch on which it was lost nothing is said
    occlusions = (occlusion_of(drive, look) for look in driven.look[told].tolist())
    coverage = coverage_along(
        drive.route.frame, sensor_view(drive.view), driven.pose[told], occlusions, TYPICAL_HEIGHT_M
    )
    confidence = parameters.detection_confidence
    judged = [
        Judged(one.feature_id, of_counts(one.hits, one.misses, confidence), one.hits, one.position_m, one.cov_m2)
        for one in driven.known
        if one.hits + one.misses
    ]
    found = [
        Discovered(one.kind, one.position_m, one.cov_m2, bounded(one.existence), one.hits)
        for one in driven.new
        if one.feature_class == FeatureClass.NEW
    ]
    times = (drive.looks[int(driven.look[0])].t_ns, drive.looks[int(driven.look[-1])].t_ns)
    return reports_of(base_layer(drive.route), drive.route.layer, f"car-{vehicle}", times, coverage, (judged, found))


def merged_signs(route: Route, reports: Sequence[FeatureReport]) -> MergedSigns:
    """Return what the cloud publishes."""
    base = base_layer(route)
    known: list[int] = []
    xy_m: list[F64] = [np.zeros((0, 2))]
    cov_m2: list[F64] = [np.zeros((0, 2, 2))]
    for tile, merged in merge_layer(base.epochs, reports).items():
        known += [one.feature_id for one in merged.features if one.feature_id in base.tile_of]
        new = [one for one in merged.features if one.feature_id not in base.tile_of]
        places = in_route_frame(route.frame, tile, new)
        xy_m.append(places[0])
        cov_m2.append(places[1])
    return MergedSigns(np.array(sorted(known), np.int64), np.concatenate(xy_m), np.concatenate(cov_m2))
