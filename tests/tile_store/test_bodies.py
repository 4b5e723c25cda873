"""Bodies among objects: a folder, and a bucket of a real S3 server; who publishes beside who collects."""

import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner
from s3_server import NoS3ServerError, S3Server
from store_helpers import EAST, TILE, SqliteMaker, merge_once, report, tile_of_voxels

from gnd.deploy.map_cli import map_group
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store import bodies as bodies_module
from gnd.tile_store.bodies import (
    FOLDER,
    Bodies,
    body_name,
    collect,
    lies_elsewhere,
    move_back,
    move_out,
    place_of_bodies,
)
from gnd.tile_store.check import check_store
from gnd.tile_store.errors import StoreDamaged, StoreUnavailable
from gnd.tile_store.objects import NamedObjects, check_creates, open_objects
from gnd.tile_store.publishing import prune, publish
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import Content

PLACES = ["folder", pytest.param("s3", marks=pytest.mark.slow)]


@pytest.fixture(params=PLACES)
def place(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "s3":
        return str(request.getfixturevalue("new_bucket")())
    return str(tmp_path / "bodies")


@pytest.fixture
def store(tmp_path: Path, place: str) -> Iterator[SqliteStore]:
    with SqliteMaker(tmp_path / "store.db", place).open() as opened:
        assert isinstance(opened, SqliteStore)
        yield opened


def names(objects: NamedObjects) -> set[str]:
    return {one.name for one in objects.each(FOLDER)}


def name_of(*voxels: int, tile: TileId = TILE) -> str:
    content = Content.of(tile_of_voxels(tile, *voxels))
    return body_name(content.sha, content.codec_id)


def collected(store: SqliteStore, objects: NamedObjects) -> int:
    """All that is unnamed, however young."""
    return collect(store, Bodies(objects), grace_s=-3600.0).objects


def test_objects_are_created_once_replaced_whole_and_read_in_parts(place: str) -> None:
    objects = open_objects(place)
    check_creates(objects)
    assert objects.put_new("a/b", b"first")
    assert not objects.put_new("a/b", b"second")
    assert objects.get("a/b") == b"first"
    assert objects.get("a/b", 1, 3) == b"irs"
    objects.put("a/b", b"third")
    assert objects.get("a/b") == b"third"
    assert [(one.name, one.size_bytes) for one in objects.each("a/")] == [("a/b", 5)]
    objects.remove(["a/b", "a/none"])
    assert objects.get("a/b") is None
    assert list(objects.each("")) == []


def test_of_many_who_create_one_object_one_does(place: str) -> None:
    objects, made = open_objects(place), list[str]()

    def create(who: int) -> None:
        made.extend(f"{n}" for n in range(10) if objects.put_new(f"race/{n}", b"%d" % who))

    threads = [threading.Thread(target=create, args=(who,)) for who in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(made) == sorted(f"{n}" for n in range(10))


def test_the_database_holds_no_bodies_and_every_reader_gets_them(store: SqliteStore, place: str) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1), tile_of_voxels(EAST, 1)])
    store.put_reports([report(1)])
    assert merge_once(store, 1, 2) == 2
    store.rollback("ndt", TILE, 1)
    maker = SqliteMaker(store.path)
    assert maker.sql("SELECT sum(length(body)) FROM tile_version") == [(0,)]
    assert maker.sql("SELECT count(*) FROM tile_version WHERE size_bytes = 0") == [(0,)]
    for version in (1, 2, 3):
        stored = store.get("ndt", TILE, version)
        assert stored is not None
        stored.decode()
        assert store.by_sha("ndt", TILE, stored.sha) is not None
    assert names(open_objects(place)) == {name_of(1), name_of(1, 2), name_of(1, tile=EAST)}
    assert check_store(store.path, all_versions=True).damages == ()


