"""Programs that send too much, too slowly, or what costs too much: an honest client is still served, and what is
bounded stays bounded.
"""

import datetime as dt
import itertools
import json
import os
import random
import signal
import socket
import ssl
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from limits_scene import HONEST, Honest, flooding, store_bytes, wait_for
from ulid import ULID

from gnd.cloud_merger.admission import (
    AGAIN_A_MINUTE,
    FIRST_NAMES_A_MINUTE,
    FIRST_NAMES_AT_ONCE,
    NONSENSE_AT_ONCE,
    REPORTS_AT_ONCE,
    WAITING_OF_ALL,
    WAITING_OF_VEHICLE,
    WAITING_RETRY_S,
)
from gnd.cloud_merger.features.kept import square
from gnd.deploy.chaos.street import ChaosStreet, read_street
from gnd.deploy.processes import ProcessSpec
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig, zenoh_config
from gnd.fleet_bus.errors import Busy, RequestFailed
from gnd.fleet_bus.guard import USUAL_LIMITS, ConnectionGuard
from gnd.fleet_bus.requesting import BUSY_SPREAD, COUNT_WANTED, LONGEST_BUSY_S
from gnd.fleet_bus.router import open_router
from gnd.fleet_bus.seals import MARK
from gnd.fleet_bus.seldom import LINES_A_MINUTE, MAX_LINE_CHARACTERS
from gnd.gnd_map.codec import Flags, encode_flags
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile_id import TileId
from gnd.gnd_map.track import Track, TrackPiece, encode_track
from gnd.schemas.changes import ChangeReport
from gnd.schemas.generated import change_report_pb2
from gnd.schemas.keys import ROOT, change_key, health_key, tile_key, traffic_key, update_keys
from gnd.schemas.packed import PackedGaussians, PackedReport, digest_of
from gnd.schemas.report_id import deterministic_report_id
from gnd.tile_store.uploads import UploadStatus
from studies.dearest import whole_report as dearest_report
from studies.flooding import FLOODER, ghosts
from studies.small_cloud import TILE, SmallCloud, base_tile, change_report, small_cloud

pytestmark = pytest.mark.slow
QUARANTINE_BYTES = 64_000_000


@pytest.fixture(scope="module")
def street() -> ChaosStreet:
    return read_street()


@pytest.fixture(scope="module")
def cloud(tmp_path_factory, street):
    with small_cloud(tmp_path_factory.mktemp("cloud")) as running:
        running.store.put_tiles(street.tiles)
        yield running


@pytest.fixture(scope="module")
def honest(cloud, street):
    with open_bus(BusConfig(connect=(cloud.connect,)), name=HONEST) as bus:
        one = Honest(bus, cloud.store, street)
        one.hears(one.reports())
        yield one


def waiting(cloud: SmallCloud, vehicle: str | None = None) -> int:
    return cloud.store.uploads_waiting(vehicle, 1_000_000)


def quarantined(cloud: SmallCloud) -> list:
    return cloud.store.quarantined()


# Floods


def test_attack_reports_of_one_vehicle(cloud, honest):
    """One vehicle sends 300 reports a second: it is told to wait, and the reports of others are looked at in turn."""
    with flooding(cloud, "reports", 300.0, for_s=2.0):
        honest.hears(honest.reports())
        honest.fetches()
        assert waiting(cloud, FLOODER) <= WAITING_OF_VEHICLE
    kept = cloud.store.upload_counts().by_state
    assert sum(kept.values()) <= REPORTS_AT_ONCE + 100


def test_attack_reports_of_invented_vehicles(cloud, honest):
    """Each of 300 reports a second has a new name: new names share one quarter of the work and half of the room."""
    with flooding(cloud, "names", 300.0, for_s=2.0):
        honest.is_served()
        assert waiting(cloud) <= WAITING_OF_ALL // 2 + 1000


def test_attack_nonsense(cloud, honest):
    """Bytes that are no report come 300 times a second: after a few they are no longer kept."""
    with flooding(cloud, "nonsense", 300.0, for_s=2.0):
        honest.is_served()
    assert len(quarantined(cloud)) <= NONSENSE_AT_ONCE + 60


