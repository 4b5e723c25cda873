"""`gnd.connect`: tiles and updates of a region from a real router and a real store."""

import os
import queue
import signal
import time
from collections.abc import Callable

import pytest
from api_testing import EAST, FAR, HERE, Cloud, Program, gaussian_tile, sign_tile

import gnd
import gnd.client
from gnd.gnd_map.region import Region

DEADLINE_S = 30.0


def test_the_tiles_of_a_region_are_what_the_store_holds(cloud: Cloud) -> None:
    with gnd.connect(cloud.endpoint) as client:
        assert [entry.tile for entry in client.catalog()] == [FAR, HERE, EAST]
        found = list(client.tiles("13033/03021/**"))
        assert [tile.tile_id for tile in found] == [HERE, EAST]
        assert all(isinstance(tile, gnd.Tile) for tile in found)
        stored = cloud.store.get("ndt", HERE)
        assert stored is not None
        assert found[0] == stored.decode()
        assert found[0].day == stored.day > 0
        assert [tile.tile_id for tile in client.tiles(EAST)] == [EAST]
        lat_rad, lon_rad = HERE.centre_rad
        near = Region.circle(lat_rad * 57.29577951308232, lon_rad * 57.29577951308232, 5.0)
        assert [tile.tile_id for tile in client.tiles(near)] == [HERE]
        (signs,) = client.tiles("13033/**", layer="signs")
        assert isinstance(signs, gnd.FeatureTile)
        assert [feature.feature_id for feature in signs.features] == [1, 2, 3]
        assert list(client.tiles("00000/**")) == []


def test_a_large_district_comes_in_several_answers(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    tiles = list(HERE.district.tiles())[:40]
    cloud.store.put_tiles([gaussian_tile(tile, 1, 2, 3) for tile in tiles], layer="ndt_many")
    monkeypatch.setattr("gnd.tile_client.fetching.BATCH_BYTES", 100)
    with gnd.connect(cloud.endpoint) as client:
        assert [tile.tile_id for tile in client.tiles(layer="ndt_many")] == tiles


def test_every_update_brings_the_new_content(cloud: Cloud) -> None:
    with gnd.connect(cloud.endpoint) as client, client.subscribe("13033/03021/**", layers=("ndt", "signs")) as stream:
        cloud.publish(gaussian_tile(FAR, 8))  # outside
        first = published(cloud, stream, gaussian_tile(HERE, 5, 9, 70, 71))
        assert (first.layer, first.reason, first.tile.tile_id, first.before) == ("ndt", "base", HERE, None)
        assert first.tile == newest(cloud, "ndt")
        second = published(cloud, stream, gaussian_tile(HERE, 5, 71))
        assert second.before == first.tile
        assert (second.version, second.tile) == (first.version + 1, newest(cloud, "ndt"))
        signs = published(cloud, stream, sign_tile(HERE, 2, 7), "signs")
        assert (signs.layer, signs.tile) == ("signs", newest(cloud, "signs"))
        assert stream.next(timeout_s=0.3) is None


def newest(cloud: Cloud, layer: str) -> object:
    stored = cloud.store.get(layer, HERE)
    assert stored is not None
    return stored.decode()


def published(cloud: Cloud, stream: gnd.UpdateStream, tile: gnd.Tile | gnd.FeatureTile, layer: str = "ndt"):
    """Publish until the subscription has taken effect; the update."""
    cloud.publish(tile, layer)
    deadline_s = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline_s:
        update = stream.next(timeout_s=0.5)
        if update is not None:
            return update
        stored = cloud.store.get(layer, tile.tile_id)
        assert stored is not None
        notice(cloud, layer, stored.version)
    raise AssertionError(f"no update within {DEADLINE_S} s")


def notice(cloud: Cloud, layer: str, version: int) -> None:
    """The notice once more: the first may have come before the router knew the subscription."""
    from gnd.cloud_merger.announce import encoded, update_of
    from gnd.schemas.keys import update_key

    new, old = (cloud.store.get(layer, HERE, n) for n in (version, version - 1))
    assert new is not None
    cloud.bus.publish(update_key(layer, HERE), encoded(update_of(new, old)), kind="update")


def test_a_delta_is_applied_without_asking_for_the_tile(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    with gnd.connect(cloud.endpoint) as client, client.subscribe(HERE, existing=True) as stream:
        first = stream.next(timeout_s=DEADLINE_S)
        assert first is not None
        assert first.reason == "existing"

        def refuse(*_: object) -> None:
            raise AssertionError("the tile was asked for although its delta fits")

        monkeypatch.setattr(gnd.client.TileServerClient, "fetch", refuse)
        update = published(cloud, stream, gaussian_tile(HERE, 5, 9, 70, 71))
        assert (update.before, update.tile) == (first.tile, newest(cloud, "ndt"))


def test_a_lost_notice_is_found_by_the_catalog(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gnd.client, "COMPARED_EVERY_S", 0.2)
    with gnd.connect(cloud.endpoint) as client, client.subscribe(HERE) as stream:
        assert stream.next(timeout_s=0.5) is None
        version = cloud.publish(gaussian_tile(HERE, 1, 2), quietly=True)
        update = stream.next(timeout_s=DEADLINE_S)
        assert update is not None
        assert (update.reason, update.version, update.tile) == ("missed", version, newest(cloud, "ndt"))


def test_a_callback_gets_the_updates_and_may_fail(cloud: Cloud) -> None:
    got: queue.Queue[gnd.MapUpdate] = queue.Queue()

    def take(update: gnd.MapUpdate) -> None:
        got.put(update)
        raise ValueError("the first one is too much for it")

    with gnd.connect(cloud.endpoint) as client:
        stream = client.subscribe("13033/**", take, existing=True)
        assert {got.get(timeout=DEADLINE_S).tile.tile_id for _ in range(2)} == {HERE, EAST}
    assert stream.wait(0)
    assert stream.is_closed
    assert list(stream) == []


def test_no_router_says_where_and_how_long(free_port: int) -> None:
    with pytest.raises(gnd.GndError, match=rf"no router at tcp/127.0.0.1:{free_port} for 0.5 s"):
        gnd.connect(f"tcp/127.0.0.1:{free_port}", timeout_s=0.5)


def test_no_store_behind_the_router_says_so(cloud: Cloud) -> None:
    with gnd.connect(cloud.endpoint, timeout_s=0.5) as client:
        cloud.bus.close()
        with pytest.raises(gnd.GndError, match=r"catalog.*(nobody serves|gave up after 0.5 s)"):
            client.catalog()
        with pytest.raises(gnd.GndError, match="catalog"):
            client.subscribe()


@pytest.mark.parametrize("region", ["seoul", "91,0,10", "13033/0302/**"])
def test_what_is_no_region_is_refused(cloud: Cloud, region: str) -> None:
    with gnd.connect(cloud.endpoint) as client, pytest.raises(gnd.GndError, match="cannot read the region"):
        client.tiles(region)


def test_ctrl_c_ends_a_program_that_follows_a_region(cloud: Cloud, start: Callable[..., Program]) -> None:
    program = start(
        "-c",
        "import signal, gnd\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"with gnd.connect({cloud.endpoint!r}) as client:\n"
        "    stream = client.subscribe(existing=True)\n"
        "    try:\n"
        "        for update in stream: print('got', update.version)\n"
        "    except KeyboardInterrupt: print('ended')\n",
    )
    program.line("got")
    program.process.send_signal(signal.SIGINT)
    began_s = time.monotonic()
    assert program.end() == 0
    assert time.monotonic() - began_s < 10
    assert program.lines[-1] == "ended"
    assert os.name == "posix"
