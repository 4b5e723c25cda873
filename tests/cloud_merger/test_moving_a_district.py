"""Two stores with a shard and a tile server each; a district moves between them while vehicles report."""

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner
from merger_processes import DEADLINE_S, TAKEN, Cloud, wait_for
from merger_world import GROUND, POLE, TILE, change_of, gaussians_of, report_of, seen_by, tile_of_states

from gnd.deploy.map_cli import map_group
from gnd.fleet_bus.requesting import RetryPolicy
from gnd.gnd_map.codec import CODEC_FLOAT32
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import catalog_key, tile_key, tiles_key
from gnd.schemas.tiles import Catalog, TileReply, TileRequest
from gnd.tile_store.location import open_store
from gnd.tile_store.regions_cli import regions
from gnd.tile_store.sqlite_store import SqlStore

pytestmark = pytest.mark.slow
FAR = TileId.from_path("03000/00000/00000/00000")
HOME, AWAY = TILE.district, FAR.district
VOXELS = range(200)
STATES = dict.fromkeys(VOXELS, GROUND)
BASE = gaussians_of(STATES)
CARS = 3
WANTED = TileRequest(codecs=(CODEC_FLOAT32,), deltas=False).encode()


class Regions(Cloud):
    """A cloud of two stores: this one's parts are called west, those of `other` east."""

    other = ""

    def start_parts(self) -> None:
        done = CliRunner().invoke(regions, ["create", self.other, "east"])
        assert done.exit_code == 0, done.output
        for name, store in (("west", str(self.path)), ("east", self.other)):
            at = ["--connect", self.endpoint]
            merger = ["merger", "--id", name, "--store", store, "--config", str(self.config_path), *at]
            for part, command in ((name, merger), (f"tiles-{name}", ["store", "--path", store, *at])):
                with (self._log / f"{part}.log").open("ab") as log:
                    program = [sys.executable, "-m", "gnd.deploy.cli", *command]
                    self.shards[part] = subprocess.Popen(program, stdout=log, stderr=log)
        wait_for("both shards live", lambda: {"west", "east"} <= self.living)
        self.version(FAR)  # the tile server of the west answers

    def version(self, tile: TileId = TILE) -> int:
        """The newest version that a tile server gives."""
        retry = RetryPolicy(longest_wait_s=0.2, attempt_timeout_s=5.0)
        answer = self.bus.request(tile_key("ndt", tile), WANTED, kind="tile", retry=retry, timeout_s=DEADLINE_S)
        blob = TileReply.decode(answer).blob
        assert blob is not None, "there is such a tile"
        return blob.version

    def move(self, *options: str) -> list[str]:
        command = ["regions", "move", HOME.path, "--from", str(self.path), "--to", self.other, "--json", *options]
        return [sys.executable, "-m", "gnd.deploy.cli", *command]


@pytest.fixture(params=["file", "postgresql"])
def cloud(request: pytest.FixtureRequest, tmp_path: Path, free_port: int) -> Iterator[Regions]:
    cloud = Regions(tmp_path, free_port)
    is_file = request.param == "file"
    cloud.other = str(tmp_path / "east.sqlite") if is_file else request.getfixturevalue("new_database")()
    cloud.open()
    cloud.store.put_tiles([tile_of_states(STATES), tile_of_states(STATES, FAR)])
    cloud.start_parts()
    yield cloud
    cloud.close()


