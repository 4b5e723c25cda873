"""Rights hold over the link between two routers: what is not a member's right at its router arrives at no other."""

import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from identity_scene import Scene, be_settled, router_process, scene, until
from suite_ports import new_port

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig, zenoh_config
from gnd.fleet_bus.errors import BusError
from gnd.fleet_bus.identity.folder import MEMBERS
from gnd.fleet_bus.identity.names import MemberName

V1 = "gnd/v1"
TILE = f"{V1}/tile/ndt/13033/03021/21000/00000"
CHANGE = f"{V1}/change/ndt/13033/03021/21000"
REGION = "router.region"
SETTLE_S = 0.5


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    """The hub, with a tile server."""
    with scene(tmp_path_factory.mktemp("linked")) as opened, opened.bus("tiles.store") as store:
        opened.issue(REGION)
        store.serve("gnd/v1/tile/**", lambda request: b"tile of " + request.key.encode())
        yield opened


@pytest.fixture(scope="module")
def region(place: Scene) -> Iterator[str]:
    """Endpoint of a region's router that is linked with the hub."""
    shutil.copy(place.folder("router.main") / MEMBERS, place.folder(REGION) / MEMBERS)
    endpoint = f"tls/127.0.0.1:{new_port()}"
    with router_process(place.folder(REGION), endpoint, place.endpoint):
        yield endpoint


def at(place: Scene, name: str, *endpoints: str) -> Bus:
    """A member's bus at these routers."""
    config = BusConfig(connect=endpoints, identity=place.folder(name), open_timeout_s=5.0)
    return open_bus(config, name=name)


def bare(place: Scene, name: str, endpoint: str) -> Any:
    """A member's zenoh session at a router: it may try whatever zenoh can."""
    return zenoh.open(zenoh_config(place.config(name, connect=(endpoint,))))


def test_a_vehicle_of_the_region_gets_a_tile_of_the_hub(place: Scene, region: str) -> None:
    """What the attacks below do not get: an answer over the link."""
    with at(place, "vehicle.a", region) as bus:
        assert bus.request(TILE, b"", kind="tile", timeout_s=20) == b"tile of " + TILE.encode()


def test_attack_puts_over_the_link(place: Scene, region: str) -> None:
    """A vehicle of the region puts on keys of others, of shards and of the authority; only its own arrive."""
    keys = [f"{V1}/traffic/a", f"{V1}/traffic/b", f"{V1}/want/a", f"{V1}/authority/members", f"{V1}/update/ndt/1/2/3/4"]
    heard: list[str] = []
    with place.session("router.witness") as witness, bare(place, "vehicle.a", region) as attacker:
        witness.declare_subscriber(f"{V1}/**", lambda sample: heard.append(str(sample.key_expr)))
        time.sleep(SETTLE_S)
        for key in keys:
            attacker.put(key, b"forged")
        assert until(lambda: f"{V1}/traffic/a" in heard, 5.0)
        time.sleep(SETTLE_S)
    assert set(heard) & set(keys) == {f"{V1}/traffic/a"}


def test_attack_listens_over_the_link(place: Scene, region: str) -> None:
    """A vehicle of the region subscribes to everything, and to what the hub's vehicle b is told; it hears nothing."""
    heard: list[str] = []
    with bare(place, "vehicle.a", region) as attacker, place.session("router.witness") as witness:
        for key in ("**", f"{V1}/want/*", f"{V1}/traffic/*", f"{V1}/want/b"):
            attacker.declare_subscriber(key, lambda sample: heard.append(str(sample.key_expr)))
        attacker.declare_subscriber(f"{V1}/want/a", lambda sample: heard.append(str(sample.key_expr)))
        time.sleep(SETTLE_S)
        for key in (f"{V1}/want/b", f"{V1}/traffic/b", f"{V1}/want/a"):
            witness.put(key, b"private")
        assert until(lambda: f"{V1}/want/a" in heard, 5.0)
        time.sleep(SETTLE_S)
    assert set(heard) == {f"{V1}/want/a"}


def test_attack_answers_over_the_link(place: Scene, region: str) -> None:
    """A vehicle of the region serves reports, as a shard does; the hub's vehicles do not reach it."""
    caught: list[str] = []
    with bare(place, "vehicle.a", region) as attacker, bare(place, "vehicle.b", place.endpoint) as victim:
        attacker.declare_queryable(CHANGE, lambda query: caught.append(str(query.key_expr)))
        time.sleep(SETTLE_S)
        assert not list(victim.get(CHANGE, payload=b"report", timeout=1.0))
    assert not caught


