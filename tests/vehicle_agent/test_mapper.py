"""Vehicles without LiDAR make a layer that no map had: real router, tile server, merger shard and recordings."""

import signal
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from waiting import wait_until

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.merger import run_shard
from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.settings_file import load_settings
from gnd.fleet_sim.roads.drive import RoadDrive, RoadDriveOptions, drive_route
from gnd.fleet_sim.roads.recording import write_road_drive
from gnd.fleet_sim.roads.route import Route
from gnd.fleet_sim.roads.streetlights import streetlight_motorway
from gnd.gnd_map.features import Feature, FeatureTile, feature_id_of, geodetic_in_tile, pieces_of, prior
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import GnssFix, MotionSample
from gnd.schemas.errors import LayerError
from gnd.schemas.feature_layer import LAYERS
from gnd.schemas.features import FeatureReport
from gnd.schemas.keys import traffic_keys
from gnd.schemas.traffic import TrafficSample
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig
from gnd.vehicle_agent.agent import AgentConfig, run_agent
from gnd.vehicle_agent.cli import agent
from gnd.vehicle_agent.config import PipelineParameters
from gnd.vehicle_agent.errors import AgentConfigError
from gnd.vehicle_agent.features.layer_parameters import FeatureParameters
from gnd.vehicle_agent.features.mapping.graph_pipeline import GraphPipeline
from gnd.vehicle_agent.report.reporter import Identity

LENGTH_M = 700.0
VEHICLES = 3
LIGHTS = replace(LAYERS["streetlights"], range_m=50.0, detection_confidence=0.9)


def lane_tiles(route: Route) -> list[FeatureTile]:
    """The route's lane markings as the layer "lanes" of a map."""
    tiles: dict[TileId, list[Feature]] = defaultdict(list)
    for number, lane in enumerate(route.lanes(5.0)):
        line = np.column_stack([lane, np.zeros(len(lane))])
        marking = Feature(
            feature_id_of("lane", number), "lane_boundary", line[:2], np.full(6, 1e-4) * [1, 0, 0, 1, 0, 1], prior(0.95)
        )
        for tile, piece in pieces_of(marking, *route.frame.geodetic_from_enu(line)):
            tiles[tile].append(piece)
    return [FeatureTile.of(tile, 1, found) for tile, found in tiles.items()]


@pytest.fixture(scope="module")
def route() -> Route:
    return streetlight_motorway(11, length_m=LENGTH_M)


@contextmanager
def cloud_of(shard: ShardConfig, bus: Bus, route: Route) -> Iterator[SqliteStore]:
    """A shard and a tile server whose map holds lanes, and nothing else."""
    stop = threading.Event()
    with SqliteStore(shard.store_path) as opened:
        opened.put_tiles(lane_tiles(route), layer="lanes")
        thread = threading.Thread(target=run_shard, args=(shard, stop))
        thread.start()
        with TileServer(opened, bus):
            yield opened
        stop.set()
        thread.join()


@pytest.fixture
def store(bus: Bus, endpoint: str, route: Route, tmp_path: Path) -> Iterator[SqliteStore]:
    quick = StoreConfig(merge_delay_s=0.2)
    with cloud_of(
        ShardConfig(store_path=tmp_path / "store.sqlite", connect=(endpoint,), store=quick), bus, route
    ) as it:
        yield it