def test_attack_quarantine(cloud, honest):
    """Messages of 8 MB that cannot be read would fill the disk: the quarantine and the store's log stay bounded."""
    with flooding(cloud, "huge", 15.0, for_s=4.0):
        honest.is_served()
    assert sum(len(one.body) for one in quarantined(cloud)) <= QUARANTINE_BYTES
    assert store_bytes(cloud.folder / "store.sqlite") <= 4 * QUARANTINE_BYTES


def test_attack_log(cloud, honest):
    """A refusal writes a line: so many a minute, and no longer than a line is."""
    before = sum(path.stat().st_size for path in cloud.folder.glob("*.log"))
    with flooding(cloud, "nonsense", 400.0, for_s=3.0):
        honest.is_served()
    written = sum(path.stat().st_size for path in cloud.folder.glob("*.log")) - before
    assert written <= 4 * 2 * LINES_A_MINUTE * (MAX_LINE_CHARACTERS + 200)


def test_attack_messages_over_the_limit(cloud, honest):
    """Messages of 12 MB on the key of reports: the router lets none of them in."""
    with flooding(cloud, "oversize", 5.0, for_s=3.0):
        honest.is_served()
    assert all(len(one.body) < 10_000_000 for one in quarantined(cloud))


@pytest.mark.parametrize("kind", ["tiles", "states"])
def test_attack_questions(cloud, honest, kind):
    """Questions about a whole district of tiles, or about 64 reports, come 300 times a second: askers take turns."""
    with flooding(cloud, kind, 300.0):
        honest.is_served()


@pytest.mark.parametrize("kind", ["regions", "catalogs"])
def test_attack_questions_about_regions(cloud, honest, kind):
    """Somebody asks for the whole world 100 times a second: regions have a thread and a short mailbox of their own."""
    with flooding(cloud, kind, 100.0):
        honest.is_served()


def test_attack_gaussians_without_flags(cloud, honest, street):
    """Gaussians of reports that nobody has sent would wait for their flags for ever: so few a minute are kept."""
    key = street.said(1, "x", 0).key
    with zenoh.open(zenoh_config(BusConfig(connect=(cloud.connect,)))) as session:
        for n in range(1500):
            body = PackedGaussians(deterministic_report_id(1_700_000_000_000 + n, "nobody"), bytes(40), 7).encode()
            session.get(key, zenoh.handlers.Callback(lambda _reply: None), payload=body, timeout=2.0)
        honest.is_served()
        time.sleep(1.0)
    assert cloud.store.upload_counts().by_state.get("early", 0) <= REPORTS_AT_ONCE


# Work


def bomb() -> bytes:
    """A report whose bitmap of observed voxels unpacks to 200 MB, out of 200 kB."""
    message = change_report_pb2.ChangeReport()
    message.ParseFromString(replace(change_report(1, base_tile()), vehicle=HONEST).encode())
    message.report_id = deterministic_report_id(1_700_000_000_000, "bomb")
    (tile,) = message.tiles
    field = next(one.name for one, value in tile.ListFields() if isinstance(value, bytes) and value[:1] == b"\x78")
    setattr(tile, field, zlib.compress(bytes(200_000_000), 9))
    return bytes(message.SerializeToString())


def test_attack_decompression_bomb(cloud, honest):
    """200 kB that unpack to 200 MB: no more is unpacked than a bitmap may have, and the report is refused."""
    body = bomb()
    ack = honest.send(change_key("ndt", TILE.district), body)
    assert ack.status in ("stored", "duplicate"), ack
    wait_for(lambda: any("unpacks to more than" in one.reason for one in quarantined(cloud)), "the bomb is refused")
    pids = cloud.supervisor.pids()
    assert all(resident_mb(pids[name]) < 1500 for name in ("merger-0", "store"))
    honest.is_served()


def resident_mb(pid: int) -> float:
    pages = Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1]
    return int(pages) * os.sysconf("SC_PAGE_SIZE") / 1e6


