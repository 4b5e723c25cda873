"""The parts of a chaos run: the plan, the street, the line that is cut, the account of pauses, pages of a store."""

import socket
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gnd.deploy.chaos import page
from gnd.deploy.chaos.faults import KINDS, Fault, plan
from gnd.deploy.chaos.service import SERVICES, ServiceGaps, gaps
from gnd.deploy.chaos.street import DISTRICTS, read_street
from gnd.deploy.chaos.wire import Wires
from gnd.deploy.errors import ChaosError
from gnd.gnd_map.tile import content_sha
from gnd.schemas.tiles import TileRequest
from gnd.tile_store.answers import TileAnswers
from gnd.tile_store.check import check_store
from gnd.tile_store.errors import StoreDamaged
from gnd.tile_store.sqlite_store import SqliteStore

PATIENCE_S = 5.0


def test_a_seed_draws_the_same_faults_every_kind_about_as_often() -> None:
    faults = plan(7, 200)
    assert faults == plan(7, 200)
    assert faults != plan(8, 200)
    counts = Counter(fault.kind for fault in faults)
    assert set(counts) == {kind.name for kind in KINDS}
    assert max(counts.values()) - min(counts.values()) <= 1
    assert 1.5 * 200 <= faults[-1].at_s <= 2.5 * 200
    assert all(fault.clock_s for fault in faults if fault.kind == "clock step")


def test_a_vehicle_says_the_same_again_and_two_say_something_else() -> None:
    street = read_street()
    assert len({tile.tile_id.district for tile in street.tiles}) == DISTRICTS
    said = [street.said(1, "car-1", n) for n in range(12)]
    assert [one.packed.encode() for one in said] == [street.said(1, "car-1", n).packed.encode() for n in range(12)]
    assert len({one.key for one in said}) == DISTRICTS
    assert len({len(one.packed.flags) for one in said}) > 4
    assert said[0].whole.report_id != street.said(1, "car-2", 0).whole.report_id
    for one in said:
        assert {tile.sha for tile in one.bases} == {change.base_sha for change in one.whole.tiles if change.base_sha}
        assert all(content_sha(tile.tile_id, tile.gaussians) == tile.sha for tile in one.bases)


def test_a_file_that_is_no_street_is_named(tmp_path: Path) -> None:
    (tmp_path / "street.bin").write_bytes(b"no street")
    with pytest.raises(ChaosError, match=r"street\.bin"):
        read_street(tmp_path / "street.bin")


# The line


