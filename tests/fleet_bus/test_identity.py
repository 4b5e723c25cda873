"""Identity folders, the authority and its register, causes of failed handshakes, and renewal in a running session."""

import json
import logging
import shutil
import socket
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from click.testing import CliRunner
from prometheus_client import CollectorRegistry, generate_latest
from suite_ports import new_port

from gnd.deploy.certs_cli import certs
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.certificate_metrics import certificate_checks, register_certificate
from gnd.fleet_bus.config import PLAIN_VARIABLE, BusConfig
from gnd.fleet_bus.errors import BusConfigError, IdentityError
from gnd.fleet_bus.gate import SecureRouter
from gnd.fleet_bus.identity.authority import REGISTER, Authority
from gnd.fleet_bus.identity.cause import why_not
from gnd.fleet_bus.identity.folder import load_identity, problems
from gnd.fleet_bus.identity.lists import MemberList, load_revoked
from gnd.fleet_bus.identity.names import MemberName
from gnd.fleet_bus.identity.renewal import CertificateWatch
from gnd.fleet_bus.router_metrics import watch_router

VEHICLE, ROUTER, STORE = MemberName("vehicle", "v-1"), MemberName("router", "r"), MemberName("tiles", "store")
TILE = "gnd/v1/tile/ndt/13033/03021/21000/00000"


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return Authority.create(tmp_path / "authority", "tests")


def test_an_identity_folder_holds_what_was_issued(authority: Authority, tmp_path: Path) -> None:
    authority.issue(VEHICLE, tmp_path / "v", owner="Example Cars")
    identity = load_identity(tmp_path / "v")
    assert (identity.role, identity.name, identity.owner) == ("vehicle", "v-1", "Example Cars")
    assert 6.9 * 86_400 < identity.left_s() <= 7 * 86_400
    assert problems(identity) == []
    assert not identity.ends_soon()
    assert stat.S_IMODE((tmp_path / "v" / "key.pem").stat().st_mode) == 0o600
    assert stat.S_IMODE((authority.folder / "key.pem").stat().st_mode) == 0o600


def test_register_and_lists_follow_what_happens(authority: Authority, tmp_path: Path) -> None:
    authority.issue(VEHICLE, tmp_path / "v")
    authority.issue(STORE, tmp_path / "s")
    first = MemberList.decode(authority.lists()[0], (authority.certificate,))
    assert first.members == {VEHICLE, STORE}
    authority.revoke(VEHICLE)
    again = Authority(authority.folder)
    assert [bool(entry.revoked) for entry in again.entries()] == [True, False]
    second = MemberList.decode(again.lists()[0], (again.certificate,))
    assert (second.members, second.revoked) == ({STORE}, {"vehicle.v-1"})
    assert second.number > first.number
    listed = load_revoked(again.lists()[1], (again.certificate,))
    assert [one.serial_number for one in listed] == [load_identity(tmp_path / "v").certificate.serial_number]
    with pytest.raises(IdentityError, match="is shut out until"):
        again.issue(VEHICLE, tmp_path / "w")
    with pytest.raises(IdentityError, match="no certificate that holds"):
        again.revoke(VEHICLE)


def test_a_register_that_was_cut_off_keeps_what_is_whole(authority: Authority, tmp_path: Path) -> None:
    authority.issue(STORE, tmp_path / "s")
    path = authority.folder / REGISTER
    path.write_bytes(path.read_bytes() + b'{"serial": "12')
    again = Authority(authority.folder)
    again.issue(VEHICLE, tmp_path / "v")
    assert [entry.member for entry in Authority(authority.folder).entries()] == [STORE, VEHICLE]
    path.write_bytes(b"no entry\n" + path.read_bytes())
    with pytest.raises(IdentityError, match="line 1 is no entry"):
        Authority(authority.folder)


@pytest.mark.parametrize("name", ["", "a/b", "*", "a*", "$x", "x" * 56, ".x", "a b", "ä"])
def test_names_that_are_no_chunk_of_a_key_are_refused(name: str) -> None:
    with pytest.raises(IdentityError):
        MemberName("vehicle", name)