def heavy(street: ChaosStreet, tiles: int, pieces: int, top: int, far: int) -> tuple[str, PackedReport]:
    """A small report that costs much to understand: few flags over many tiles, floors and pieces of way."""
    district = street.copies[0][0].tile_id.district
    near = {one for tile in street.copies[0] for one in square(tile.tile_id, 3) if one.district == district}
    chosen, told = sorted(near)[:tiles], []
    for tile_id in chosen:
        grid = VoxelGrid.of(tile_id)
        ids = np.unique(grid.voxel_id(np.array([0, 1]), np.array([0, 1]), np.array([0, top]))).astype(np.int32)
        told.append(Flags(tile_id, Gaussians.empty(), ids, np.ones(len(ids), np.uint8)))
    view = street.told[0].track.view
    way = tuple(TrackPiece(np.array([[4 * k, 64, 0], [4 * k + far, 64, 0]], np.int32), 1000) for k in range(pieces))
    packed = replace(
        street.said(1, "x", 0).packed,
        report_id=deterministic_report_id(1_700_000_000_000, "heavy", str(tiles), str(pieces), str(top), str(far)),
        vehicle="heavy",
        tiles=tuple((tile_id.morton - district.first_morton, 0) for tile_id in chosen),
        base_digest=digest_of([b""] * len(chosen)),
        flags=encode_flags(told),
        track=encode_track(Track(district, view, way)),
        doubts=(),
    )
    return change_key("ndt", district), packed


@pytest.mark.parametrize(
    ("tiles", "pieces", "top", "far"), [(128, 200, 1, 0), (400, 4, 200, 0), (64, 100, 2, 2_000), (4, 4, 900, 0)]
)
def test_attack_small_reports_that_cost_much(cloud, honest, street, monkeypatch, tiles, pieces, top, far):
    """Many pieces, volumes, ways or floors in a small report: refused with the limit before they are looked along."""
    with monkeypatch.context() as of_attacker:
        of_attacker.setattr("gnd.gnd_map.codec.volume.MAX_MESSAGE_VOLUME", 1 << 30)
        key, packed = heavy(street, tiles, pieces, top, far)
    ids = {deterministic_report_id(1_700_000_000_000, packed.report_id, str(n)) for n in range(20)}
    for report_id in ids:
        assert honest.send(key, replace(packed, report_id=report_id).encode()).status in ("stored", "duplicate")
    honest.hears(honest.reports())
    wait_for(lambda: not any(one.state == "waiting" for one in states_of(cloud, ids)), "all are looked at")
    assert len(states_of(cloud, ids)) == len(ids)
    assert all(one.state == "quarantined" and "limit" in one.reason for one in states_of(cloud, ids))


def states_of(cloud: SmallCloud, ids: set[str]) -> list[UploadStatus]:
    return cloud.store.upload_statuses("heavy", sorted(ids))


# Connections


def held(endpoint: str, n: int, first: bytes = b"", host: str = "127.0.0.1") -> list[socket.socket]:
    port, found = int(endpoint.rpartition(":")[2]), []
    for _ in range(n):
        with suppress(OSError):
            one = socket.create_connection(("127.0.0.1", port), timeout=5.0, source_address=(host, 0))
            one.sendall(first)
            found.append(one)
    return found


def is_open(one: socket.socket) -> bool:
    one.setblocking(False)
    try:
        return one.recv(1) != b""
    except BlockingIOError:
        return True
    except OSError:
        return False


def open_ones(sockets: list[socket.socket]) -> int:
    return sum(is_open(one) for one in sockets)


def close_all(sockets: list[socket.socket]) -> None:
    for one in sockets:
        one.close()


def newcomer_is_served(cloud: SmallCloud, honest: Honest) -> None:
    with open_bus(BusConfig(connect=(cloud.connect,), open_timeout_s=10.0), name="newcomer") as bus:
        Honest(bus, cloud.store, honest.street).is_served()


def test_attack_idle_connections(cloud, honest):
    """1,500 connections that never say a word: the oldest are closed, a new client comes in."""
    sockets = held(cloud.connect, 1500)
    try:
        newcomer_is_served(cloud, honest)
        wait_for(lambda: open_ones(sockets) <= USUAL_LIMITS.handshakes, "most are closed")
        wait_for(lambda: open_ones(sockets) == 0, "all are closed")
    finally:
        close_all(sockets)


def test_attack_slow_loris(cloud, honest):
    """300 connections that send a byte a second of a handshake: closed when its time is over, however they go on."""
    sockets = held(cloud.connect, 300, b"\x40")
    stop = threading.Event()

    def drip() -> None:
        while not stop.wait(1.0):
            for one in sockets:
                with suppress(OSError):
                    one.send(b"\x00")

    dripping = threading.Thread(target=drip)
    dripping.start()
    try:
        newcomer_is_served(cloud, honest)
        wait_for(lambda: open_ones(sockets) == 0, "all are closed")
    finally:
        stop.set()
        dripping.join()
        close_all(sockets)


