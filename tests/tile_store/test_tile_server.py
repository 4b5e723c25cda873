"""The tile server on a real router, and as a process that is killed."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh
from click.testing import CliRunner
from store_helpers import EAGER, EAST, FAR, TILE, merge_once, report, report_id, tile_of_voxels

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import READS, BusConfig
from gnd.fleet_bus.errors import RequestFailed, RequestRefused
from gnd.fleet_bus.requesting import RetryPolicy
from gnd.fleet_bus.router import open_router
from gnd.gnd_map.day import day_of
from gnd.gnd_map.tile_id import TileId
from gnd.schemas import keys
from gnd.schemas.tiles import Catalog, TileReply, TileRequest, tile_of
from gnd.schemas.tiles_batch import HeldVersion, OtherTiles, TileAnswer, TilesReply, TilesRequest, tile_of_answer
from gnd.tile_store.copying import district
from gnd.tile_store.errors import StoreError
from gnd.tile_store.regions_cli import regions
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoredTile

ONCE = RetryPolicy(attempt_timeout_s=5.0)


@pytest.fixture
def endpoint(free_port: int) -> Iterator[str]:
    at = f"tcp/127.0.0.1:{free_port}"
    with open_router((at,)):
        yield at


@pytest.fixture
def client(endpoint: str) -> Iterator[Bus]:
    with open_bus(BusConfig(connect=(endpoint,)), name="client") as bus:
        yield bus


@pytest.fixture
def store(tmp_path: Path) -> Iterator[SqliteStore]:
    with SqliteStore(tmp_path / "store.db", EAGER) as opened:
        opened.put_tiles([tile_of_voxels(tile, 1, 2) for tile in (TILE, EAST, FAR)])
        opened.put_tiles([tile_of_voxels(TILE, 8)], layer="ndt_summer")
        yield opened


@pytest.fixture
def server(endpoint: str, store: SqliteStore) -> Iterator[TileServer]:
    with open_bus(BusConfig(connect=(endpoint,)), name="store") as bus, TileServer(store, bus) as serving:
        yield serving


def ask(client: Bus, tile: TileId, request: TileRequest | None = None, layer: str = "ndt") -> TileReply:
    payload = (request or TileRequest()).encode()
    return TileReply.decode(client.request(keys.tile_key(layer, tile), payload, kind="tile", timeout_s=20.0))


def refusal(client: Bus, key: str, payload: bytes = b"") -> str:
    with pytest.raises(RequestRefused) as caught:
        client.request(key, payload, kind="tile", timeout_s=20.0)
    assert caught.value.attempts == 1
    return caught.value.cause


@pytest.mark.usefixtures("server")
def test_a_tile_is_delivered_with_its_version_and_hash(client: Bus, store: SqliteStore) -> None:
    reply = ask(client, TILE)
    assert reply.blob is not None
    assert tile_of(reply.blob).gaussians == tile_of_voxels(TILE, 1, 2).gaussians
    assert reply.blob.version == 1
    store.put_reports([report(1)])
    merge_once(store, 5)
    reply = ask(client, TILE)
    assert reply.blob is not None
    assert (reply.blob.version, reply.blob.sha) == (2, tile_of_voxels(TILE, 5).sha)


@pytest.mark.usefixtures("server")
def test_a_client_learns_when_the_world_looked_so(client: Bus, store: SqliteStore) -> None:
    request = TilesRequest.of([HeldVersion(TILE), HeldVersion(EAST)])

    def days() -> list[int]:
        payload = client.request(keys.batch_key("ndt", TILE.district), request.encode(), kind="tile", timeout_s=20.0)
        return [answer.day for _, answer in TilesReply.decode(payload).of_request(request, TILE.district)]

    assert days() == [0, 0]
    store.put_tiles([tile_of_voxels(TILE, 3)], surveyed_ns=1_700_000_000_000_000_000)
    assert days() == [day_of(1_700_000_000_000_000_000), 0]
    reply = ask(client, TILE)
    assert reply.blob is not None
    assert tile_of(reply.blob).day == days()[0]


@pytest.mark.usefixtures("server")
def test_who_has_the_content_hears_that_it_is_unchanged(client: Bus, store: SqliteStore) -> None:
    cached = ask(client, TILE).blob
    assert cached is not None
    assert ask(client, TILE, TileRequest(1, cached.sha)) == TileReply("unchanged")
    store.put_tiles([tile_of_voxels(TILE, 3)])
    assert ask(client, TILE, TileRequest(1, cached.sha)).status == "blob"
    store.rollback("ndt", TILE, 1)
    assert ask(client, TILE, TileRequest(1, cached.sha)) == TileReply("unchanged")


@pytest.mark.usefixtures("server")
def test_a_tile_that_the_map_lacks_is_absent(client: Bus) -> None:
    assert ask(client, TILE.neighbours()[0]) == TileReply("absent")
    assert ask(client, EAST, layer="ndt_summer") == TileReply("absent")


@pytest.mark.usefixtures("server")
def test_a_region_is_answered_with_one_reply_a_tile_and_nothing_outside_it(client: Bus) -> None:
    def asked(key: str, request: TileRequest | None = None) -> dict[str, str]:
        answers = client.request_many(key, (request or TileRequest()).encode(), kind="tile", timeout_s=20.0)
        return {key: TileReply.decode(payload).status for key, payload in answers}

    here = {keys.tile_key("ndt", tile): "blob" for tile in (TILE, EAST)}
    assert asked(keys.tiles_key("ndt", "13033/03021")) == here
    assert asked(keys.tiles_key("ndt", "13033/03021/23031")) == here
    assert asked(keys.tiles_key("ndt")) == here | {keys.tile_key("ndt", FAR): "blob"}
    assert asked(keys.tiles_key("ndt", "13033/03022")) == {}
    assert asked(keys.tiles_key("nothing")) == {}
    assert asked(keys.tile_key("ndt", TILE).replace("/ndt/", "/*/")) == {
        keys.tile_key(layer, TILE): "blob" for layer in ("ndt", "ndt_summer")
    }
    request = TileRequest(1, tile_of_voxels(TILE, 1, 2).sha)
    assert asked(keys.tiles_key("ndt", "13033"), request) == here | {keys.tile_key("ndt", TILE): "unchanged"}


def test_other_districts_of_a_question_are_answered_by_who_owns_them(
    endpoint: str, client: Bus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Alone a store answers for both districts of a question; once one has moved to another store it says so of it."""
    monkeypatch.setattr(district, "NOTICED_S", 0.0)
    here, there = f"sqlite:{tmp_path}/here.db", f"sqlite:{tmp_path}/there.db"
    request = TilesRequest.of([HeldVersion(TILE)]).with_others(
        TILE.district, {FAR.district: TilesRequest.of([HeldVersion(FAR)])}
    )

    def answered(store: SqliteStore) -> tuple[str, list[str | None]]:
        with open_bus(BusConfig(connect=(endpoint,)), name="store") as bus, TileServer(store, bus):
            key = keys.batch_key("ndt", TILE.district)
            reply = TilesReply.decode(client.request(key, request.encode(), kind="tile", timeout_s=20.0))
        assert len(reply.others) == 1
        return reply.answers[0].status, [None if one is None else one.answers[0].status for one in reply.others]

    with SqliteStore(tmp_path / "here.db", EAGER) as store:
        store.put_tiles([tile_of_voxels(tile, 1, 2) for tile in (TILE, FAR)])
        assert answered(store) == ("blob", ["blob"])
    for words in (["create", there, "east"], ["move", FAR.district.path, "--from", here, "--to", there]):
        done = CliRunner().invoke(regions, words)
        assert done.exit_code == 0, done.output
    with SqliteStore(tmp_path / "here.db", EAGER) as store:
        assert answered(store) == ("blob", [None])


