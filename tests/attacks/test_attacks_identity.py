"""Who has no certificate of ours, or a bad one, or one that was taken back, gets nowhere; and is told why."""

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from identity_scene import Scene, Wiretap, be_settled, forged_folder, router_process, scene, until
from suite_ports import new_port

from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig, zenoh_config
from gnd.fleet_bus.errors import BusConfigError, BusError, IdentityError, NoRouter
from gnd.fleet_bus.identity.authority import Authority
from gnd.fleet_bus.identity.folder import load_identity, problems
from gnd.fleet_bus.identity.lists import MemberList
from gnd.fleet_bus.identity.names import MemberName

TILE = "gnd/v1/tile/ndt/13033/03021/21000/00000"
GND = (sys.executable, "-m", "gnd.deploy.cli")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    """A router with rights, and a tile server that answers."""
    with scene(tmp_path_factory.mktemp("identity")) as opened, opened.bus("tiles.store") as store:
        store.serve("gnd/v1/tile/**", lambda request: b"tile of " + request.key.encode())
        yield opened


def refusal(place: Scene, folder: Path) -> str:
    """What a client is told that tries to get in with this folder."""
    with pytest.raises((NoRouter, IdentityError)) as refused:
        place.bus(folder, open_timeout_s=1.0)
    return str(refused.value)


def zenoh_gets_in(place: Scene, folder: Path) -> bool:
    """Whether bare zenoh gets a session with these files, whatever our own checks say."""
    config = zenoh_config(place.config(folder, open_timeout_s=1.0))
    try:
        with zenoh.open(config) as session:
            return bool(list(session.info.routers_zid()))
    except zenoh.ZError:
        return False


def test_the_right_certificate_gets_a_tile(place: Scene) -> None:
    """What the attacks below do not get: an answer."""
    with place.bus("vehicle.a") as bus:
        assert bus.request(TILE, b"", kind="tile", timeout_s=10) == b"tile of " + TILE.encode()
    assert zenoh_gets_in(place, place.folder("vehicle.a"))


def test_attack_no_certificate(place: Scene) -> None:
    """A client that trusts our authority but shows no certificate; the handshake fails."""
    settings = zenoh.Config()
    settings.insert_json5("mode", '"client"')
    settings.insert_json5("connect/endpoints", json.dumps([place.endpoint]))
    settings.insert_json5("scouting/multicast/enabled", "false")
    root = str(place.folder("vehicle.a") / "authority.pem")
    settings.insert_json5("transport/link/tls/root_ca_certificate", json.dumps(root))
    with pytest.raises(zenoh.ZError):
        zenoh.open(settings)
    with pytest.raises(BusConfigError, match="needs an identity"):
        BusConfig(connect=(place.endpoint,), identity=None)


def test_attack_foreign_authority(place: Scene, tmp_path: Path) -> None:
    """A certificate with the name of a vehicle of ours, from an authority of the attacker's own."""
    foreign = Authority.create(tmp_path / "foreign", "attacked fleet")
    foreign.issue(MemberName("vehicle", "a"), tmp_path / "v")
    (tmp_path / "v" / "authority.pem").write_bytes((place.folder("vehicle.a") / "authority.pem").read_bytes())
    assert "does not come from the authority" in refusal(place, tmp_path / "v")
    assert not zenoh_gets_in(place, tmp_path / "v")


def test_attack_self_signed(place: Scene, tmp_path: Path) -> None:
    """A certificate that vouches for itself."""
    folder = forged_folder(tmp_path / "v", "vehicle.a", place.folder("vehicle.a") / "authority.pem")
    assert "does not come from the authority" in refusal(place, folder)
    assert not zenoh_gets_in(place, folder)


def test_attack_a_vehicle_as_authority(place: Scene, tmp_path: Path) -> None:
    """A vehicle signs a certificate "shard.shard-0" with its own key and shows its own certificate as the issuer."""
    own = load_identity(place.folder("vehicle.a"))
    authority = place.folder("vehicle.a") / "authority.pem"
    folder = forged_folder(tmp_path / "s", "shard.shard-0", authority, issuer=(own.certificate, own.key))
    assert "was not issued by" in refusal(place, folder)
    assert not zenoh_gets_in(place, folder)


def by_authority(place: Scene, folder: Path, days: tuple[float, float]) -> Path:
    """A certificate that our authority has signed, for another time than now."""
    root = place.authority
    folder = forged_folder(
        folder, "vehicle.a", root.folder / "authority.pem", issuer=(root.certificate, root._key), days=days
    )
    chain = (folder / "certificate.pem").read_text().split("-----END CERTIFICATE-----\n")
    (folder / "certificate.pem").write_text(chain[0] + "-----END CERTIFICATE-----\n")
    return folder


