"""Where bodies of versions lie among objects and those cannot be reached: nothing acknowledged is given up for it."""

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from merger_world import NEIGHBOUR, POLE, TILE, VOXEL_BY_VOXEL
from s3_server import S3Server
from short_world import KEY, drive_number, packed_of, tile_at
from suite_ports import new_port
from upload_desk import Desk

from gnd.cloud_merger import expander, work
from gnd.cloud_merger.config import MAX_ATTEMPTS, ShardConfig
from gnd.cloud_merger.work import Worker
from gnd.tile_store.bodies import move_out
from gnd.tile_store.errors import ObjectsAway, StoreUnavailable
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig

REPORT = drive_number(1, new={3: POLE})
PACKED = packed_of(REPORT)


class Place:
    """The folder of the bodies; while it is away no body can be read."""

    def __init__(self, folder: Path) -> None:
        self.folder, self._aside = folder, folder.with_name("aside")

    def go(self) -> None:
        self.folder.rename(self._aside)
        for path in self._aside.rglob("*"):
            if path.is_file():  # a file cannot be read where there is a folder
                (self.folder / path.relative_to(self._aside)).mkdir(parents=True)

    def come(self) -> None:
        shutil.rmtree(self.folder)
        self._aside.rename(self.folder)


@pytest.fixture
def place(tmp_path: Path) -> Place:
    return Place(tmp_path / "bodies")


@pytest.fixture
def path(tmp_path: Path, place: Place) -> Path:
    with SqliteStore(tmp_path / "map.sqlite") as store:
        store.put_tiles([tile_at(TILE), tile_at(NEIGHBOUR)])
        move_out(store, str(place.folder))
    return tmp_path / "map.sqlite"


@pytest.fixture
def store(path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SqliteStore]:
    """Opened anew: it remembers no body."""
    monkeypatch.setattr(expander, "DAMAGED_RETRY_S", 0.0)
    monkeypatch.setattr(work, "RETRY_S", 0.0)
    with SqliteStore(path, StoreConfig(merge_delay_s=0.0)) as opened:
        yield opened


def test_an_acknowledged_upload_waits_for_as_long_as_bodies_are_away(store: SqliteStore, place: Place) -> None:
    place.go()
    with pytest.raises(ObjectsAway):
        store.get("ndt", TILE)
    desk = Desk(store)
    assert desk.ack(KEY, PACKED).status == "stored"
    for _ in range(2 * MAX_ATTEMPTS):
        assert desk.expander.work() == 1
    assert store.upload_counts().by_state == {"waiting": 1}
    assert store.counts().quarantined == 0
    place.come()
    desk.work()
    ((vehicle, told),) = desk.told
    assert (vehicle, told.status) == (REPORT.vehicle, "wanted")
    assert {row.report_id for row in store.reports()} == {REPORT.report_id}


def test_a_tile_waits_for_as_long_as_bodies_are_away_and_is_not_set_aside(
    store: SqliteStore, place: Place, path: Path
) -> None:
    desk = Desk(store)
    assert desk.send(KEY, REPORT.encode()).status == "released"
    place.go()
    shutil.rmtree(place.folder)
    place.folder.touch()  # bodies are remembered, and new ones cannot be written
    worker = Worker(store, ShardConfig(store_path=path, confirmation=VOXEL_BY_VOXEL))
    for _ in range(2 * MAX_ATTEMPTS):
        (claim,) = store.claim("one", 1, 30.0)
        assert claim.attempts == 1
        worker.begin([claim])
        assert worker.settle_some([claim]) == [None]
    assert store.tiles_set_aside() == []
    place.folder.unlink()
    place.folder.mkdir()
    place.come()
    (claim,) = store.claim("one", 1, 30.0)
    worker.begin([claim])
    (result,) = worker.settle_some([claim])
    assert result is not None
    assert result.status == "published"


@pytest.mark.slow
def test_a_store_is_opened_while_its_bucket_does_not_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, s3_server: S3Server, new_bucket: Callable[[], str]
) -> None:
    """Who takes reports needs no bodies; what is published waits for them, and is looked at first as at any start."""
    path = tmp_path / "map.sqlite"
    with SqliteStore(path) as store:
        store.put_tiles([tile_at(TILE)])
        move_out(store, new_bucket())
    monkeypatch.setenv("AWS_ENDPOINT", f"http://127.0.0.1:{new_port()}")  # nobody listens there
    with SqliteStore(path) as store:
        assert Desk(store).ack(KEY, PACKED).status == "stored"
        with pytest.raises(ObjectsAway, match="cannot read"):
            store.get("ndt", TILE)
        with pytest.raises(ObjectsAway, match="cannot write probe/"):
            store.put_tiles([tile_at(NEIGHBOUR)])
    monkeypatch.setenv("AWS_ENDPOINT", s3_server.environment["AWS_ENDPOINT"])
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong")
    with pytest.raises(StoreUnavailable) as refused:  # an answer, not silence: told at once
        SqliteStore(path)
    assert not isinstance(refused.value, ObjectsAway)