@pytest.mark.usefixtures("server")
def test_a_district_outside_the_world_is_refused_by_name(client: Bus) -> None:
    request = TilesRequest(((0, 0),), others=(OtherTiles(1 - 2**29, ((0, 0),)),))
    assert "for the district -536870911 from" in refusal(client, keys.batch_key("ndt", TILE.district), request.encode())


@pytest.mark.usefixtures("server")
def test_tiles_of_a_district_in_one_query(client: Bus, store: SqliteStore) -> None:
    held = ask(client, TILE).blob
    assert held is not None
    absent = TileId(TILE.district.first_morton)
    request = TilesRequest.of([HeldVersion(TILE, held.version, held.sha), HeldVersion(EAST), HeldVersion(absent)])

    def asked() -> dict[TileId, TileAnswer]:
        key = keys.batch_key("ndt", TILE.district)
        reply = TilesReply.decode(client.request(key, request.encode(), kind="tile", timeout_s=20.0))
        return dict(reply.of_request(request, TILE.district))

    assert {tile: answer.status for tile, answer in asked().items()} == {
        TILE: "unchanged", EAST: "blob", absent: "absent"
    }  # fmt: skip
    assert tile_of_answer(EAST, asked()[EAST]).gaussians == tile_of_voxels(EAST, 1, 2).gaussians
    store.put_tiles([tile_of_voxels(TILE, 1, 2, 3)])
    newer = tile_of_answer(TILE, asked()[TILE], tile_of(held))
    assert (newer.version, newer.gaussians) == (2, tile_of_voxels(TILE, 1, 2, 3).gaussians)


