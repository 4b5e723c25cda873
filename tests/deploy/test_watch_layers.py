"""Watchers of feature layers on a real router: their layers and region, nothing else; in the project and outside."""

import json
import queue
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from gnd.cloud_merger.announce import encoded, update_of
from gnd.deploy.watch import TileWatch, WatchEvent
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.router import open_router
from gnd.gnd_map.features import Feature, FeatureTile, hit
from gnd.gnd_map.region import parse_region
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import update_key
from gnd.tile_store.server import TileServer
from gnd.tile_store.sqlite_store import SqliteStore

HERE, ELSEWHERE = TileId(497353963154), TileId(0)
LAYERS = ("signs", "streetlights", "poles")
DEADLINE_S = 30.0
SUBSCRIBE = Path(__file__).resolve().parents[2] / "examples" / "subscribe.py"


def signs(tile: TileId, *ids: int) -> FeatureTile:
    cov_m2 = np.array([0.04, 0.0, 0.0, 0.04, 0.0, 1e4])
    at = np.array([[1.0, 2.0, 30.0]])
    return FeatureTile.of(tile, 1, [Feature(number, "traffic_sign", at, cov_m2, hit(0.9)) for number in ids])


@pytest.fixture
def endpoint(free_port: int) -> Iterator[str]:
    address = f"tcp/127.0.0.1:{free_port}"
    with open_router((address,)):
        yield address


@pytest.fixture
def bus(endpoint: str) -> Iterator[Bus]:
    with open_bus(BusConfig(connect=(endpoint,)), name="cloud") as bus:
        yield bus


@pytest.fixture
def store(tmp_path: Path, bus: Bus) -> Iterator[SqliteStore]:
    with SqliteStore(tmp_path / "store.sqlite") as store:
        for layer in LAYERS:
            store.put_tiles([signs(HERE, 1, 2, 3), signs(ELSEWHERE, 1)], layer=layer)
        with TileServer(store, bus):
            yield store


def next_notice(store: SqliteStore, layer: str, tile: FeatureTile) -> tuple[str, bytes]:
    """Put the next version; key and bytes of its notice."""
    (result,) = store.put_tiles([tile], layer=layer)
    stored, parent = (store.get(layer, tile.tile_id, number) for number in (result.version, result.version - 1))
    assert stored is not None
    return update_key(layer, tile.tile_id), encoded(update_of(stored, parent))


def test_a_watch_follows_its_layers_and_its_region_and_nothing_else(bus: Bus, store: SqliteStore) -> None:
    events: queue.Queue[WatchEvent] = queue.Queue()
    stop = threading.Event()
    watch = TileWatch(bus, parse_region("13033/03021/**"), events.put, layers=("signs", "streetlights", "signs"))
    thread = threading.Thread(target=watch.run, args=(stop,))
    thread.start()
    try:
        first = heard(bus, events, *next_notice(store, "signs", signs(HERE, 2, 3, 4, 5)))
        assert (first.layer, first.tile, first.version, first.put, first.removed) == ("signs", HERE.morton, 2, 2, 1)
        assert f"signs {HERE.path}  v1 -> v2  base  +2 -1 features  {first.size} B" in first.line()
        bus.publish(*next_notice(store, "poles", signs(HERE, 9)), kind="update")
        bus.publish(*next_notice(store, "signs", signs(ELSEWHERE, 9)), kind="update")
        second = heard(bus, events, *next_notice(store, "streetlights", signs(HERE, 1)))
        assert (second.layer, second.version, second.put, second.removed) == ("streetlights", 2, 0, 2)
        store.put_tiles([signs(HERE)], layer="signs")  # its notice is lost: the catalog tells
        third = events.get(timeout=DEADLINE_S)
        assert (third.layer, third.version, third.reason, third.put) == ("signs", 3, "catalog", None)
    finally:
        stop.set()
        thread.join(DEADLINE_S)
    assert events.empty()


def heard(bus: Bus, events: "queue.Queue[WatchEvent]", key: str, notice: bytes) -> WatchEvent:
    """Publish a notice again until the subscription has taken effect."""
    for _ in range(int(DEADLINE_S / 0.2)):
        bus.publish(key, notice, kind="update")
        try:
            return events.get(timeout=0.2)
        except queue.Empty:
            continue
    raise AssertionError(f"no notice within {DEADLINE_S} s")


def test_a_subscriber_outside_the_project_gets_its_layer_and_region_and_nothing_else(
    endpoint: str, bus: Bus, store: SqliteStore
) -> None:
    command = [sys.executable, str(SUBSCRIBE), "13033/03021", "--layer", "signs", "--connect", endpoint]
    lines: queue.Queue[str] = queue.Queue()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=SUBSCRIBE.parents[1]) as process:
        assert process.stdout is not None
        reader = threading.Thread(target=lambda: [lines.put(line.strip()) for line in process.stdout or ()])
        reader.start()
        try:
            assert lines.get(timeout=DEADLINE_S) == "listening to gnd/v1/update/signs/13033/03021/**"
            for layer, tile in (("poles", HERE), ("signs", ELSEWHERE), ("streetlights", HERE)):
                bus.publish(*next_notice(store, layer, signs(tile, 7)), kind="update")
            key, notice = next_notice(store, "signs", signs(HERE, 2, 3, 4, 5))
            line = printed(bus, lines, key, notice)
        finally:
            process.kill()
            reader.join(DEADLINE_S)
    assert line == f"{HERE.path} v1 -> v2 base +2 -1"
    rest = {lines.get_nowait() for _ in range(lines.qsize())}
    assert rest <= {line}, "another layer or region"


def printed(bus: Bus, lines: "queue.Queue[str]", key: str, notice: bytes) -> str:
    for _ in range(int(DEADLINE_S / 0.2)):
        bus.publish(key, notice, kind="update")
        try:
            return lines.get(timeout=0.2)
        except queue.Empty:
            continue
    raise AssertionError(f"nothing printed within {DEADLINE_S} s")


def test_the_command_follows_several_layers(endpoint: str, bus: Bus, store: SqliteStore) -> None:
    region = ["13033/03021/**", "--layer", "signs", "--layer", "streetlights", "--json", "--connect", endpoint]
    command = [sys.executable, "-m", "gnd.deploy.cli", "watch", *region]
    lines: queue.Queue[str] = queue.Queue()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=SUBSCRIBE.parents[1]) as process:
        reader = threading.Thread(target=lambda: [lines.put(line.strip()) for line in process.stdout or ()])
        reader.start()
        try:
            bus.publish(*next_notice(store, "poles", signs(HERE, 5)), kind="update")
            for layer in ("signs", "streetlights"):
                event = json.loads(printed(bus, lines, *next_notice(store, layer, signs(HERE, 3, 4))))
                assert [event[name] for name in ("layer", "version", "put", "removed")] == [layer, 2, 1, 2]
        finally:
            process.kill()
            reader.join(DEADLINE_S)