def test_attack_connections_of_one_address(free_port, monkeypatch):
    """One address opens session after session: beyond its share they are closed, and another address comes in."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with open_router([endpoint], limits=replace(USUAL_LIMITS, of_address=20)):
        sockets = held(endpoint, 60, host="127.0.0.2")
        wait_for(lambda: open_ones(sockets) <= 20, "those beyond the share are closed")
        with open_bus(BusConfig(connect=(endpoint,)), name="honest") as bus:
            bus.serve("limits/echo", lambda request: request.payload)
            assert bus.request("limits/echo", b"here", kind="control", timeout_s=20.0) == b"here"
        close_all(sockets)


def certificate(folder) -> tuple[str, str]:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    key, name = ec.generate_private_key(ec.SECP256R1()), x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "router")])
    now = dt.datetime.now(dt.UTC)
    signed = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - dt.timedelta(hours=1))
        .not_valid_after(now + dt.timedelta(hours=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False)
        .sign(key, hashes.SHA256())
    )
    (folder / "key.pem").write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    (folder / "certificate.pem").write_bytes(signed.public_bytes(serialization.Encoding.PEM))
    return str(folder / "certificate.pem"), str(folder / "key.pem")


def test_attack_half_open_tls(tmp_path, free_port):
    """300 TLS handshakes that stop half way, or never begin: closed in time; a client comes in meanwhile."""
    signed, key = certificate(tmp_path)
    settings = zenoh_config(BusConfig(mode="router", connect=(), listen=(f"tcp/127.0.0.1:{free_port}",)))
    settings.insert_json5("listen/endpoints", json.dumps([f"tls/localhost:{free_port}"]))
    settings.insert_json5("transport/link/tls/listen_certificate", json.dumps(signed))
    settings.insert_json5("transport/link/tls/listen_private_key", json.dumps(key))
    hello = _client_hello()
    with zenoh.open(settings) as router, ExitStack() as stack:
        guard = ConnectionGuard([free_port], partial(_peers, router), replace(USUAL_LIMITS, handshake_s=2.0))
        stack.callback(guard.close)
        sockets = [*held(f"tls/127.0.0.1:{free_port}", 150), *held(f"tls/127.0.0.1:{free_port}", 150, hello)]
        stack.callback(close_all, sockets)
        client = zenoh.Config()
        client.insert_json5("mode", '"client"')
        client.insert_json5("connect/endpoints", json.dumps([f"tls/localhost:{free_port}"]))
        client.insert_json5("scouting/multicast/enabled", "false")
        client.insert_json5("transport/link/tls/root_ca_certificate", json.dumps(signed))
        opened = _opened_within(client, 30.0)
        stack.callback(opened.close)
        assert opened.info.routers_zid()
        wait_for(lambda: not sum(_reads_nothing(one) for one in sockets), "all are closed")
        assert opened.info.routers_zid(), "a session is none of them"


def _client_hello() -> bytes:
    """The first message of a TLS handshake, of which nothing follows."""
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    shake = context.wrap_bio(incoming, outgoing, server_hostname="localhost")
    with suppress(ssl.SSLWantReadError):
        shake.do_handshake()
    return outgoing.read()


def _reads_nothing(one: socket.socket) -> bool:
    """Whether a connection is still open, whatever it was sent."""
    one.setblocking(False)
    try:
        while one.recv(65536):
            pass
    except BlockingIOError:
        return True
    except OSError:
        pass
    return False


def _peers(router: zenoh.Session) -> set[tuple[str, int]]:
    return {_peer(link.dst) for link in router.info.links()}


def _peer(locator: str) -> tuple[str, int]:
    host, _, port = locator.partition("/")[2].partition("#")[0].partition("?")[0].rpartition(":")
    return host.strip("[]"), int(port)


def _opened_within(settings: zenoh.Config, seconds: float) -> zenoh.Session:
    until_s = time.monotonic() + seconds
    while True:
        try:
            return zenoh.open(settings)
        except zenoh.ZError:
            if time.monotonic() > until_s:
                raise


def test_attack_subscriber_that_does_not_read(cloud, honest):
    """A subscriber of everything is stopped: the others hear of each version, and nobody waits for it."""
    code = (
        "import sys, time\nfrom gnd.fleet_bus.bus import open_bus\nfrom gnd.fleet_bus.config import BusConfig\n"
        "bus = open_bus(BusConfig(connect=(sys.argv[1],)))\n"
        "bus.subscribe('gnd/v1/**', lambda *_: None)\nprint('ready', flush=True)\ntime.sleep(600)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code, cloud.connect], stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        process.send_signal(signal.SIGSTOP)
        heard: set[str] = set()
        honest.bus.subscribe(update_keys("ndt"), lambda key, _payload: heard.add(key))
        for n in range(60):
            cloud.publish(n)
        honest.is_served()
        wait_for(lambda: len(heard) >= len(cloud.base), "notices of all tiles")
    finally:
        process.kill()
        process.communicate()


# Ownership and waiting


def test_attack_ghost_tokens(cloud, honest, street):
    """30 tokens of shards that do not exist: who does not give a sign of life in the store owns no district."""
    names = tuple(f"ghost-{n}" for n in range(30))
    cloud.supervisor.start(ProcessSpec("ghosts", ghosts, (cloud.connect, names), restart=False))
    seen: set[str] = set()
    honest.bus.watch_alive(f"{ROOT}/alive/merger/*", lambda key, alive: seen.add(key) if alive else None)
    wait_for(lambda: len(seen) >= len(names), "the ghosts are seen")
    try:
        for copy in street.copies:
            key = change_key("ndt", copy[0].tile_id.district)
            one = next(report for n in range(50) if (report := street.said(3, HONEST, n)).key == key)
            assert honest.send(key, one.packed.encode()).status in ("stored", "duplicate")
        honest.is_served()
    finally:
        cloud.supervisor.stop(("ghosts",))


def test_attack_that_says_busy_for_ever(free_port):
    """A handler says "retry after" a billion seconds: no client waits longer than a minute for it."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with open_router([endpoint]), open_bus(BusConfig(connect=(endpoint,))) as liar:

        def busy(_request):
            raise Busy("for ever", 1e9, "test")

        liar.serve("limits/busy", busy)
        with (
            open_bus(BusConfig(connect=(endpoint,))) as bus,
            pytest.raises(RequestFailed, match="busy: for ever") as info,
        ):
            bus.request("limits/busy", b"", kind="control", timeout_s=2.0)
    assert info.value.retry_after_s <= LONGEST_BUSY_S