@pytest.mark.usefixtures("server")
def test_a_bad_query_for_tiles_of_a_district_is_refused_by_name(client: Bus) -> None:
    key = keys.batch_key("ndt", TILE.district)
    good = TilesRequest.of([HeldVersion(TILE)]).encode()
    assert "WrongVersion: TilesRequest of major version 0" in refusal(client, key)
    assert "Malformed: 3 bytes are not a TilesRequest" in refusal(client, key, b"\xff\xff\xff")
    assert "TooLarge: TilesRequest of 25000 bytes exceeds the limit of 24576" in refusal(client, key, bytes(25_000))
    assert "BadKey" in refusal(client, key.replace("13033", "99999"), good)
    assert "BadKey" in refusal(client, key + "/22102", good)
    plain = TilesRequest.of([HeldVersion(TILE)], codecs=(3,)).encode()
    assert "comes in codec 1, asked for (3,)" in refusal(client, key, plain)


@pytest.mark.usefixtures("server")
def test_catalogs_of_one_district_and_of_many(client: Bus, store: SqliteStore) -> None:
    def catalog(key: str) -> Catalog:
        return Catalog.decode(client.request(key, b"", kind="catalog", timeout_s=20.0))

    store.put_tiles([tile_of_voxels(EAST, 3)])
    here = catalog(keys.catalog_key("ndt", TILE.district))
    assert [(entry.tile, entry.version) for entry in here.entries] == [(TILE, 1), (EAST, 2)]
    assert [entry.sha for entry in here.entries] == [tile_of_voxels(TILE, 1, 2).sha, tile_of_voxels(EAST, 3).sha]
    assert catalog(keys.catalog_key("ndt_summer", FAR.district)).entries == ()
    many = dict(client.request_many(keys.catalog_keys("ndt"), b"", kind="catalog", timeout_s=20.0))
    assert set(many) == {keys.catalog_key("ndt", tile.district) for tile in (TILE, FAR)}
    assert Catalog.decode(many[keys.catalog_key("ndt", TILE.district)]) == here
    deeper = keys.catalog_keys("ndt").removesuffix("**") + "13033/03021/**"
    assert [key for key, _ in client.request_many(deeper, b"", kind="catalog", timeout_s=20.0)] == [
        keys.catalog_key("ndt", TILE.district)
    ]