def test_bodies_move_out_and_back(tmp_path: Path, place: str) -> None:
    with SqliteStore(tmp_path / "store.db") as store:
        store.put_tiles([tile_of_voxels(TILE, 1), tile_of_voxels(EAST, 1)])
        store.put_tiles([tile_of_voxels(TILE, 1, 2)])
        before = [store.get("ndt", TILE, version) for version in (1, 2)]
    run = CliRunner().invoke
    told = run(map_group, ["bodies", str(tmp_path / "store.db"), "--to", place, "--json"])
    assert told.exit_code == 0, told.output
    assert json.loads(told.stdout) | {"moved_bytes": 0} == {"bodies": place, "moved_versions": 3, "moved_bytes": 0}
    with SqliteStore(tmp_path / "store.db") as store:
        assert [store.get("ndt", TILE, version) for version in (1, 2)] == before
        assert move_out(store, place).versions == 0
        with pytest.raises(Exception, match="move them back first"):
            move_out(store, str(tmp_path / "elsewhere"))
        assert move_back(store).versions == 3
        assert store.look(place_of_bodies) is None
        store.put_tiles([tile_of_voxels(EAST, 1, 2)])  # its place was told to take no more
        assert SqliteMaker(store.path).sql("SELECT count(*) FROM tile_version WHERE length(body) = 0") == [(0,)]
        assert [store.get("ndt", TILE, version) for version in (1, 2)] == before


def test_collecting_leaves_what_a_head_or_a_window_names(store: SqliteStore, place: str) -> None:
    objects = open_objects(place)
    store.put_tiles([tile_of_voxels(TILE, 1)])
    base = store.get("ndt", TILE)
    assert base is not None
    store.put_reports([replace(report(1), base_sha=base.sha)])
    for n in range(3):
        store.put_tiles([tile_of_voxels(EAST, 1, n + 2)])
    assert store.gc(1).versions == 2
    assert collected(store, objects) == 2
    assert names(objects) == {name_of(1), name_of(1, 4, tile=EAST)}
    stored = store.get("ndt", TILE, 1)
    assert stored is not None
    stored.decode()


def test_young_bodies_stay(store: SqliteStore, place: str) -> None:
    objects = open_objects(place)
    objects.put(body_name(bytes(32), 1), b"of a publisher that is about to name it")
    assert collect(store, Bodies(objects)).objects == 0


def test_whoever_publishes_what_is_just_removed_keeps_it_in_the_database(store: SqliteStore, place: str) -> None:
    """The body is among the objects already, unnamed; it goes after the publisher looked and before he commits."""
    objects = open_objects(place)
    content = Content.of(tile_of_voxels(TILE, 1))
    (kept,) = Bodies(objects).keep([content])
    assert store.look(lambda c: lies_elsewhere(c, kept))
    assert collected(store, objects) == 1
    assert not store.look(lambda c: lies_elsewhere(c, kept))
    store.put_tiles([tile_of_voxels(TILE, 1)])  # puts it there again, and does not trust in it
    assert SqliteMaker(store.path).sql("SELECT length(body) > 0 FROM tile_version") == [(1,)]
    stored = store.get("ndt", TILE)
    assert stored is not None
    stored.decode()


def test_a_publisher_that_took_too_long_keeps_the_body(store: SqliteStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bodies_module, "COMMITTED_WITHIN_S", -1.0)
    store.put_tiles([tile_of_voxels(TILE, 1)])
    assert SqliteMaker(store.path).sql("SELECT length(body) > 0 FROM tile_version") == [(1,)]


def test_nothing_is_lost_between_a_publisher_and_a_collector(store: SqliteStore, place: str) -> None:
    """The same few contents come and go while everything unnamed is collected, however young."""
    stop, failed = threading.Event(), list[BaseException]()

    def collecting() -> None:
        objects = open_objects(place)
        try:
            with SqliteStore(store.path) as other:
                while not stop.is_set():
                    other.gc(1)
                    collected(other, objects)
                    # forgotten at once: else each content would be marked for good, and nothing put out any more
                    objects.put_new(body_name(bytes(32), 1), b"orphan")
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=collecting)
    thread.start()
    for n in range(60):
        store.put_tiles([tile_of_voxels(TILE, 1, n % 4 + 2), tile_of_voxels(EAST, 1, n % 3 + 2)])
        for tile in (TILE, EAST):
            with SqliteStore(store.path, read_only=True) as fresh:  # nothing remembered
                stored = fresh.get("ndt", tile)
                assert stored is not None
                stored.decode()
    stop.set()
    thread.join()
    assert failed == []


