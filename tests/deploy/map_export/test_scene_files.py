"""MCAP and Rerun: what was put in is in the files, read with their own libraries."""

import json
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from map_export_maps import TILE, some_tile
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from gnd.deploy.cli import gnd
from gnd.deploy.map_export.scene import read_scene
from gnd.extras import MissingExtra
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.tile import Tile
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.way import Milestone

WALL_NS = 1_763_000_000_000_000_000


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """A run's folder: a map that lost three voxels and was put back, and the way of a vehicle."""
    gaussians = some_tile(1).gaussians
    with SqliteStore(tmp_path / "store.sqlite") as store:
        store.put_tiles([Tile(TILE, 1, gaussians)])
        store.put_tiles([Tile(TILE, 2, gaussians.take(np.arange(3, len(gaussians))))])
        store.rollback("ndt", TILE, 1)
    (tmp_path / "agents" / "car-1").mkdir(parents=True)
    way = [Milestone(5 + n, WALL_NS + n, 5.0 * n, 0.855, 0.147 + 1e-6 * n, TILE.morton, 1) for n in range(3)]
    text = "".join(json.dumps(asdict(one)) + "\n" for one in way)
    (tmp_path / "agents" / "car-1" / "way.jsonl").write_text(text)
    return tmp_path


def gnd_command(*words: object) -> Result:
    return CliRunner().invoke(gnd, list(map(str, words)))


def test_foxglove_gets_the_map_its_changes_and_the_fleet(run_folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "map.mcap"
    ran = gnd_command("map", "export", run_folder, out, "--json")
    assert ran.exit_code == 0, ran.output
    told = json.loads(ran.stdout)
    tile = some_tile(1)
    assert (told["gaussians"], told["updates"], told["vehicles"]) == (len(tile.gaussians), 1, ["car-1"])
    with out.open("rb") as stream:
        found = [
            (channel.topic, message.log_time, decoded)
            for _, channel, message, decoded in make_reader(
                stream, decoder_factories=[DecoderFactory()]
            ).iter_decoded_messages()
        ]
    topics = [topic for topic, _, _ in found]
    assert (topics.count("/map"), topics.count("/map/updates"), topics.count("/vehicles/car-1")) == (1, 1, 3)
    cloud = next(message for topic, _, message in found if topic == "/map")
    rows = np.frombuffer(cloud.data, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("count", "<u4")])
    assert np.array_equal(rows["count"], tile.gaussians.count)
    with SqliteStore(run_folder / "store.sqlite") as store:
        scene = read_scene(store, "ndt", "")
    assert np.array_equal(np.stack([rows[axis] for axis in "xyz"], axis=1), scene.points_m)
    update = next(message for topic, _, message in found if topic == "/map/updates")
    changed = np.frombuffer(update.data, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("change", "u1")])
    assert changed["change"].tolist() == [ChangeClass.NEW] * 3
    fixes = [(t, message.latitude) for topic, t, message in found if topic == "/vehicles/car-1"]
    assert [t for t, _ in fixes] == [WALL_NS + n for n in range(3)]
    assert fixes[0][1] == pytest.approx(np.degrees(0.855))


def test_rerun_gets_the_same(run_folder: Path, tmp_path: Path) -> None:
    rerun = pytest.importorskip("rerun")
    out = tmp_path / "map.rrd"
    ran = gnd_command("view", run_folder, "--save", out)
    assert ran.exit_code == 0, ran.output + repr(ran.exception)
    assert "3 changes in 1 versions, 1 vehicles" in ran.stdout
    assert out.read_bytes()[:3] == b"RRF"
    assert rerun.__version__


def test_without_rerun_it_says_what_to_install(run_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    ran = gnd_command("view", run_folder)
    assert isinstance(ran.exception, MissingExtra)
    assert str(ran.exception) == "rerun is not installed; it comes with: pip install 'gnd-fleet[export]'"