@contextmanager
def echo() -> Iterator[int]:
    """A server that gives back what it gets; its port."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            while True:
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                threading.Thread(target=answer, args=(connection,), daemon=True).start()

        def answer(connection: socket.socket) -> None:
            with connection:
                try:
                    while data := connection.recv(100):
                        connection.sendall(data)
                except OSError:
                    return

        threading.Thread(target=serve, daemon=True).start()
        yield server.getsockname()[1]


def connected(endpoint: str) -> socket.socket:
    host, port = endpoint.removeprefix("tcp/").split(":")
    return socket.create_connection((host, int(port)), PATIENCE_S)


def is_dead(client: socket.socket) -> bool:
    """Whether nothing more comes over a connection."""
    try:
        return not client.recv(10)
    except ConnectionError:
        return True


def test_a_line_that_is_cut_ends_connections_and_takes_no_new_ones_until_it_is_mended() -> None:
    with echo() as port, Wires(port) as wires:
        endpoint = wires.open("car")
        with connected(endpoint) as client:
            client.sendall(b"one")
            assert client.recv(10) == b"one"
            wires.cut("car")
            assert is_dead(client)
        with connected(endpoint) as client:
            assert is_dead(client)
        wires.mend("car")
        with connected(endpoint) as client:
            client.sendall(b"two")
            assert client.recv(10) == b"two"


def test_a_line_that_is_held_up_delivers_late_and_loses_nothing() -> None:
    with echo() as port, Wires(port) as wires, connected(wires.open("car")) as client:
        wires.hold("car")
        client.sendall(b"late")
        client.settimeout(0.3)
        with pytest.raises(TimeoutError):
            client.recv(10)
        wires.mend("car")
        client.settimeout(PATIENCE_S)
        assert client.recv(10) == b"late"


# Pauses


def served(**times_s: list[float]) -> ServiceGaps:
    every = {service: [k / 10 for k in range(101)] for service in SERVICES}
    return ServiceGaps(every | times_s)


def test_a_pause_belongs_to_the_kill_within_it_and_to_nothing_else() -> None:
    faults = [Fault(0, "kill store", 2.0, 0.0, 0.5), Fault(1, "clock step", 5.0, 1.0, 0.5, 60.0)]
    told = gaps(served(tile=[k / 10 for k in range(101) if not 20 < k < 28]), faults, 0.0, 10.0)
    assert told.by_kind["kill store"]["tile"] == pytest.approx(0.8)
    assert told.by_kind["kill store"]["report"] == pytest.approx(0.1)
    assert told.of_kills["tile"] == pytest.approx(0.8)
    # a clock that is wrong excuses nothing
    told = gaps(served(update=[k / 10 for k in range(101) if not 50 < k < 60]), faults, 0.0, 10.0)
    assert told.by_kind["clock step"]["update"] == pytest.approx(1.0)
    assert told.of_kills["update"] == pytest.approx(0.1)


def test_of_a_part_that_was_stopped_only_the_time_after_it_counts() -> None:
    faults = [Fault(0, "stop store", 2.0, 1.5, 0.5)]
    told = gaps(served(tile=[k / 10 for k in range(101) if not 20 < k < 40]), faults, 0.0, 10.0)
    assert told.by_kind["stop store"]["tile"] == pytest.approx(2.0 - 1.5)


def test_a_client_that_is_stalled_excuses_no_pause_of_the_others() -> None:
    faults = [
        Fault(0, "stall follower", 1.0, 6.0, 0.5),
        Fault(1, "stop store", 1.5, 5.0, 0.5),
        Fault(2, "kill shard", 2.0, 0, 0.5),
    ]
    pause = [k / 10 for k in range(101) if not 20 < k < 60]
    told = gaps(served(tile=pause, report=pause, update=pause), faults, 0.0, 10.0)
    assert told.of_kills == pytest.approx({"tile": 0.1, "report": 4.0, "update": 4.0})


def test_a_service_that_never_comes_back_is_a_pause_to_the_end() -> None:
    faults = [Fault(0, "kill router", 2.0, 0.0, 0.5)]
    told = gaps(served(update=[0.0, 1.0, 1.9]), faults, 0.0, 10.0)
    assert told.of_kills["update"] == pytest.approx(8.1)


# Pages


def test_a_page_of_a_body_is_found_broken_and_mended(tmp_path: Path) -> None:
    path, street = tmp_path / "store.sqlite", read_street(districts=1)
    large = max(street.tiles, key=lambda tile: len(tile.gaussians))
    with SqliteStore(path) as store:
        store.put_tiles(street.tiles)
        stored = store.get("ndt", large.tile_id)
    assert stored is not None
    assert len(stored.body) > page.PAGE_BYTES
    at = page.find(path, stored.body)
    assert at is not None
    was = page.write(path, at, b"\xff" * page.SAMPLE_BYTES)
    damaged = [one.name for one in check_store(path).damages if one.kind == "tile"]
    assert damaged == [f"ndt {large.tile_id.path} version 1"]
    with SqliteStore(path, read_only=True) as store:
        answers = TileAnswers(store)
        with pytest.raises(StoreDamaged, match=large.tile_id.path):
            answers.one(store.get("ndt", large.tile_id), TileRequest())
        assert page.write(path, at, was) == b"\xff" * page.SAMPLE_BYTES
        assert check_store(path).damages == ()
        assert answers.one(store.get("ndt", large.tile_id), TileRequest()).blob is not None
    assert page.find(path, bytes(range(256)) * 40) is None