@pytest.mark.usefixtures("server")
def test_what_can_never_be_answered_is_refused_by_name_at_once(client: Bus) -> None:
    key = keys.tile_key("ndt", TILE)
    assert "Malformed: 3 bytes are not a TileRequest" in refusal(client, key, b"\xff\xff\xff")
    assert "TooLarge: TileRequest of 5000 bytes exceeds the limit of 1024" in refusal(client, key, bytes(5000))
    assert "WrongVersion: TileRequest of major version 9" in refusal(client, key, b"\x08\x09")
    assert "BadKey" in refusal(client, key.replace("13033", "99999"), TileRequest().encode())
    assert "BadKey" in refusal(client, keys.catalog_key("ndt", TILE.district).replace("13033", "x"))
    assert "comes in codec 1, asked for (7,)" in refusal(client, key, TileRequest(codecs=(7,)).encode())


@pytest.mark.usefixtures("server")
def test_a_query_without_payload_gets_the_tile(client: Bus) -> None:
    """A program that knows only zenoh and our schemas needs no request."""
    reply = TileReply.decode(client.request(keys.tile_key("ndt", TILE), b"", kind="tile", timeout_s=20.0))
    assert reply.blob is not None
    assert reply.blob.codec_id == 0, "float32 columns, which everybody reads"
    assert tile_of(reply.blob).gaussians == tile_of_voxels(TILE, 1, 2).gaussians


def test_a_store_that_fails_makes_the_asker_try_again(client: Bus, endpoint: str, store: SqliteStore) -> None:
    class Flaky(SqliteStore):
        failures = 2

        def get(
            self, layer: str, tile: TileId, version: int | None = None, at_ns: int | None = None
        ) -> StoredTile | None:
            if self.failures:
                self.failures -= 1
                raise StoreError("disk full")
            return super().get(layer, tile, version, at_ns)

    with Flaky(store.path) as flaky, open_bus(BusConfig(connect=(endpoint,))) as bus, TileServer(flaky, bus):
        assert ask(client, TILE).status == "blob"
        assert flaky.failures == 0
        flaky.failures = 1_000_000
        with pytest.raises(RequestFailed, match="StoreError: disk full"):
            client.request(keys.tile_key("ndt", TILE), b"", kind="tile", timeout_s=0.5)


def test_a_closed_server_answers_no_more_and_a_new_one_does(client: Bus, endpoint: str, store: SqliteStore) -> None:
    with open_bus(BusConfig(connect=(endpoint,))) as bus:
        server = TileServer(store, bus).start()
        assert ask(client, TILE).status == "blob"
        server.close()
        with pytest.raises(RequestFailed, match="nobody serves"):
            client.request(keys.tile_key("ndt", TILE), b"", kind="tile", timeout_s=0.3)
        with TileServer(store, bus):
            assert ask(client, TILE).status == "blob"


def start_process(path: Path, endpoint: str, first_line: str = "tile server: ") -> subprocess.Popen[str]:
    """`gnd store` as a process that has said this."""
    command = [sys.executable, "-m", "gnd.deploy.cli", "store", "--path", str(path), "--connect", endpoint]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    assert first_line in process.stdout.readline()
    return process


def end(process: subprocess.Popen[str], with_signal: int) -> str:
    process.send_signal(with_signal)
    try:
        output, _ = process.communicate(timeout=20)
    finally:
        process.kill()  # one that does not obey shall not keep the port and the store of the next test
    return output


@pytest.mark.slow
def test_a_killed_tile_server_loses_nothing_and_its_clients_only_wait(
    client: Bus, endpoint: str, store: SqliteStore
) -> None:
    """Vehicles ask and a merger publishes all the while the server is killed and started again."""
    process = start_process(store.path, endpoint)
    stop, answers, failures = threading.Event(), [], []

    def drive() -> None:
        while not stop.is_set():
            try:
                answers.append(ask(client, TILE))
            except RequestFailed as error:
                failures.append(error)

    vehicle = threading.Thread(target=drive)
    vehicle.start()
    try:
        for number in range(1, 4):
            enough = len(answers) + 20
            deadline = time.monotonic() + 20
            while len(answers) < enough:
                assert time.monotonic() < deadline
                time.sleep(0.005)
            assert end(process, signal.SIGKILL) == ""
            store.put_reports([report(number)])
            merge_once(store, 100 + number)
            process = start_process(store.path, endpoint)
        assert ask(client, TILE).blob is not None
    finally:
        stop.set()
        vehicle.join()
        output = end(process, signal.SIGINT)
    assert failures == []
    assert output == "tile server ended\n"
    assert process.returncode == 0
    last = ask_again(client, endpoint, store)
    assert (last.version, last.sha) == (4, tile_of_voxels(TILE, 103).sha)
    assert [row.report_id for row in store.reports()] == [report_id(number) for number in (1, 2, 3)]


