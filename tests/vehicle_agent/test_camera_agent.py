"""A vehicle without LiDAR that localises by signs (SLAMCU): the pipeline, and the agent over a real router."""

import threading
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from gnd.fleet_bus.bus import Bus
from gnd.fleet_sim.roads.drive import RoadDrive, RoadDriveOptions, drive_route
from gnd.fleet_sim.roads.motorway import motorway
from gnd.fleet_sim.roads.recording import items_of, write_road_drive
from gnd.fleet_sim.roads.route import Route
from gnd.schemas.drive import GnssFix, MotionSample
from gnd.schemas.features import FeatureReport
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.agent import run_agent
from gnd.vehicle_agent.config import AgentConfig, PipelineParameters
from gnd.vehicle_agent.errors import AgentConfigError
from gnd.vehicle_agent.features.layer_parameters import FeatureParameters
from gnd.vehicle_agent.features.slamcu.camera_pipeline import CameraPipeline
from gnd.vehicle_agent.report.reporter import Identity
from gnd.vehicle_agent.sources.recording import first_fix
from studies.feature_study.pipelines import TilesAtOnce
from studies.slamcu_study.driving import sign_tiles

SEED, LENGTH_M = 31, 6000.0
WHO = Identity("car", "drive", "none", "signs")
SIGNS = PipelineParameters(features=FeatureParameters.of("signs"))


@lru_cache
def route() -> Route:
    return motorway(SEED, LENGTH_M)


@lru_cache
def driven() -> RoadDrive:
    return drive_route(route(), 0, RoadDriveOptions())


def reports_of(drive: RoadDrive) -> tuple[CameraPipeline, list[FeatureReport]]:
    fix, items = first_fix(items_of(drive), "drive")
    pipeline, reports = (
        CameraPipeline(fix, SIGNS, WHO, feature_tiles=TilesAtOnce({"signs": sign_tiles(drive.route).values()})),
        [],
    )
    for item in items:
        reports += pipeline.push(item).reports
    reports += pipeline.finish().reports
    return pipeline, [FeatureReport.decode(one.body) for one in reports]


def judged(reports: list[FeatureReport]) -> tuple[dict[int, bool], int]:
    """Whether each sign of the map is there, as the reports say, and how many new ones there are."""
    tiles = [change for report in reports for change in report.tiles]
    seen = {one.feature_id: one.existence.exist > one.existence.absent for change in tiles for one in change.seen}
    return seen, sum(len(change.found) for change in tiles)


@pytest.mark.slow
def test_signs_are_judged_and_found_by_the_filters_own_poses() -> None:
    pipeline, reports = reports_of(driven())
    features = route().features
    truth = dict(zip(features.feature_id.tolist(), features.states, strict=True))
    seen, found = judged(reports)
    wrong = [one for one, there in seen.items() if there == (truth[one] == "deleted")]
    assert len(seen) >= 0.9 * sum(state != "new" for state in truth.values())
    assert len(wrong) <= 1
    assert abs(found - sum(state == "new" for state in truth.values())) <= 2
    assert pipeline.slamcu is not None
    assert not [lost for lost in pipeline.slamcu.lost if not lost.replayed]


@pytest.mark.slow
def test_a_gnss_that_is_beside_itself_takes_back_and_calls_no_map_wrong() -> None:
    """From the middle on 60 m aside: wheels, gyro and signs say otherwise; what is in doubt is not told."""
    honest = driven()
    xy_m = honest.gnss.xy_m.copy()
    xy_m[len(xy_m) // 2 :] += np.array([42.0, -42.0])
    pipeline, reports = reports_of(replace(honest, gnss=replace(honest.gnss, xy_m=xy_m)))
    features = route().features
    truth = dict(zip(features.feature_id.tolist(), features.states, strict=True))
    seen, _ = judged(reports)
    called_gone = [one for one, there in seen.items() if not there and truth[one] != "deleted"]
    assert len(called_gone) <= 1
    assert pipeline.slamcu is not None
    said_lost = any(not lost.replayed for lost in pipeline.slamcu.lost)
    assert said_lost or pipeline.slamcu.fixes_refused > 100


def test_before_the_first_pose_nothing_is_judged_and_a_vehicle_that_stands_waits() -> None:
    fix = GnssFix(0, 0.85, 0.15, 100.0, 1.0)
    pipeline = CameraPipeline(fix, SIGNS, WHO)
    for k in range(2000):
        pipeline.push(MotionSample(1 + k * 20_000_000, 0.0, 0.0))
        if k % 50 == 0:
            pipeline.push(replace(fix, t_ns=2 + k * 20_000_000))
    assert pipeline.slamcu is None
    assert pipeline.finish().reports == ()


def test_a_fix_of_which_nobody_says_what_it_is_worth_is_counted_and_moves_nothing() -> None:
    fix = GnssFix(0, 0.85, 0.15, 100.0, 1.0)
    pipeline = CameraPipeline(fix, SIGNS, WHO)
    for k in range(500):
        t_ns = k * 20_000_000
        pipeline.push(MotionSample(1 + t_ns, 10.0, 0.0))
        if k % 25 == 0:
            pipeline.push(replace(fix, t_ns=2 + t_ns, lat_rad=0.85 + k * 0.2 / 6.37e6))
    assert pipeline.slamcu is not None
    before, _ = pipeline.slamcu.pose()
    pipeline.push(replace(fix, t_ns=600 * 20_000_000, lat_rad=0.851, sigma_m=0.0))
    assert pipeline.guard.bad["no-sigma"] == 1
    np.testing.assert_array_equal(pipeline.slamcu.pose()[0], before)


def test_it_needs_one_layer_that_a_camera_looks_for() -> None:
    for names in (("streetlights",), ("signs", "poles")):
        parameters = PipelineParameters(features=FeatureParameters.of(*names))
        with pytest.raises(AgentConfigError, match="one layer that its camera"):
            CameraPipeline(GnssFix(0, 0.85, 0.15, 100.0, 1.0), parameters, WHO)


@pytest.mark.slow
def test_the_agent_drives_it_over_the_bus(bus: Bus, endpoint: str, tmp_path: Path) -> None:
    path = write_road_drive(driven(), "camera-car", tmp_path / "drive.mcap")
    with SqliteStore(tmp_path / "store.sqlite") as store, TileServer(store, bus):
        store.put_tiles(list(sign_tiles(driven().route).values()), layer="signs")
        config = AgentConfig(
            vehicle="camera-car",
            drive=path,
            work_dir=tmp_path / "camera-car",
            connect=(endpoint,),
            features=FeatureParameters.of("signs"),
            localise_by="slamcu",
            report=replace(AgentConfig("v", path, tmp_path).report, drain_s=0.5),  # nobody acknowledges here
        )
        result = run_agent(config, threading.Event())
    assert result["finished"]
    assert result["layers"]["signs"]["seen"] >= 10
    assert result["layers"]["signs"]["found"] >= 5
    assert result["localisation"]["lateral_p95_m"] < 4.0
    assert result["reports_pending"] == result["reports_sent"] > 0