def test_attack_herd_after_a_restart(cloud, honest):
    """The router is killed under 40 sessions that all ask at once: each is answered, and they do not come in step."""
    with ExitStack() as stack:
        buses = [stack.enter_context(open_bus(BusConfig(connect=(cloud.connect,)))) for _ in range(40)]
        cloud.supervisor.kill("router")
        answered: list[float] = []

        def ask(bus) -> None:
            Honest(bus, cloud.store, honest.street).fetches()
            answered.append(time.monotonic())

        threads = [threading.Thread(target=ask, args=(bus,)) for bus in buses]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert len(answered) == 40
    assert max(answered) > min(answered)
    honest.is_served()


# What zenoh itself lets anybody do


@contextmanager
def pestering(cloud: SmallCloud, attack: Callable[[zenoh.Session, int], object], most: int = 20_000) -> Iterator[None]:
    """A session of an attacker does it again and again, as fast as it can, while the block runs."""
    stop, begun = threading.Event(), threading.Event()

    def run() -> None:
        with zenoh.open(zenoh_config(BusConfig(connect=(cloud.connect,)))) as session:
            for n in range(most):
                if stop.is_set():
                    return
                attack(session, n)
                if n == 20:
                    begun.set()

    thread = threading.Thread(target=run)
    thread.start()
    try:
        assert begun.wait(60.0)
        yield
    finally:
        stop.set()
        thread.join()


def asks(session: zenoh.Session, key: str, payload: bytes = b"", **options: Any) -> None:
    """A question whose answer nobody reads."""
    session.get(key, lambda _reply: None, **{"payload": payload, "timeout": 2.0} | options)


def grown_mb(cloud: SmallCloud, before: dict[str, float]) -> float:
    """How much the parts of the cloud have grown since, the most of one."""
    return max(resident_mb(cloud.pid(name)) - before[name] for name in before)


def sizes(cloud: SmallCloud) -> dict[str, float]:
    return {name: resident_mb(cloud.pid(name)) for name in ("router", "store", "merger-0")}


