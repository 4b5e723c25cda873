"""A store moves (`gnd store copy`) while a shard, a tile server and a vehicle work: who follows goes on there."""

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from merger_processes import TAKEN, Cloud, wait_for
from merger_world import GROUND, POLE, TILE, change_of, gaussians_of, report_of, tile_of_states

from gnd.gnd_map.codec import CODEC_FLOAT32
from gnd.schemas.keys import tile_key
from gnd.schemas.tiles import TileReply, TileRequest
from gnd.tile_store.copying.sqlite_end import SqliteEnd
from gnd.tile_store.errors import StoreError
from gnd.tile_store.location import open_store
from gnd.tile_store.moving import moved_to, run_following
from gnd.tile_store.sqlite_store import SqliteStore

pytestmark = pytest.mark.slow
STATES = {0: GROUND}
BASE = gaussians_of(STATES)


class Fleet(Cloud):
    """A cloud whose parts follow moves."""

    def start_parts(self) -> None:
        log = (self._log / "parts.log").open("ab")
        at = ["--connect", self.endpoint, "--follow"]
        merger = ["merger", "--id", "one", "--store", str(self.path), "--config", str(self.config_path), *at]
        for name, command in (("one", merger), ("tiles", ["store", "--path", str(self.path), *at])):
            program = [sys.executable, "-m", "gnd.deploy.cli", *command]
            self.shards[name] = subprocess.Popen(program, stdout=log, stderr=log)
        log.close()
        wait_for("the shard lives", lambda: "one" in self.living)

    def version(self) -> int:
        """The newest version that the tile server gives."""
        wanted = TileRequest(codecs=(CODEC_FLOAT32,), deltas=False).encode()
        blob = TileReply.decode(self.bus.request(tile_key("ndt", TILE), wanted, kind="tile", timeout_s=60)).blob
        assert blob is not None
        return blob.version


@pytest.fixture
def fleet(tmp_path: Path, free_port: int) -> Iterator[Fleet]:
    fleet = Fleet(tmp_path, free_port)
    fleet.open()
    fleet.store.put_tiles([tile_of_states(STATES)])
    yield fleet
    fleet.close()


class Sending:
    """A vehicle that sends reports, one after the other, until it is stopped."""

    def __init__(self, fleet: Fleet) -> None:
        self.acknowledged: list[str] = []
        self.longest_s = 0.0
        self._fleet, self._stop = fleet, threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        for n in range(100_000):
            if self._stop.is_set():
                return
            began_s = time.monotonic()
            report = report_of(n, change_of(BASE, [0, 2], {2: POLE}), vehicle="car")
            assert self._fleet.send(report).status in TAKEN
            self.acknowledged.append(report.report_id)
            self.longest_s = max(self.longest_s, time.monotonic() - began_s)
            time.sleep(0.05)

    def __enter__(self) -> "Sending":
        return self

    def __exit__(self, *_exception: object) -> None:
        self._stop.set()
        self._thread.join()


def copy(source: Path, target: str) -> None:
    command = [sys.executable, "-m", "gnd.deploy.cli", "store", "copy", str(source), target]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("kind", ["file", "postgres"])
def test_nothing_acknowledged_is_lost_when_parts_follow_a_move(kind, fleet, tmp_path, request):
    target = str(tmp_path / "moved.sqlite") if kind == "file" else request.getfixturevalue("new_database")()
    fleet.start_parts()
    with Sending(fleet) as sending:
        wait_for("reports are acknowledged", lambda: len(sending.acknowledged) > 5)
        assert fleet.version() >= 1
        copy(fleet.path, target)
        before = len(sending.acknowledged)
        wait_for("reports are acknowledged by the new store's shard", lambda: len(sending.acknowledged) > before + 10)
    print(f"longest time to an ack: {sending.longest_s:.2f} s")
    assert moved_to(fleet.store) == target
    with open_store(target, create=False) as moved:
        wait_for("all are expanded", lambda: "waiting" not in moved.upload_counts().by_state)
        wait_for("all is merged", lambda: moved.dirty_count() == 0)
        stored = [row.report_id for row in moved.reports(vehicle="car")]
        assert sorted(stored) == sorted(sending.acknowledged)
        newest = moved.history("ndt", TILE)[-1].version
        wait_for("the tile server answers from the new store", lambda: fleet.version() == newest)


def test_who_starts_with_a_store_that_has_moved_goes_to_the_new_one(tmp_path):
    old, new = tmp_path / "old.sqlite", tmp_path / "new.sqlite"
    with SqliteStore(old) as store:
        store.put_tiles([tile_of_states(STATES)])
        assert moved_to(store) is None
    copy(old, str(new))
    worked_on, stop = [], threading.Event()

    def run(location, _ended):
        worked_on.append(str(location))
        stop.set()

    run_following(old, run, stop)
    assert worked_on == [str(new)]


def test_who_waits_for_a_move_that_is_abandoned_goes_on_with_the_old_store(tmp_path):
    """The fence of a copy whose process was killed before the new store was whole."""
    old, new = tmp_path / "old.sqlite", tmp_path / "new.sqlite"
    SqliteStore(old).close()
    end = SqliteEnd(old, is_target=False)
    with end.transaction(alone=True):
        end.refuse(str(new))
    worked_on, stop = [], threading.Event()

    def run(location, _ended):
        worked_on.append(location)
        stop.set()

    following = threading.Thread(target=run_following, args=(old, run, stop))
    following.start()
    time.sleep(1.0)
    assert worked_on == []
    with end.transaction(alone=True):
        end.allow()
    following.join(30)
    end.close()
    assert worked_on == [old]


def test_without_a_store_there_is_nothing_to_follow(tmp_path):
    with pytest.raises(StoreError, match=r"nothing\.sqlite"):
        run_following(tmp_path / "nothing.sqlite", lambda _at, _ended: None, threading.Event())
