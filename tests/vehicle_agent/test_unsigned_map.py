"""A vehicle of a fleet with identities on a map that nobody has signed: it says so once a minute, and what to do."""

import logging
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from suite_ports import new_port

from gnd.deploy.cli import gnd
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.refusals import refusals
from gnd.fleet_bus.router import open_router
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId
from gnd.tile_client.unsigned import UNSIGNED_TOLD_EVERY_S, UnsignedTold
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.config import DownloadParameters
from gnd.vehicle_agent.link.cache import TileCache
from gnd.vehicle_agent.link.download import TileFetcher

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "attacks"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "cloud_merger"))
from merger_processes import wait_for
from signing_scene import Authority
from versions_scene import content

TILES = [TileId((497353963154 & ~1023) + number) for number in range(3)]


def test_a_vehicle_on_an_unsigned_map_says_what_to_do_and_goes_on_once_it_is_done(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    authority = Authority(tmp_path / "parts")
    parts = {role: authority.part(role, role[0]) for role in ("tiles", "vehicle", "operator")}
    path, endpoint = tmp_path / "map.sqlite", f"tcp/127.0.0.1:{new_port()}"
    with SqliteStore(path) as store:
        store.put_tiles([content(tile, number) for number, tile in enumerate(TILES)])
    before = refusals().get(("version", "unsigned"), 0)
    with (
        SqliteStore(path) as store,
        open_router([endpoint]),
        open_bus(BusConfig(connect=(endpoint,), identity=parts["tiles"]), name="tiles") as server,
        open_bus(BusConfig(connect=(endpoint,), identity=parts["vehicle"]), name="v") as vehicle,
        TileServer(store, server),
    ):
        fetcher: TileFetcher = TileFetcher(vehicle, TileCache(tmp_path / "cache.sqlite", "ndt"), DownloadParameters())
        fetcher.want(TILES)
        wait_for("each tile was refused twice", lambda: fetcher.counts["refused"] >= 2 * len(TILES))
        assert fetcher.take() == []
        (told,) = [one.getMessage() for one in caplog.records if "still without a map" in one.getMessage()]
        assert "layer ndt" in told
        assert "gnd map sign STORE --identity" in told
        check = fetcher.check
        assert check is not None
        assert check.unsigned.times == 1
        assert check.counts["unsigned"] >= 2 * len(TILES)
        assert refusals()["version", "unsigned"] - before == check.counts["unsigned"]
        signed = CliRunner().invoke(gnd, ["map", "sign", str(path), "--identity", str(parts["operator"])])
        assert signed.exit_code == 0, signed.output
        arrived: dict[TileId, Gaussians] = {}

        def all_came() -> bool:
            for one in fetcher.take():
                assert one.tile is not None
                arrived[one.tile_id] = one.tile.gaussians
            return arrived.keys() == set(TILES)

        wait_for("the tiles come", all_came)
        fetcher.close()
    assert all(arrived[tile] == content(tile, number).gaussians for number, tile in enumerate(TILES))


def test_it_is_said_once_a_minute_until_a_signed_version_comes(caplog: pytest.LogCaptureFixture) -> None:
    now = [100.0]
    told = UnsignedTold("ndt", lambda: now[0])
    for seconds in (0.0, 1.0, UNSIGNED_TOLD_EVERY_S - 2.0, 1.0, 5.0):
        now[0] += seconds
        told.refused(f"tile at {now[0]:.0f}")
    lines = [one.getMessage() for one in caplog.records]
    assert told.times == len(lines) == 2
    assert "1 answers refused so far, the last tile at 100" in lines[0]
    assert "4 answers refused so far, the last tile at 160" in lines[1]
    told.signed()
    now[0] += 1000.0
    told.refused("one tile")
    assert told.times == 2