@pytest.mark.parametrize(
    "key",
    [f"{ROOT}/tile/ndt/**", f"{ROOT}/change/**", f"{ROOT}/state/*", f"{ROOT}/*/ndt/*/*", "**", f"{ROOT}/catalog/*/**"],
)
def test_attack_questions_with_wildcards(cloud, honest, key):
    """Small questions about everything at once: one thread and 64 places for all of them."""
    with pestering(cloud, lambda session, _n: asks(session, key)):
        honest.is_served()


def test_attack_huge_keys(cloud, honest):
    """Each question has another key of 30,000 characters: nobody keeps them, not even to serve askers in turn."""
    before = sizes(cloud)
    kinds = itertools.cycle(("tile/ndt", "change/ndt", "state", "catalog/ndt"))
    with pestering(cloud, lambda session, n: asks(session, f"{ROOT}/{next(kinds)}/{30_000 * 'x'}/{n}"), most=2_000):
        honest.is_served()
    assert grown_mb(cloud, before) < 300


def test_attack_questions_that_wait_for_ever(cloud, honest):
    """Questions with a timeout of years on keys that nobody serves, and on those of tiles: nothing piles up."""
    keys = (f"{ROOT}/nobody/serves/this", tile_key("ndt", TILE))
    with pestering(cloud, lambda session, n: asks(session, keys[n % 2], timeout=1e8), most=4_000):
        honest.is_served()


def test_attack_odd_attachments(cloud, honest):
    """Attachments of 200 kB, of the form of seals, of what counts answers: not read where nobody needs them."""
    odd = (bytes(200_000), MARK + bytes(100), MARK + random.Random(3).randbytes(50_000), COUNT_WANTED * 1000)
    key = change_key("ndt", TILE.district)
    with pestering(cloud, lambda session, n: asks(session, key, b"report", attachment=odd[n % len(odd)]), 1_500):
        honest.is_served()


def test_attack_in_the_lane_of_control(cloud, honest):
    """1,500 messages in zenoh's most urgent lane, 100 kB each, as fast as they go: others are served all the same."""
    key, body = change_key("ndt", TILE.district), bytes(100_000)
    with pestering(cloud, lambda session, _n: asks(session, key, body, priority=zenoh.Priority.REAL_TIME), 1_500):
        honest.is_served()


def test_attack_subscribers_come_and_go(cloud, honest):
    """Somebody subscribes to everything and leaves, again and again."""
    with pestering(cloud, lambda session, _n: session.declare_subscriber("gnd/v1/**", lambda _: None).undeclare()):
        honest.is_served()
        cloud.publish(1)


def test_attack_queryables_come_and_go(cloud, honest):
    """Somebody offers to answer on thousands of keys, and takes it back."""

    def offers(session: zenoh.Session, n: int) -> None:
        session.declare_queryable(f"{ROOT}/tile/ndt/offered/{n}", lambda query: query.drop()).undeclare()

    with pestering(cloud, offers):
        honest.is_served()


def test_attack_tokens_come_and_go(cloud, honest):
    """Tokens of shards that do not exist, and with names as no shard has: nobody waits for one of them."""
    names = itertools.cycle(("ghost", 300 * "g", "shard-1", "@", "shard-0"))

    def appears(session: zenoh.Session, n: int) -> None:
        session.liveliness().declare_token(f"{ROOT}/alive/merger/{next(names)}{n % 7}").undeclare()

    with pestering(cloud, appears):
        honest.is_served()


def test_attack_sessions_come_and_go(cloud, honest):
    """Sessions are opened and closed as fast as one can: the router takes others in meanwhile."""
    stop, opened = threading.Event(), list[int]()

    def comes_and_goes() -> None:
        while not stop.is_set():
            zenoh.open(zenoh_config(BusConfig(connect=(cloud.connect,)))).close()
            opened.append(1)

    threads = [threading.Thread(target=comes_and_goes) for _ in range(4)]
    for thread in threads:
        thread.start()
    try:
        wait_for(lambda: len(opened) > 20, "sessions have come and gone")
        newcomer_is_served(cloud, honest)
        honest.is_served()
    finally:
        stop.set()
        for thread in threads:
            thread.join()