def test_attack_a_vehicle_links_as_a_router(place: Scene, region: str) -> None:
    """A vehicle opens a session in router mode and links with the hub: it has the rights of a vehicle there."""
    settings = zenoh_config(BusConfig(mode="router", connect=(place.endpoint,), identity=place.folder("vehicle.a")))
    heard: list[str] = []
    with zenoh.open(settings) as attacker, place.session("router.witness") as witness:
        attacker.declare_subscriber("**", lambda sample: heard.append(str(sample.key_expr)))
        attacker.declare_subscriber(f"{V1}/want/a", lambda sample: heard.append(str(sample.key_expr)))
        time.sleep(2 * SETTLE_S)
        witness.put(f"{V1}/traffic/b", b"private")
        witness.put(f"{V1}/want/a", b"its own")
        time.sleep(2 * SETTLE_S)
    assert set(heard) <= {f"{V1}/want/a"}


def test_attack_revoked_at_the_hub_while_it_asks_in_the_region(place: Scene, region: str) -> None:
    """Revoked by a list that reaches only the hub's folder and the bus: the region's router cuts it off, too."""
    place.issue("vehicle.bad")
    with at(place, "operator.ops", place.endpoint) as operator:
        publish_list(place, operator)
        with at(place, "vehicle.bad", region) as bad:
            assert bad.request(TILE, b"", kind="tile", timeout_s=20)
            place.authority.revoke(MemberName.parse("vehicle.bad"))
            place.tell_router()
            publish_list(place, operator)
            assert until(lambda: is_refused(bad), 20.0)
    with at(place, "vehicle.a", region) as good:
        assert good.request(TILE, b"", kind="tile", timeout_s=20)


def publish_list(place: Scene, operator: Bus) -> None:
    operator.publish(f"{V1}/authority/members", (place.folder("router.main") / MEMBERS).read_bytes(), kind="control")


def is_refused(bus: Bus) -> bool:
    try:
        bus.request(TILE, b"", kind="tile", timeout_s=0.5)
    except BusError:
        return True
    return False


def test_new_members_leave_the_link_and_who_is_there_alone(place: Scene, region: str) -> None:
    """Five lists in a row, more than a router keeps sessions: a vehicle of the region is answered all the time."""
    with at(place, "vehicle.a", region) as bus, at(place, "operator.ops", place.endpoint) as operator:
        assert bus.request(TILE, b"", kind="tile", timeout_s=20)
        be_settled()
        for n in range(5):
            place.issue(f"vehicle.new-{n}")
            publish_list(place, operator)
            with at(place, f"vehicle.new-{n}", region) as new:
                assert new.request(TILE, b"", kind="tile", timeout_s=30)
            assert bus.request(TILE, b"", kind="tile", timeout_s=10)


def test_a_new_router_makes_links_anew_and_they_carry_on(place: Scene, region: str) -> None:
    """Two lists with another router each: the region's router opens another trunk; its vehicles are answered again."""
    with at(place, "vehicle.a", region) as bus, at(place, "operator.ops", place.endpoint) as operator:
        for n in range(2):
            place.issue(f"router.more-{n}")
            publish_list(place, operator)
            for _ in range(6):
                assert bus.request(TILE, b"", kind="tile", timeout_s=30)
                time.sleep(SETTLE_S)


def test_attack_revoked_router_is_no_second_way(place: Scene, region: str, tmp_path: Path) -> None:
    """A region's router that was revoked links again and again; nothing passes its link in either direction."""
    identity = place.issue("router.lost")
    shutil.copy(place.folder("router.main") / MEMBERS, identity / MEMBERS)
    with bare(place, "router.lost", place.endpoint) as lost:
        heard: list[str] = []
        lost.declare_subscriber("**", lambda sample: heard.append(str(sample.key_expr)))
        with at(place, "vehicle.b", place.endpoint) as bus:
            assert until(lambda: not telling(bus, heard), 20.0), "its rights as long as it has them"
            place.authority.revoke(MemberName.parse("router.lost"))
            place.tell_router()
            assert until(lambda: telling(bus, heard), 20.0)
            heard.clear()
            time.sleep(3.0)
            assert telling(bus, heard)


def telling(bus: Bus, heard: list[str]) -> bool:
    """Whether what a vehicle tells now is not heard."""
    before = len(heard)
    bus.publish(f"{V1}/traffic/b", b"sample", kind="control")
    time.sleep(SETTLE_S)
    return len(heard) == before