def test_attack_expired(place: Scene, tmp_path: Path) -> None:
    """A certificate whose time is over."""
    folder = by_authority(place, tmp_path / "v", (-8.0, -1.0))
    assert "has expired" in refusal(place, folder)
    assert not zenoh_gets_in(place, folder)


def test_attack_not_yet_valid(place: Scene, tmp_path: Path) -> None:
    """A certificate of tomorrow: what a vehicle with a wrong clock sees, and is told."""
    folder = by_authority(place, tmp_path / "v", (1.0, 8.0))
    assert "is the clock wrong?" in refusal(place, folder)
    assert not zenoh_gets_in(place, folder)


def test_attack_with_a_stolen_certificate_without_its_key(place: Scene, tmp_path: Path) -> None:
    """The certificate of vehicle a, which is public, with the key of vehicle b."""
    shutil.copytree(place.folder("vehicle.a"), tmp_path / "v")
    shutil.copy(place.folder("vehicle.b") / "key.pem", tmp_path / "v" / "key.pem")
    assert "key of another certificate" in refusal(place, tmp_path / "v")
    assert not zenoh_gets_in(place, tmp_path / "v")


def test_attack_plain_client_at_the_tls_port(place: Scene) -> None:
    """A client that speaks plain zenoh to the port; nothing is answered."""
    plain = place.endpoint.replace("tls/", "tcp/")
    with pytest.raises(NoRouter):
        open_bus(BusConfig(connect=(plain,), open_timeout_s=1.0), name="plain")


def test_attack_plain_router_beyond_loopback() -> None:
    """A router that would listen for everybody without TLS is refused before it listens."""
    done = subprocess.run([*GND, "router", "--listen", "tcp/0.0.0.0:7447"], capture_output=True, text=True)
    assert done.returncode == 2
    assert "is plain and reaches beyond this machine" in done.stderr


def test_attack_plain_listener_of_a_secure_router(place: Scene) -> None:
    """A router with an identity is told to open a plain port beside: it refuses, since rights go by certificates."""
    where = f"tcp/127.0.0.1:{new_port()}"
    command = [*GND, "router", "--listen", where, "--identity", str(place.folder("router.main"))]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert "listens at tls/host:port alone" in done.stderr


def test_attack_a_vehicle_runs_a_router(place: Scene) -> None:
    """A vehicle's certificate behind a listening port: neither `gnd router` nor a client takes it for a router."""
    where = f"tls/127.0.0.1:{new_port()}"
    command = [*GND, "router", "--listen", where, "--identity", str(place.folder("vehicle.b"))]
    assert "not of a router" in subprocess.run(command, capture_output=True, text=True).stderr
    settings = zenoh_config(BusConfig(mode="router", connect=(), listen=(where,), identity=place.folder("vehicle.b")))
    with zenoh.open(settings), pytest.raises(NoRouter, match="certificate is not"):
        place.bus("vehicle.a", connect=(where,), open_timeout_s=1.0)


def test_attack_router_under_another_name(place: Scene) -> None:
    """A router of ours is reached under a name that its certificate does not bear; the client refuses and says so."""
    where = f"tls/127.0.0.2:{new_port()}"
    with (
        router_process(place.folder("router.main"), where),
        pytest.raises(NoRouter, match=r"not for the name 127\.0\.0\.2"),
    ):
        place.bus("vehicle.a", connect=(where,), open_timeout_s=1.0)


def test_attack_router_of_another_authority(place: Scene, tmp_path: Path) -> None:
    """A router in the middle with a certificate of another authority; vehicles refuse it."""
    foreign = Authority.create(tmp_path / "foreign", "foreign")
    foreign.issue(MemberName("router", "evil"), tmp_path / "r")
    where = f"tls/127.0.0.1:{new_port()}"
    with router_process(tmp_path / "r", where), pytest.raises(NoRouter, match="does not come from our authority"):
        place.bus("vehicle.a", connect=(where,), open_timeout_s=1.0)


def test_attack_passive_listener(place: Scene) -> None:
    """Somebody records what goes between a vehicle and the router: neither keys nor payloads can be read."""
    tap = Wiretap(place.endpoint)
    try:
        with place.bus("vehicle.a", connect=(tap.endpoint,)) as bus:
            assert bus.request(TILE, b"question of the vehicle", kind="tile", timeout_s=10).startswith(b"tile of")
    finally:
        tap.close()
    assert len(tap.heard) > 1000
    for secret in (b"question of the vehicle", b"tile of", b"gnd/v1", b"13033"):
        assert secret not in bytes(tap.heard)


