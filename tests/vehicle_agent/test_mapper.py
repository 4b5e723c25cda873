"""Vehicles without LiDAR make a layer that no map had: real router, tile server, merger shard and recordings."""

import threading
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from waiting import wait_until

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.merger import run_shard
from gnd.fleet_bus.bus import Bus
from gnd.fleet_sim.roads.drive import RoadDrive, RoadDriveOptions, drive_route
from gnd.fleet_sim.roads.recording import write_road_drive
from gnd.fleet_sim.roads.route import Route
from gnd.fleet_sim.roads.streetlights import streetlight_motorway
from gnd.gnd_map.features import Feature, FeatureTile, feature_id_of, geodetic_in_tile, pieces_of, prior
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.features import FeatureReport
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig
from gnd.vehicle_agent.agent import AgentConfig, run_agent
from gnd.vehicle_agent.errors import AgentConfigError
from gnd.vehicle_agent.features.layer_parameters import LAYERS, FeatureParameters

pytestmark = pytest.mark.slow

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


@pytest.fixture
def store(bus: Bus, endpoint: str, route: Route, tmp_path: Path) -> Iterator[SqliteStore]:
    """A cloud whose map holds lanes, and no lights."""
    path, stop = tmp_path / "store.sqlite", threading.Event()
    with SqliteStore(path) as opened:
        opened.put_tiles(lane_tiles(route), layer="lanes")
        shard = ShardConfig(store_path=path, connect=(endpoint,), store=StoreConfig(merge_delay_s=0.2))
        thread = threading.Thread(target=run_shard, args=(shard, stop))
        thread.start()
        with TileServer(opened, bus):
            yield opened
        stop.set()
        thread.join()


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


def published(store: SqliteStore, route: Route) -> np.ndarray:
    """(N, 2) where the layer has lights, in the route's frame."""
    places = [np.zeros((0, 3))]
    for entry in store.heads("streetlights"):
        tile = store.get("streetlights", entry.tile)
        assert tile is not None
        points = np.array([one.position_m for one in tile.decode_features().features]).reshape(-1, 3)
        places.append(
            route.frame.enu_from_geodetic(*geodetic_in_tile(entry.tile, points)) if len(points) else places[0]
        )
    return np.concatenate(places)[:, :2]


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