def test_attack_puts_of_health_and_traffic(cloud, honest):
    """Telemetry without end, and too large: the router lets none of the large in, and nobody waits for the small."""
    before = sizes(cloud)
    bodies = (bytes(4_000_000), random.Random(5).randbytes(16_000), b"")

    def puts(session: zenoh.Session, n: int) -> None:
        session.put((health_key, traffic_key)[n % 2](f"liar-{n}"), bodies[n % len(bodies)])

    with pestering(cloud, puts, most=600):
        honest.is_served()
    assert grown_mb(cloud, before) < 300


def test_attack_states_a_thousand_times_a_second(cloud, honest):
    """A vehicle asks after 64 reports 1,000 times a second."""
    with flooding(cloud, "states", 1000.0):
        honest.hears(honest.reports())


def test_attack_asker_that_does_not_read(cloud, honest):
    """A program sends thousands of questions about a whole district and is stopped: its answers hold nobody up."""
    code = (
        "import sys\nfrom gnd.fleet_bus.bus import open_bus\nfrom gnd.fleet_bus.config import BusConfig\n"
        "from studies.flooding import messages\nfrom gnd.gnd_map.tile_id import TileId\n"
        "bus = open_bus(BusConfig(connect=(sys.argv[1],)))\nsource = messages('tiles', TileId(int(sys.argv[2])))\n"
        "print('ready', flush=True)\n"
        "for n in range(1_000_000):\n"
        "    key, payload = next(source)\n"
        "    bus.connection.session.get(key, lambda _reply: None, payload=payload, timeout=600.0)\n"
    )
    command = [sys.executable, "-c", code, cloud.connect, str(TILE.morton)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        time.sleep(0.5)
        process.send_signal(signal.SIGSTOP)
        honest.is_served()
    finally:
        process.kill()
        process.communicate()


# Reports that are odd, and legal


def sends(honest: Honest, report: ChangeReport, key: str = "") -> str:
    """The status of its acknowledgement."""
    return honest.send(key or change_key(report.layer, report.district), report.encode()).status


def odd_report(number: int, vehicle: str, **changes: Any) -> ChangeReport:
    report_id = deterministic_report_id(1_700_000_000_000 + number, "odd", vehicle, str(number))
    return replace(change_report(number, base_tile()), report_id=report_id, vehicle=vehicle, **changes)


def test_attack_stolen_report_ids(cloud, honest):
    """Another vehicle has sent a report under each id that the honest one uses: both are kept, neither is lost."""
    for number in range(5):
        stolen = odd_report(number, "thief")
        assert sends(honest, stolen) == "stored"
        assert sends(honest, replace(stolen, vehicle=HONEST)) == "stored"
        honest.hears(stolen.report_id)


@pytest.mark.parametrize("skew_s", [1e9, 600.0, -1.7e9, -3600.0])
def test_attack_wrong_clocks(cloud, honest, skew_s):
    """Reports of the future are refused with the number, those of the past are taken; neither disturbs the others."""
    last_ns = max(1, time.time_ns() + round(skew_s * 1e9))
    for number in range(2 if skew_s > 0 else 5):
        report = odd_report(number + round(abs(skew_s)) % 9_000, "clock", first_ns=last_ns - 1, last_ns=last_ns)
        try:
            status = sends(honest, report)
        except RequestFailed:  # busy: so many that cannot be kept have been refused already
            status = "quarantined"
        assert status == ("quarantined" if skew_s > 300 else "stored")
    honest.hears(honest.reports())


def test_attack_one_voxel_in_each_of_many_tiles(cloud, honest):
    """Reports about 1,024 tiles each, one voxel in each of them: most are not on the map, and the report is refused."""
    one = base_tile().gaussians.take(np.arange(1))
    (change,) = change_report(1, base_tile()).tiles
    tiles = tuple(
        replace(
            change,
            tile=TileId(TILE.district.first_morton + n),
            base_version=0,
            base_sha=b"",
            observed=one.voxel_id,
            changed=one,
            change_class=change.change_class[:1],
            evidence=change.evidence[:1],
        )
        for n in range(1024)
    )
    for number in range(10):
        assert sends(honest, odd_report(number, "wide", tiles=tiles)) == "stored"
    honest.hears(honest.reports())
    wait_for(lambda: waiting(cloud, "wide") == 0, "all are looked at")
    assert any("is not on the map" in one.reason for one in quarantined(cloud))


def test_attack_layers_that_take_turns(cloud, honest):
    """Each report is about another layer that no map has: none of them is merged, and no layer comes to be."""
    for number in range(20):
        layer = f"ndt_{number}"
        assert sends(honest, odd_report(number, "layers", layer=layer)) == "stored"
    honest.hears(honest.reports())
    wait_for(lambda: waiting(cloud, "layers") == 0, "all are looked at")
    assert not any(list(cloud.store.heads(f"ndt_{number}", TILE.district.path)) for number in range(20))


def test_attack_halves_that_never_become_whole(cloud, honest, street):
    """60 reports in short whose Gaussians never come: they wait for them, and nobody else does."""
    for number in range(60):
        one = street.said(9, "half", number)
        assert honest.send(one.key, one.packed.encode()).status in ("stored", "duplicate")
    honest.hears(honest.reports())


def test_attack_flags_and_gaussians_of_nobody_in_turn(cloud, honest, street):
    """Gaussians that nobody asked for, under the ids of flags that came: refused, and the flags stay as they were."""
    for number in range(20):
        one = street.said(10, "mixed", number)
        assert honest.send(one.key, one.packed.encode()).status in ("stored", "duplicate")
        body = PackedGaussians(one.packed.report_id, bytes(400), 7).encode()
        assert honest.send(one.key, body).status in ("stored", "duplicate")
    honest.hears(honest.reports())
    ids = [street.said(10, "mixed", number).packed.report_id for number in range(20)]

    def states() -> set[str]:
        return {one.state for one in cloud.store.upload_statuses("mixed", ids)}

    wait_for(lambda: "waiting" not in states(), "both halves of all are looked at")
    assert states() <= {"wanted", "released", "resend"}


@pytest.mark.parametrize("field", ["flags", "track", "base_digest", "sensor_model", "software"])
def test_attack_garbage_that_unpacks(cloud, honest, street, field):
    """Each part of a report in short holds what unpacks to far more than it is: refused for what it costs or says."""
    packed = street.said(1, "garbage", 0).packed
    fillings = bytes(300_000), zlib.compress(bytes(50_000_000), 9), 100_000 * b"\x28\xb5\x2f\xfd"
    for number, filling in enumerate(fillings):
        message = change_report_pb2.ChangeReport.FromString(packed.encode())
        is_text = isinstance(getattr(message.packed, field), str)
        setattr(message.packed, field, filling.decode("latin-1") if is_text else filling)
        report_id = deterministic_report_id(1_700_000_000_000 + number, "garbage", field)
        message.packed.report_id = ULID.from_str(report_id).bytes
        ack = honest.send(street.said(1, "garbage", 0).key, message.SerializeToString())
        assert ack.status in ("stored", "quarantined", "duplicate")
    honest.hears(honest.reports())
    wait_for(lambda: waiting(cloud, "garbage") == 0, "all are looked at")
    assert resident_mb(cloud.pid("merger-0")) < 1500


def test_attack_reports_as_expensive_as_they_may_be(cloud, honest):
    """A vehicle sends the dearest reports that are taken: those of others are looked at in between."""
    sizes = {"tiles": 8, "changed": 20_000, "observed": 80_000, "top": 400, "held": 1}
    for _ in range(30):
        assert honest.send(*dearest_report(sizes)).status == "stored"
    honest.hears(honest.reports())
    wait_for(lambda: waiting(cloud, "dear") == 0, "all are looked at")


def test_attack_invented_names_while_a_newcomer_comes(cloud, honest):
    """While a known vehicle reports, 200 reports a second have a new name each: few of them are taken, and a true new
    vehicle, which comes again when it is told to, is let in within the time that it is told."""
    honest.becomes_known()
    before, began_s = sum(cloud.store.upload_counts().by_state.values()), time.monotonic()
    with flooding(cloud, "names", 200.0, for_s=2.0), open_bus(BusConfig(connect=(cloud.connect,)), name="new") as bus:
        honest.is_served()
        newcomer = Honest(bus, cloud.store, honest.street, vehicle=f"newcomer-{os.getpid()}")
        asked_s = time.monotonic()
        newcomer.reports()
        assert time.monotonic() - asked_s < BUSY_SPREAD * WAITING_RETRY_S + 10.0
        honest.is_served()
    taken = sum(cloud.store.upload_counts().by_state.values()) - before
    minutes = (time.monotonic() - began_s) / 60.0
    assert taken <= FIRST_NAMES_AT_ONCE + minutes * (FIRST_NAMES_A_MINUTE + AGAIN_A_MINUTE) + 20
