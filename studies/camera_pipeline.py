"""Signs as the agent's own camera pipeline reports them (`gnd agent --localise-by slamcu`), beside the study's loop.

A motorway a seed, one drive: its items go into `CameraPipeline`, with the tiles of the map around the vehicle; what is
counted is what its reports say. Beside it SLAMCU over the same drive as `gnd reproduce slamcu` runs it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from gnd.fleet_sim.roads.drive import RoadDrive, drive_route
from gnd.fleet_sim.roads.motorway import motorway
from gnd.fleet_sim.roads.recording import items_of
from gnd.fleet_sim.roads.route import MAP_ERROR_M
from gnd.gnd_map.features import FeatureTile
from gnd.schemas.features import FeatureReport
from gnd.vehicle_agent.config import PipelineParameters
from gnd.vehicle_agent.features.layer_parameters import FeatureParameters
from gnd.vehicle_agent.features.slamcu.camera_pipeline import CameraPipeline
from gnd.vehicle_agent.features.slamcu.parameters import SlamcuParameters
from gnd.vehicle_agent.features.slamcu.tracked_feature import FeatureClass
from gnd.vehicle_agent.place import Place
from gnd.vehicle_agent.report.reporter import Identity
from gnd.vehicle_agent.sources.recording import first_fix
from studies.feature_study.reporting import BaseLayer
from studies.frame.measure import Figure
from studies.frame.options import option, seeds
from studies.slamcu_study.driving import run_slamcu
from studies.slamcu_study.signs import FULL


@dataclass(frozen=True, slots=True)
class CameraPipelineOptions:
    """What is driven."""

    seeds: tuple[int, ...] = seeds(1101, 1102, text="Of the motorways.")
    km: float = option(8.0, "Length of each motorway.")


OPTIONS: Final = CameraPipelineOptions


class WholeLayer:
    """All tiles of the map, with the first question."""

    def __init__(self, drive: RoadDrive) -> None:
        mapped = drive.route.features.mapped
        layer = BaseLayer.of(drive.route.frame, mapped.feature_id, mapped.kinds, mapped.mapped_xy_m, MAP_ERROR_M)
        self._tiles = list(layer.tiles.values())

    def follow(self, place: Place) -> Iterator[tuple[str, FeatureTile]]:  # noqa: ARG002  (all are given at once)
        """See `FeatureTiles`."""
        tiles, self._tiles = self._tiles, []
        yield from (("signs", tile) for tile in tiles)


def run(chosen: CameraPipelineOptions | None = None) -> list[Figure]:
    """Drive every motorway both ways."""
    chosen = chosen or CameraPipelineOptions()
    return [_figure(seed, drive_route(motorway(seed, 1e3 * chosen.km), 0)) for seed in chosen.seeds]


def _figure(seed: int, drive: RoadDrive) -> Figure:
    there, found, lost = reported(drive)
    features = drive.route.features
    truth = dict(zip(features.feature_id.tolist(), features.states, strict=True))
    known, new = sum(state != "new" for state in truth.values()), sum(state == "new" for state in truth.values())
    right = sum(exists == (truth[one] != "deleted") for one, exists in there.items())
    loop = run_slamcu(drive, FULL, SlamcuParameters(), 0, lambda *_: None)
    wanted = {True: FeatureClass.DELETED, False: FeatureClass.NORMAL}
    same = sum(one.feature_class == wanted[truth[one.feature_id] == "deleted"] for one in loop.known)
    loop_new = sum(one.feature_class == FeatureClass.NEW for one in loop.new)
    detail = (
        f"judged {len(there)}, right {right} of {known}, new ones found {found} of {new}, stretches given up {lost};"
        f" the study's loop: right {same} of {known}, new ones {loop_new}"
    )
    return Figure(f"signs of motorway {seed} judged rightly", 100.0 * right / known, "%", detail)


def reported(drive: RoadDrive) -> tuple[dict[int, bool], int, int]:
    """Whether each sign of the map is there, as the reports say; how many new ones; stretches given up."""
    fix, items = first_fix(items_of(drive), drive.route.name)
    parameters = PipelineParameters(features=FeatureParameters.of("signs"))
    who = Identity("camera-car", drive.route.name, "none", "signs")
    pipeline = CameraPipeline(fix, parameters, who, feature_tiles=WholeLayer(drive))
    bodies = [report.body for item in items for report in pipeline.push(item).reports]
    bodies += [report.body for report in pipeline.finish().reports]
    tiles = [change for body in bodies for change in FeatureReport.decode(body).tiles]
    there = {one.feature_id: one.existence.exist > one.existence.absent for tile in tiles for one in tile.seen}
    given_up = 0 if pipeline.slamcu is None else sum(not one.replayed for one in pipeline.slamcu.lost)
    return there, int(np.sum([len(tile.found) for tile in tiles])), given_up
