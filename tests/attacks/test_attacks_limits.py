"""Programs that send too much, too slowly, or what costs too much: an honest client is still served, and what is
bounded stays bounded.
"""

import datetime as dt
import json
import os
import signal
import socket
import ssl
import subprocess
import sys
import threading
import time
import zlib
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import zenoh
from limits_scene import HONEST, Honest, flooding, store_bytes, wait_for

from gnd.cloud_merger.admission import NONSENSE_AT_ONCE, REPORTS_AT_ONCE, WAITING_OF_ALL, WAITING_OF_VEHICLE
from gnd.deploy.chaos.street import ChaosStreet, read_street
from gnd.deploy.processes import ProcessSpec
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig, zenoh_config
from gnd.fleet_bus.errors import Busy, RequestFailed
from gnd.fleet_bus.guard import USUAL_LIMITS, ConnectionGuard
from gnd.fleet_bus.requesting import LONGEST_BUSY_S
from gnd.fleet_bus.router import open_router
from gnd.fleet_bus.seldom import LINES_A_MINUTE, MAX_LINE_CHARACTERS
from gnd.gnd_map.codec import Flags, encode_flags
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile_id import TileId
from gnd.gnd_map.track import Track, TrackPiece, encode_track
from gnd.schemas.generated import change_report_pb2
from gnd.schemas.keys import ROOT, change_key, update_keys
from gnd.schemas.packed import PackedGaussians, PackedReport, digest_of
from gnd.schemas.report_id import deterministic_report_id
from gnd.tile_store.uploads import UploadStatus
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
    told = []
    for index in range(tiles):
        tile_id = TileId(district.first_morton + index)
        grid = VoxelGrid.of(tile_id)
        ids = np.unique(grid.voxel_id(np.array([0, 1]), np.array([0, 1]), np.array([0, top]))).astype(np.int32)
        told.append(Flags(tile_id, Gaussians.empty(), ids, np.ones(len(ids), np.uint8)))
    view = street.told[0].track.view
    way = tuple(TrackPiece(np.array([[4 * k, 64, 0], [4 * k + far, 64, 0]], np.int32), 1000) for k in range(pieces))
    packed = replace(
        street.said(1, "x", 0).packed,
        report_id=deterministic_report_id(1_700_000_000_000, "heavy", str(tiles), str(pieces), str(top), str(far)),
        vehicle="heavy",
        tiles=tuple((index, 0) for index in range(tiles)),
        base_digest=digest_of([b""] * tiles),
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