class Driving:
    """Vehicles that report about a tile, and read it, one after the other, until they are stopped."""

    def __init__(self, cloud: Regions, tile: TileId) -> None:
        self.acknowledged: list[str] = []
        self.longest_s = self.longest_read_s = 0.0
        self.versions: list[int] = []
        self.failed: list[BaseException] = []
        self._cloud, self._tile, self._stop = cloud, tile, threading.Event()
        self._threads = [threading.Thread(target=self._guarded, args=(run,)) for run in (self._send, self._read)]
        for thread in self._threads:
            thread.start()

    def _guarded(self, run) -> None:
        try:
            while not self._stop.is_set():
                run()
                time.sleep(0.03)
        except BaseException as error:
            self.failed.append(error)

    def _send(self) -> None:
        n, began_s = len(self.acknowledged), time.monotonic()
        # nobody is in both places
        car, voxel = f"{'far' if self._tile == FAR else 'car'}{n % CARS}", 1 + n // CARS % (len(VOXELS) - 1)
        change = change_of(BASE, [0, voxel], seen_by(car, {voxel: POLE}), tile=self._tile)
        number = n + 1_000_000 * (self._tile == FAR)
        report = report_of(number, change, vehicle=car)
        assert self._cloud.send(report).status in TAKEN, "not refused"
        self.acknowledged.append(report.report_id)
        self.longest_s = max(self.longest_s, time.monotonic() - began_s)

    def _read(self) -> None:
        began_s = time.monotonic()
        self.versions.append(self._cloud.version(self._tile))
        self.longest_read_s = max(self.longest_read_s, time.monotonic() - began_s)

    def goes_on(self) -> None:
        before, read = len(self.acknowledged), len(self.versions)
        wait_for(
            "reports are acknowledged and tiles are read",
            lambda: self.failed or (len(self.acknowledged) > before + 20 and len(self.versions) > read + 5),
        )
        assert not self.failed, self.failed

    def __enter__(self) -> "Driving":
        return self

    def __exit__(self, *_exception: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join()


def settled(store: SqlStore) -> bool:
    return "waiting" not in store.upload_counts().by_state and store.dirty_count() == 0 and not store.notices()


def check(cloud: Regions, driving: Driving, elsewhere: Driving) -> None:
    """Nothing lost, nothing twice; versions go on; both stores can be verified."""
    with open_store(cloud.other, create=False) as east:
        wait_for("all is merged and announced in the east", lambda: settled(east))
        wait_for("all is merged and announced in the west", lambda: settled(cloud.store))
        stored = [row.report_id for row in east.reports()]
        assert sorted(stored) == sorted(driving.acknowledged), "in the new store, each once"
        assert sorted(row.report_id for row in cloud.store.reports()) == sorted(elsewhere.acknowledged)
        history = [one.version for one in east.history("ndt", TILE)]
        assert history == list(range(1, len(history) + 1)), "one chain"
        assert len(history) > 2, "versions were made"
        wait_for("the tile server has the newest", lambda: cloud.version() == history[-1])
        wait_for("all versions were announced", lambda: {(TILE, n) for n in history[1:]} <= cloud.announced())
    heard = [one.version for one in cloud.updates if one.tile == TILE]
    assert sorted(set(heard)) == list(range(min(heard), history[-1] + 1)), "updates in sequence"
    assert driving.versions == sorted(driving.versions), "no reader sees a version go back"
    for place in (str(cloud.path), cloud.other):
        done = CliRunner().invoke(map_group, ["verify", place, "--all-versions"])
        assert done.exit_code == 0, done.output


def test_a_district_moves_while_vehicles_drive(cloud: Regions) -> None:
    with Driving(cloud, TILE) as driving, Driving(cloud, FAR) as elsewhere:
        driving.goes_on()
        driving.longest_s = driving.longest_read_s = elsewhere.longest_s = elsewhere.longest_read_s = 0.0
        done = subprocess.run(cloud.move(), capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        driving.goes_on()
        elsewhere.goes_on()
    (row,) = json.loads(done.stdout)["districts"]
    print(
        f"writes were refused for {row['gap_s']:.3f} s; longest time to an ack {driving.longest_s:.2f} s,"
        f" to a tile {driving.longest_read_s:.2f} s; in the other district {elsewhere.longest_s:.2f} s and"
        f" {elsewhere.longest_read_s:.2f} s; {len(driving.acknowledged)} reports"
    )
    check(cloud, driving, elsewhere)
    catalog = cloud.bus.request(catalog_key("ndt", HOME), b"", kind="catalog", timeout_s=60)
    assert [entry.tile for entry in Catalog.decode(catalog).entries] == [TILE]
    found = dict(cloud.bus.request_many(tiles_key("ndt"), WANTED, kind="tile", timeout_s=60))
    assert set(found) == {tile_key("ndt", TILE), tile_key("ndt", FAR)}, "of a region each store gives its part"


def test_a_mover_that_is_killed_goes_on(cloud: Regions) -> None:
    """kill -9 at several instants, also behind the fence: vehicles wait until it goes on, and lose nothing."""
    killed = 0
    with Driving(cloud, TILE) as driving, Driving(cloud, FAR) as elsewhere:
        driving.goes_on()
        for pause_s in (0.3, 1.1, 1.25, 1.4, 1.6, 2.2):
            with subprocess.Popen(cloud.move(), stdout=subprocess.PIPE, stderr=subprocess.PIPE) as mover:
                wait_for("it has begun", lambda: HOME.path in cloud.store.district_owners().by_path)
                time.sleep(pause_s)
                mover.send_signal(signal.SIGKILL)
            killed += mover.returncode != 0
            elsewhere.goes_on()
        done = subprocess.run(cloud.move(), capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        driving.goes_on()
    assert killed
    check(cloud, driving, elsewhere)


def test_shards_that_are_killed_while_it_moves(cloud: Regions) -> None:
    """Both shards start anew in the middle of it: each finds in its store what is its own."""
    with Driving(cloud, TILE) as driving, Driving(cloud, FAR) as elsewhere:
        driving.goes_on()
        with subprocess.Popen(cloud.move(), stdout=subprocess.PIPE, stderr=subprocess.PIPE) as mover:
            wait_for("it has begun", lambda: HOME.path in cloud.store.district_owners().by_path)
            for name, store in (("west", str(cloud.path)), ("east", cloud.other)):
                cloud.kill(name)
                command = ["merger", "--id", name, "--store", store, "--connect", cloud.endpoint]
                program = [sys.executable, "-m", "gnd.deploy.cli", *command, "--config", str(cloud.config_path)]
                cloud.shards[name] = subprocess.Popen(program, stderr=subprocess.DEVNULL)
            assert mover.wait(120) == 0
        driving.goes_on()
        elsewhere.goes_on()
    check(cloud, driving, elsewhere)