def test_a_folder_of_another_member_is_not_overwritten(authority: Authority, tmp_path: Path) -> None:
    authority.issue(VEHICLE, tmp_path / "v")
    with pytest.raises(IdentityError, match=r"is the identity of vehicle\.v-1"):
        authority.issue(STORE, tmp_path / "v")
    with pytest.raises(IdentityError, match="holds an authority already"):
        Authority.create(authority.folder, "again")


def test_plain_endpoints_beyond_this_machine_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(PLAIN_VARIABLE, raising=False)
    for endpoint in ("tcp/127.0.0.1:7447", "tcp/localhost:7447", "tcp/[::1]:7447"):
        BusConfig(connect=(endpoint,))
    for endpoint in ("tcp/0.0.0.0:7447", "tcp/10.0.0.1:7447", "udp/map.example.org:7447", "tcp/[::]:7447"):
        with pytest.raises(BusConfigError, match=PLAIN_VARIABLE):
            BusConfig(connect=(endpoint,))
    monkeypatch.setenv(PLAIN_VARIABLE, "1")
    BusConfig(connect=("tcp/10.0.0.1:7447",))


def test_a_process_without_identity_loads_no_cryptography() -> None:
    code = (
        "import sys; from gnd.fleet_bus import BusConfig, open_bus; import gnd.vehicle_agent.cli, gnd.fleet_bus.router;"
        "BusConfig(); sys.exit('cryptography' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


@pytest.fixture
def running(authority: Authority, tmp_path: Path) -> Iterator[str]:
    """Endpoint of a router with rights, in this process."""
    for member, name in ((ROUTER, "r"), (VEHICLE, "v"), (STORE, "s")):
        authority.issue(member, tmp_path / name)
    authority.copy_lists([tmp_path / "r"])
    endpoint = f"tls/127.0.0.1:{new_port()}"
    with SecureRouter((endpoint,), (), tmp_path / "r"):
        yield endpoint


def test_causes_are_named(authority: Authority, running: str, tmp_path: Path) -> None:
    folder = tmp_path / "v"
    assert why_not(running, folder) == ""
    foreign = Authority.create(tmp_path / "foreign", "foreign")
    foreign.issue(VEHICLE, tmp_path / "x")
    assert "does not come from our authority" in why_not(running, tmp_path / "x")
    both = tmp_path / "x" / "authority.pem"
    both.write_bytes(both.read_bytes() + (folder / "authority.pem").read_bytes())
    assert "authority that is trusted there" in why_not(running, tmp_path / "x")
    assert "nothing listens" in why_not(f"tls/127.0.0.1:{new_port()}", folder)
    assert "cannot be resolved" in why_not("tls/no-such-host.invalid:7447", folder)
    shutil.rmtree(tmp_path / "x")
    assert "cannot read" in why_not(running, tmp_path / "x")
    authority.revoke(VEHICLE)
    authority.copy_lists([folder])
    assert "was revoked by its authority" in why_not(running, folder)


def test_a_port_without_tls_is_named(authority: Authority, tmp_path: Path) -> None:
    authority.issue(VEHICLE, tmp_path / "v")
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            end, _ = server.accept()
            with end:
                end.recv(100)
                end.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")

        threading.Thread(target=answer, daemon=True).start()
        assert why_not(f"tls/127.0.0.1:{server.getsockname()[1]}", tmp_path / "v") == "there is no TLS at that port"


@pytest.mark.slow
def test_a_renewed_certificate_is_taken_by_a_running_client(authority: Authority, running: str, tmp_path: Path) -> None:
    config = BusConfig(connect=(running,), identity=tmp_path / "v")
    with open_bus(BusConfig(connect=(running,), identity=tmp_path / "s")) as store, open_bus(config) as vehicle:
        store.serve("gnd/v1/tile/**", lambda request: request.payload)
        before = load_identity(tmp_path / "v").certificate
        for n in range(60):
            assert vehicle.request(TILE, b"%d" % n, kind="tile", timeout_s=20) == b"%d" % n
            if n == 10:
                authority.renew(tmp_path / "v")
            time.sleep(0.15)
        assert vehicle.connections == 2
        assert vehicle.certificate is not None
        assert vehicle.certificate.identity.certificate != before


@pytest.mark.slow
def test_sessions_of_a_router_take_over_from_each_other(authority: Authority, tmp_path: Path) -> None:
    """Six new members, one after the other: the clients of the oldest sessions are sent to the newest, and go on."""
    for member, name in ((ROUTER, "r"), (VEHICLE, "v"), (STORE, "s")):
        authority.issue(member, tmp_path / name)
    authority.copy_lists([tmp_path / "r"])
    endpoint = f"tls/127.0.0.1:{new_port()}"
    with SecureRouter((endpoint,), (), tmp_path / "r") as router, ExitStack() as stack:
        pages = stack.enter_context(watch_router(router, 0, "127.0.0.1"))
        store = stack.enter_context(open_bus(BusConfig(connect=(endpoint,), identity=tmp_path / "s")))
        first = stack.enter_context(open_bus(BusConfig(connect=(endpoint,), identity=tmp_path / "v")))
        store.serve("gnd/v1/tile/**", lambda request: request.payload)
        for n in range(6):
            authority.issue(MemberName("vehicle", f"new-{n}"), tmp_path / f"new-{n}")
            authority.copy_lists([tmp_path / "r"])
            new = stack.enter_context(open_bus(BusConfig(connect=(endpoint,), identity=tmp_path / f"new-{n}")))
            assert new.request(TILE, b"new", kind="tile", timeout_s=30) == b"new"
            assert first.request(TILE, b"old", kind="tile", timeout_s=30) == b"old"
        assert 1 < first.connections <= 7
        metrics = pages.page("/metrics")[2].decode()
        assert "gnd_certificate_left_seconds" in metrics
        assert 'gnd_router_sessions{kind="client"}' in metrics
        assert pages.page("/healthz")[0] == 200


def test_the_end_of_a_certificate_is_announced(
    authority: Authority, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    authority.issue(VEHICLE, tmp_path / "v", days=2 / 86_400)  # of its 302 s, 2 are left
    with caplog.at_level(logging.WARNING):
        watch = CertificateWatch(tmp_path / "v", lambda _new: None, "test", every_s=0.05)
        deadline_s = time.monotonic() + 20
        while "renew it" not in caplog.text and time.monotonic() < deadline_s:
            time.sleep(0.02)
    watch.close()
    assert "certificate vehicle.v-1" in caplog.text
    said = certificate_checks(watch)["certificate"]()
    assert said is not None
    assert "renew it" in said
    registry = CollectorRegistry()
    register_certificate(registry, watch)
    assert b"gnd_certificate_left_seconds" in generate_latest(registry)


def test_certs_commands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    runner = CliRunner()

    def run(*words: str) -> str:
        result = runner.invoke(certs, list(words), catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return result.output

    run("init")
    run("router", "main", "--host", "map.example.org", "--out", "r")
    for role in ("shard", "tiles", "operator"):
        run(role, "one", "--out", role)
    run("vehicle", "v-1", "--owner", "Example Cars", "--out", "v", "--to", "r")
    assert "vehicle.v-1" in (tmp_path / "r" / "members.json").read_text()
    assert "holds until" in run("check", "v")
    assert "holds until" in run("renew", "v")
    serial = load_identity(Path("v")).certificate.serial_number
    assert "renewed until" in run("renew", "v", "--all")
    assert load_identity(Path("v")).certificate.serial_number != serial
    assert load_identity(Path("v")).owner == "Example Cars"
    run("revoke", "vehicle.v-1", "--to", "v", "--to", "r")
    entries = json.loads(run("list", "--json"))
    assert [entry["role"] for entry in entries] == ["router", "shard", "tiles", "operator", "vehicle", "vehicle"]
    assert all(entry["revoked"] for entry in entries[-2:])
    with pytest.raises(IdentityError, match="was revoked"):
        runner.invoke(certs, ["check", "v"], catch_exceptions=False)
