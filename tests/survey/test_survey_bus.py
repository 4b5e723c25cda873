"""The whole way: agents on a real router, a merger shard with its worker, a subscriber; and `gnd map survey`."""

import json
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.merger import run_shard
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.router import open_router
from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.street import street
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.se3 import transform
from gnd.gnd_map.tile import Tile
from gnd.schemas.keys import update_keys
from gnd.tile_store import sql_roads
from gnd.tile_store.build import build_map
from gnd.tile_store.cli import map_group
from gnd.tile_store.roads import RoadTile
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.agent import AgentConfig, run_agent

WORLD = street(101)
SCANS, MAPPED_M = 75, 28.0


def wait_for(condition: Callable[[], object], timeout_s: float = 90.0) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s, f"not within {timeout_s} s"
        time.sleep(0.05)


def cut_map(folder: Path) -> list[Tile]:
    """The map of the first metres of the street."""
    mapper = DriveConfig("mapper", "HDL-32E", state="after", errors=PERFECT, car_share=0.0, scans=40)
    simulate_drive(WORLD, mapper, folder / "mapper.mcap")
    tiles = []
    with SqliteStore(folder / "whole.sqlite") as store:
        build_map([folder / "mapper.mcap"], store)
        for head in store.heads():
            stored = store.get("ndt", head.tile)
            assert stored is not None
            tile = stored.decode_gaussians()
            T = WORLD.frame.T_self_other(LocalFrame.of_tile(tile.tile_id))
            p = transform(T, VoxelGrid.of(tile.tile_id).centre_m(tile.gaussians.voxel_id) + tile.gaussians.mean_m)
            kept = WORLD.street_of_map(p)[:, 0] < -WORLD.half_length_m + MAPPED_M
            if kept.any():
                tiles.append(replace(tile, gaussians=tile.gaussians.take(kept)))
    return tiles


@pytest.mark.slow
def test_two_agents_survey_beyond_the_edge_and_the_map_grows(free_port: int, tmp_path: Path) -> None:
    endpoint, stop, heard = f"tcp/127.0.0.1:{free_port}", threading.Event(), set[str]()
    tiles = cut_map(tmp_path)
    with (
        open_router((endpoint,)),
        SqliteStore(tmp_path / "store.sqlite") as store,
        open_bus(BusConfig(connect=(endpoint,)), name="cloud") as bus,
        TileServer(store, bus),
    ):
        store.put_tiles(tiles)
        bus.subscribe(update_keys("ndt"), lambda key, _body: heard.add(key), kind="tile")
        shard = threading.Thread(target=run_shard, args=(ShardConfig(store_path=store.path, connect=(endpoint,)), stop))
        shard.start()
        try:
            for number, sensor in enumerate(("HDL-32E", "VLP-16")):
                name = f"probe-{number}"
                simulate_drive(
                    WORLD, DriveConfig(name, sensor, seed=40 + number, scans=SCANS), tmp_path / f"{name}.mcap"
                )
                drive = AgentConfig(
                    vehicle=name, drive=tmp_path / f"{name}.mcap", work_dir=tmp_path / name, connect=(endpoint,)
                )
                result = run_agent(drive, threading.Event())
                assert result["surveys"]["parts"] >= 1
                assert result["surveys"]["bare_m"] >= 10
                assert result["reports_acknowledged"] == result["reports_sent"]
                assert (result["reports_pending"], result["reports_quarantined"]) == (0, 0)
                states = ("draft",) if number == 0 else ("published",)
                wait_for(lambda states=states: states_of(store).issuperset(states))  # type: ignore[misc]
        finally:
            stop.set()
            shard.join()
        new = {one.tile for one in roads_of(store) if one.state == "published"}
        assert new
        assert {key.split("/update/ndt/")[1] for key in heard} & {tile.path for tile in new}
        assert len({head.tile for head in store.heads()} - {tile.tile_id for tile in tiles}) >= 1
        assert store.quarantined() == []
    shown = CliRunner().invoke(map_group, ["survey", str(tmp_path / "store.sqlite"), "--json"])
    assert shown.exit_code == 0, shown.output
    told = json.loads(shown.output)
    assert {one["tile"] for one in told["tiles"] if one["state"] == "published"} == {tile.path for tile in new}
    assert told["published"] == len(new)
    assert np.isfinite([one["sigma_m"] for one in told["tiles"]]).all()


def roads_of(store: SqliteStore) -> list[RoadTile]:
    return store.look(lambda c: sql_roads.tiles(c, "ndt"))


def states_of(store: SqliteStore) -> set[str]:
    return {one.state for one in roads_of(store)}