def reflected(honest: RoadDrive) -> RoadDrive:
    """The same drive with a GNSS that is 30 m beside itself for its second half."""
    xy_m = honest.gnss.xy_m.copy()
    xy_m[len(xy_m) // 2 :] += np.array([21.0, -21.0])
    return replace(honest, gnss=replace(honest.gnss, xy_m=xy_m))


def drive(
    route: Route, vehicle: int, endpoint: str, folder: Path, gone_wrong: Callable[[RoadDrive], RoadDrive] | None = None
) -> dict[str, object]:
    folder.mkdir(exist_ok=True)
    name, driven = f"mapper-{vehicle}", drive_route(route, vehicle, RoadDriveOptions())
    path = write_road_drive(gone_wrong(driven) if gone_wrong else driven, name, folder / f"{name}.mcap")
    config = AgentConfig(
        vehicle=name,
        drive=path,
        work_dir=folder / name,
        connect=(endpoint,),
        features=FeatureParameters((LIGHTS,)),
        localise_by="graph",
    )
    return run_agent(config, threading.Event())


def published(store: SqliteStore, route: Route, layer: str = "streetlights") -> np.ndarray:
    """(N, 2) where the layer has features, in the route's frame."""
    places = [np.zeros((0, 3))]
    for entry in store.heads(layer):
        tile = store.get(layer, entry.tile)
        assert tile is not None
        points = np.array([one.position_m for one in tile.decode_features().features]).reshape(-1, 3)
        places.append(
            route.frame.enu_from_geodetic(*geodetic_in_tile(entry.tile, points)) if len(points) else places[0]
        )
    return np.concatenate(places)[:, :2]


@pytest.mark.slow
def test_vehicles_without_lidar_make_a_layer_and_one_alone_does_not(
    route: Route, store: SqliteStore, endpoint: str, tmp_path: Path
) -> None:
    first = drive(route, 0, endpoint, tmp_path)
    assert first["finished"]
    assert first["reports_acknowledged"] == first["reports_sent"] > 0  # type: ignore[operator]
    wait_until(lambda: store.dirty_count() == 0)
    assert store.heads("streetlights") == []

    for vehicle in range(1, VEHICLES):
        drive(route, vehicle, endpoint, tmp_path)
    wait_until(lambda: store.dirty_count() == 0)
    found, truth = published(store, route), route.features.xy_m
    gap = np.linalg.norm(truth[:, None] - found[None], axis=2)
    assert (gap.min(axis=1) < 2.0).mean() >= 0.7  # the first and last lights are in view of few looks
    assert (gap.min(axis=0) < 2.0).all()
    assert gap.min(axis=1)[gap.min(axis=1) < 2.0].mean() < 0.6
    reports = [FeatureReport.decode(row.body) for row in store.reports("streetlights")]
    assert {report.vehicle for report in reports} == {f"mapper-{n}" for n in range(VEHICLES)}
    assert store.quarantined() == []


@pytest.mark.slow
def test_a_graph_that_contradicts_itself_reports_nothing_and_says_so(
    route: Route, store: SqliteStore, endpoint: str, tmp_path: Path
) -> None:
    """The optimum is a compromise between motion and fixes that cannot both be right; no light of it leaves the car."""
    honest = drive(route, 1, endpoint, tmp_path / "honest")
    assert (honest["stretches"], honest["stretches_contradicting"]) == (1, 0)
    assert honest["reports_sent"] > 0  # type: ignore[operator]
    wrong = drive(route, 1, endpoint, tmp_path / "wrong", reflected)
    assert (wrong["stretches"], wrong["stretches_contradicting"]) == (0, 1)
    assert wrong["reports_sent"] == 0


def test_a_vehicle_without_lidar_needs_a_feature_layer(tmp_path: Path) -> None:
    with pytest.raises(AgentConfigError, match="feature layer"):
        AgentConfig(vehicle="v", drive=tmp_path / "none.mcap", work_dir=tmp_path, localise_by="graph")


HYDRANTS = """
[[feature_layer]]
name = "hydrants"
kinds = ["hydrant"]
sensor = "camera"
range_m = 50.0
reach_m = 10.0
"""


def sees_hydrants(drive: RoadDrive) -> RoadDrive:
    """The same drive of a vehicle whose detector calls what it sees hydrants."""
    looks = [
        replace(look, sensor="camera", layer="hydrants", kinds=("hydrant",) * len(look.kinds)) for look in drive.looks
    ]
    return replace(drive, looks=tuple(looks))


@pytest.fixture
def own_signals() -> Iterator[None]:
    """`gnd agent` takes signals for itself."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.slow
@pytest.mark.usefixtures("own_signals")
def test_a_layer_that_only_its_user_knows(bus: Bus, endpoint: str, route: Route, tmp_path: Path) -> None:
    """One table declares it; `gnd agent --layers hydrants`, a shard and the tile server read the same file."""
    declared = tmp_path / "hydrants.toml"
    declared.write_text(HYDRANTS)
    own = {"store_path": str(tmp_path / "s.sqlite"), "connect": [endpoint], "store": {"merge_delay_s": 0.2}}
    shard, samples = load_settings(ShardConfig, "merger", declared, (), own, {}), []
    bus.subscribe(traffic_keys(), lambda _key, body: samples.append(TrafficSample.decode(body)), kind="telemetry")
    with cloud_of(shard, bus, route) as store:
        for vehicle in range(2):
            name = f"mapper-{vehicle}"
            path = write_road_drive(
                sees_hydrants(drive_route(route, vehicle, RoadDriveOptions())), name, tmp_path / f"{name}.mcap"
            )
            command = ["--drive", path, "--vehicle", name, "--work-dir", tmp_path / name, "--connect", endpoint]
            command += ["--config", declared, "--layers", "hydrants", "--localise-by", "graph"]
            CliRunner().invoke(agent, list(map(str, command)), catch_exceptions=False)
        wait_until(lambda: store.dirty_count() == 0)
        found, truth = published(store, route, "hydrants"), route.features.xy_m
        gap = np.linalg.norm(truth[:, None] - found[None], axis=2)
        assert (gap.min(axis=1) < 2.0).mean() >= 0.6
        assert (gap.min(axis=0) < 2.0).all()
        assert store.quarantined() == []
    assert {sample.health for sample in samples} >= {"degraded"}


def test_a_layer_that_nobody_declared_ends_the_agent_before_it_drives(tmp_path: Path) -> None:
    declared = tmp_path / "hydrants.toml"
    declared.write_text(HYDRANTS)
    command = ["--drive", "none.mcap", "--config", str(declared), "--layers", "hydrant", "--dump-config"]
    with pytest.raises(LayerError, match="known are signs, streetlights, poles, hydrants"):
        CliRunner().invoke(agent, command, catch_exceptions=False)


def test_a_vehicle_that_knows_its_way_in_hindsight_says_how_well_it_knows_it_now() -> None:
    fix = GnssFix(0, 0.85, 0.15, 100.0, 2.0)
    pipeline = GraphPipeline(fix, PipelineParameters(), Identity("car", "drive", "none", "ndt"))
    nothing = pipeline.push(replace(fix, sigma_m=0.0))  # nobody says what it is worth
    assert (nothing.online, nothing.health, nothing.cause, pipeline.place.health) == (
        None,
        "lost",
        "no_position",
        "lost",
    )
    first = pipeline.push(replace(fix, t_ns=1)).online
    assert first is not None
    assert (first.sigma_m, first.sigma_rad > 1.8) == (2.0, True)
    for k in range(1, 300):
        out = pipeline.push(MotionSample(1 + k * 20_000_000, 10.0, 0.0))
        if k == 100:
            assert (out.health, out.cause, pipeline.place.health) == ("degraded", "hindsight", "degraded")
            assert out.online is not None
            assert out.online.sigma_m == pytest.approx(np.hypot(2.0, 19.8), abs=0.3)  # two seconds without a fix
    assert (out.online, out.health, out.cause) == (None, "lost", "no_position")
    assert [one["health"] for one in pipeline.account()["health"]] == ["lost", "degraded", "lost"]