def ask_again(client: Bus, endpoint: str, store: SqliteStore) -> StoredTile:
    """The tile as a new server delivers it, checked against the store."""
    with open_bus(BusConfig(connect=(endpoint,))) as bus, TileServer(store, bus):
        blob = ask(client, TILE).blob
    stored = store.get("ndt", TILE)
    assert stored is not None
    assert blob == stored.to_blob()
    return stored


def test_a_store_started_before_its_router_waits_for_it(store: SqliteStore, free_port: int) -> None:
    at = f"tcp/127.0.0.1:{free_port}"
    process = start_process(store.path, at, f"store: no router at {at} for")
    try:
        with open_router((at,)), open_bus(BusConfig(connect=(at,)), name="client") as client:
            assert ask(client, TILE).status == "blob"
    finally:
        output = end(process, signal.SIGINT)
    assert "tile server ended" in output


@pytest.mark.usefixtures("server")
def test_a_region_that_is_too_large_is_refused_with_its_size(client: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    """A wildcard over everything would keep the server busy for everybody else."""
    monkeypatch.setattr("gnd.tile_store.server.MOST_TILES_OF_REGION", 2)
    with pytest.raises(RequestRefused, match="region with 3 tiles, more than 2: ask for its catalogs"):
        client.request_many(keys.tiles_key("ndt"), b"", kind="tile", timeout_s=20.0)
    assert len(client.request_many(keys.tiles_key("ndt", "13033/03021"), b"", kind="tile", timeout_s=20.0)) == 2


@pytest.mark.usefixtures("server")
def test_a_foreign_program_gets_a_region_without_an_error(client: Bus) -> None:
    """One that knows only zenoh takes any error reply for a failure of its question."""
    for key in (keys.tiles_key("ndt"), keys.catalog_keys("ndt"), keys.tiles_key("nothing")):
        replies = list(client._connection.session.get(key, timeout=10.0))
        assert all(reply.ok is not None for reply in replies)
        assert len(replies) == {keys.tiles_key("ndt"): 3, keys.catalog_keys("ndt"): 2}.get(key, 0)


def test_a_router_knows_the_keys_whose_answers_it_may_drop() -> None:
    """And no others: reports and their acknowledgements are never dropped."""
    district = keys.tile_key("ndt", TILE), keys.batch_key("ndt", TILE.district), keys.catalog_key("ndt", TILE.district)
    reads = [zenoh.KeyExpr(one) for one in READS]
    assert [[one.includes(zenoh.KeyExpr(key)) for key in district] for one in reads] == np.eye(3, dtype=bool).tolist()
    assert not any(one.intersects(zenoh.KeyExpr(keys.change_keys())) for one in reads)


def test_a_store_process_that_cannot_start_says_why_in_one_line(tmp_path: Path, free_port: int) -> None:
    (tmp_path / "s.db").write_text("not a store, whatever its name says " * 10)
    command = [sys.executable, "-m", "gnd.deploy.cli", "store", "--path", str(tmp_path / "s.db")]
    done = subprocess.run(
        [*command, "--connect", f"tcp/127.0.0.1:{free_port}"], capture_output=True, text=True, env=os.environ
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == (
        f"gnd: {tmp_path / 's.db'}: not a tile store (not an SQLite database); choose another path\n"
    )