def test_a_missing_body_is_named(store: SqliteStore, place: str) -> None:
    store.put_tiles([tile_of_voxels(TILE, 1)])
    open_objects(place).remove([name_of(1)])
    with SqliteStore(store.path) as fresh, pytest.raises(StoreDamaged, match=f"{name_of(1)}, the body of a version"):
        fresh.get("ndt", TILE)
    damages = check_store(store.path).damages
    assert [one.kind for one in damages] == ["tile"]


def test_a_place_that_cannot_be_written_stops_publishing_and_loses_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "bodies"
    with SqliteMaker(tmp_path / "store.db", str(folder)).open() as store:
        store.put_tiles([tile_of_voxels(TILE, 1)])
        stored = store.get("ndt", TILE)
        folder.rename(tmp_path / "away")
        folder.write_bytes(b"no folder")
        with pytest.raises(StoreUnavailable):
            store.put_tiles([tile_of_voxels(TILE, 1, 2)])
        folder.unlink()
        (tmp_path / "away").rename(folder)
        assert store.get("ndt", TILE) == stored
        work = store.counts()
        assert work.versions == 1


@pytest.mark.slow
def test_a_server_that_creates_twice_is_refused_at_start_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("obstore", reason="pip install 'gnd-fleet[objects]'")
    try:
        server = S3Server("rclone")
    except NoS3ServerError as error:
        pytest.skip(str(error))
    try:
        for name, value in server.environment.items():
            monkeypatch.setenv(name, value)
        server.make_bucket("bucket")
        path = tmp_path / "store.db"
        with SqliteStore(path) as store:
            with pytest.raises(StoreUnavailable, match="creates an object that is there already"):
                move_out(store, "s3://bucket/map")
            assert store.look(place_of_bodies) is None
            store.transact(lambda c, _now: c.change("put_place_of_bodies", {"location": "s3://bucket/map", "takes": 1}))
        with pytest.raises(StoreUnavailable, match="creates an object that is there already"):
            SqliteStore(path)
    finally:
        server.end()


@pytest.mark.slow
def test_an_archive_in_a_bucket(tmp_path: Path, new_bucket: Callable[[], str]) -> None:
    objects = open_objects(new_bucket())
    with SqliteStore(tmp_path / "store.db") as store:
        store.put_tiles([tile_of_voxels(TILE, 1), tile_of_voxels(EAST, 1)])
        assert publish(store, objects, ["ndt"]).switched == 1
        store.put_tiles([tile_of_voxels(TILE, 1, 2), tile_of_voxels(EAST, 1, 2)])
        assert publish(store, objects, ["ndt"]).switched == 1
        assert publish(store, objects, ["ndt"]).objects == 0
        assert prune(objects).objects == 0
        assert prune(objects, older_than_s=-3600.0).objects == 1


@pytest.mark.slow
def test_messages_hold_no_key(new_bucket: Callable[[], str], monkeypatch: pytest.MonkeyPatch) -> None:
    location = new_bucket()
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "wrong-secret-key")
    with pytest.raises(StoreUnavailable) as caught:
        open_objects(location).put_new("a", b"b")
    assert "wrong-secret-key" not in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["s3://key:secret@bucket/x", "s3://Bucket", "s3://bucket/x?key=secret", "s3://"])
def test_locations_with_credentials_are_refused_and_not_repeated(text: str) -> None:
    with pytest.raises(StoreUnavailable, match=r"a bucket is given as s3://BUCKET") as caught:
        open_objects(text)
    assert "secret" not in str(caught.value)