def test_attack_revoked_while_it_asks(place: Scene) -> None:
    """A vehicle asks on and on while it is revoked: from the cut on, nothing is answered, whatever it tries."""
    folder = place.issue("vehicle.lost")
    with place.bus("vehicle.a") as other, place.bus(folder) as lost:
        assert lost.request(TILE, b"", kind="tile", timeout_s=20)
        be_settled()
        connections = other.connections
        revoke = [*GND, "certs", "revoke", "vehicle.lost", "--authority", str(place.authority.folder)]
        subprocess.run([*revoke, "--to", str(place.folder("router.main"))], check=True, capture_output=True)
        told_s = time.monotonic()
        last_s = told_s
        while time.monotonic() < told_s + 8.0:
            try:
                lost.request(TILE, b"", kind="tile", timeout_s=0.3)
                last_s = time.monotonic()
            except BusError:
                pass
        assert last_s - told_s < 5.0
        with pytest.raises(BusError), place.bus(folder) as again:  # a new session fares no better
            again.request(TILE, b"", kind="tile", timeout_s=2.0)
        assert other.request(TILE, b"", kind="tile", timeout_s=10)
        assert other.connections == connections
    shutil.copy(place.authority.folder / "revoked.pem", folder / "revoked.pem")
    assert any("was revoked" in problem for problem in problems(load_identity(folder)))
    place.authority = Authority(place.authority.folder)  # another process has changed it
    with pytest.raises(IdentityError, match="is shut out until"):
        place.issue("vehicle.lost")


def test_attack_revoked_shard_keeps_its_token(place: Scene) -> None:
    """A shard that is revoked loses its sign of life with its connection, so that others take its districts."""
    folder = place.issue("shard.gone")
    with place.bus("operator.ops") as operator, place.bus(folder) as shard:
        alive: dict[str, bool] = {}
        operator.watch_alive("gnd/v1/alive/merger/*", alive.__setitem__)
        key = "gnd/v1/alive/merger/gone"
        assert until(lambda: shard.connections > 0)
        shard.declare_alive(key)
        assert until(lambda: alive.get(key) is True)
        place.authority.revoke(MemberName("shard", "gone"))
        place.tell_router()
        assert until(lambda: alive.get(key) is False, 10.0)
        time.sleep(1.0)
        assert alive[key] is False


def numbered(place: Scene, number: int, authority: Authority | None = None) -> bytes:
    """A list of members without any vehicle."""
    signing = (authority or place.authority)._key
    return MemberList(number, frozenset({MemberName("operator", "ops")}), frozenset({"vehicle.a"})).encode(signing)


@pytest.mark.parametrize("how", ["forged", "old", "damaged"])
def test_attack_list_of_members(how: str, place: Scene, tmp_path: Path) -> None:
    """A list that shuts a vehicle out is put on the bus by an operator: forged, an old one again, or damaged."""
    data = {
        "forged": lambda: numbered(place, 10_000, Authority.create(tmp_path / "x", "x")),
        "old": lambda: numbered(place, 1),
        "damaged": lambda: numbered(place, 10_000)[:-40] + b"A" * 40,
    }[how]()
    with place.bus("operator.ops") as operator, place.bus("vehicle.a") as vehicle:
        be_settled()
        connections = vehicle.connections
        operator.publish("gnd/v1/authority/members", data, kind="control")
        time.sleep(1.5)
        assert vehicle.request(TILE, b"", kind="tile", timeout_s=10)
        assert vehicle.connections == connections


def test_attack_list_of_members_in_the_folder(place: Scene) -> None:
    """Somebody edits the list in the router's folder; it is not signed, and the router keeps what it knows."""
    path = place.folder("router.main") / "members.json"
    kept = path.read_bytes()
    try:
        path.write_bytes(kept.replace(b"vehicle.b", b"vehicle.x"))
        with place.bus("vehicle.b") as vehicle:
            time.sleep(1.2)
            assert vehicle.request(TILE, b"", kind="tile", timeout_s=10)
    finally:
        path.write_bytes(kept)


def test_a_list_on_the_bus_reaches_the_router(place: Scene) -> None:
    """An operator's `gnd certs publish --connect` tells a router of a new member, and the list stays with it."""
    place.authority.issue(MemberName("vehicle", "by-bus"), place.root / "vehicle.by-bus")
    identity = str(place.folder("operator.ops"))
    command = [*GND, "certs", "publish", "--authority", str(place.authority.folder), "--connect", place.endpoint]
    subprocess.run([*command, "--identity", identity], check=True, capture_output=True)
    with place.bus("vehicle.by-bus") as vehicle:
        assert vehicle.request(TILE, b"", kind="tile", timeout_s=20)
    newest = (place.authority.folder / "members.json").read_bytes()
    assert until(lambda: (place.folder("router.main") / "members.json").read_bytes() == newest, 10.0)
