"""`gnd doctor` against real routers, certificates, ports, stores and parts: what is wrong is named, with what to do."""

import datetime as dt
import gzip
import json
import re
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from types import SimpleNamespace

import pytest
from click.testing import CliRunner, Result
from parts_testing import Parts, until
from suite_ports import new_port

from gnd.deploy.doctor import machine, programs
from gnd.deploy.doctor.command import doctor
from gnd.deploy.doctor.finding import Finding, graded, worst
from gnd.fleet_bus.build_info import build_info
from gnd.fleet_bus.identity.authority import Authority
from gnd.fleet_bus.identity.names import MemberName
from gnd.fleet_bus.router import open_router, start_router
from gnd.tile_store.migrations import SCHEMA_VERSION
from gnd.tile_store.sqlite_store import SqliteStore

OLD = Path(__file__).parents[1] / "tile_store" / "data" / "store_schema_7.sqlite.gz"
FleetFolders = dict[str, Path]


def invoke(*arguments: object) -> Result:
    return CliRunner().invoke(doctor, [str(one) for one in arguments], catch_exceptions=False)


def looked_at(*arguments: object) -> dict[str, list[dict[str, str]]]:
    """The findings, by what was looked at."""
    done = invoke("--json", *arguments)
    told = json.loads(done.output)
    assert done.exit_code == (told["state"] == "fault"), done.output
    found: dict[str, list[dict[str, str]]] = {}
    for one in told["findings"]:
        found.setdefault(one["what"], []).append(one)
    return found


def only(found: dict[str, list[dict[str, str]]], begin: str) -> dict[str, str]:
    (one,) = [one for what, some in found.items() if what.startswith(begin) for one in some]
    return one


def test_this_machine_is_looked_at(tmp_path: Path) -> None:
    found = looked_at("--folder", tmp_path, "--listen", f"tcp/127.0.0.1:{new_port()}")
    assert found["Python"][0]["state"] == "ok"
    assert sys.version.split()[0] in found["Python"][0]["says"]
    assert {"versions", "extras", "kernels", "cores", "memory", "disk", "descriptors", "clock", "zenoh"} <= set(found)
    assert "shared memory is off" in found["zenoh"][0]["says"]
    assert found["monotonic clock"][0]["state"] == "ok"
    assert only(found, "port")["state"] == "ok"
    assert all(bool(one["do"]) == (one["state"] != "ok") for some in found.values() for one in some)


def test_lines_say_state_and_what_to_do_and_the_exit_code_follows(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        done = invoke("--folder", tmp_path, "--listen", endpoint)
        assert done.exit_code == 1
        assert re.search(rf"^fault    port {endpoint}: cannot be opened: Address already in use$", done.output, re.M)
        assert "→ end who listens there" in done.output
        assert re.search(r"^\d+ ok, \d+ warnings, 1 faults$", done.output, re.M)
    done = invoke("--folder", tmp_path, "--listen", "tcp/127.0.0.1:99999")
    assert (done.exit_code, "is not like" in done.output) == (1, True)
    assert CliRunner().invoke(doctor, ["--nonsense"]).exit_code == 2


def test_warnings_alone_are_no_fault_unless_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "_DISK_GB", (1e9, 0.0))  # as if a run took more than any disk has
    free = ("--folder", tmp_path, "--listen", f"tcp/127.0.0.1:{new_port()}")
    done = invoke(*free)
    assert "warning  disk" in done.output
    assert done.exit_code == 0
    assert invoke(*free, "--strict").exit_code == 1


def test_a_folder_that_cannot_be_written_is_a_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert machine.disk(tmp_path / "not" / "yet" / "made").state == "ok"
    monkeypatch.setattr(machine.os, "access", lambda *_: False)  # root may write everywhere
    assert machine.disk(tmp_path).state == "fault"


def test_other_versions_and_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    pins = {"numpy": "0.0.1", "click": programs._version("click"), "absent-of-all": "1"}
    monkeypatch.setattr(programs, "_pins", lambda: pins)
    (found,) = programs.packages()
    assert found.state == "warning"
    assert re.match(r"1 other than in constraints\.txt: numpy \S+ instead of 0\.0\.1$", found.says)
    monkeypatch.setattr(programs, "_needed", lambda: ["click", "absent-of-all"])
    missing, _ = programs.packages()
    assert (missing.state, missing.says) == ("fault", "not installed: absent-of-all")
    monkeypatch.setattr(programs, "_pins", lambda: None)
    assert [one.state for one in programs.packages()] == ["fault", "ok"]


def test_kernels_without_machine_code_are_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "kernel_module.py"
    source.write_text("import numba\n\n@numba.njit(cache=True)\ndef kernel(x):\n    return x + 1\n\nkernel(1)\n")
    scope: dict[str, object] = {}
    exec(compile("\n\n\ndef kernel(x):\n    return x + 1\n", str(source), "exec"), scope)
    monkeypatch.setattr(programs, "all_kernels", lambda: (SimpleNamespace(plain=scope["kernel"]),))
    monkeypatch.setattr(programs, "_of_user", lambda: tmp_path / "nowhere")
    assert programs.kernels().state == "warning"
    subprocess.run([sys.executable, str(source)], check=True, cwd=tmp_path, env={"PATH": "/usr/bin:/bin"})
    # A program that is run is called __main__; numba names its files after the source all the same.
    found = sorted(path.name for path in tmp_path.rglob("*.nbi"))
    assert found == [f"kernel_module.kernel-3.py{sys.version_info.major}{sys.version_info.minor}.nbi"]


def test_a_store_is_looked_at_without_being_changed(tmp_path: Path) -> None:
    SqliteStore(tmp_path / "now.sqlite").close()
    with gzip.open(OLD) as packed, (tmp_path / "old.sqlite").open("wb") as file:
        shutil.copyfileobj(packed, file)
    before = (tmp_path / "old.sqlite").read_bytes()
    found = looked_at(
        "--store", tmp_path / "now.sqlite", "--store", tmp_path / "old.sqlite", "--store", tmp_path / "no"
    )
    now, old = (found[f"store {tmp_path / name}"] for name in ("now.sqlite", "old.sqlite"))
    assert [one["state"] for one in now] == ["ok", "ok"]
    assert [one["state"] for one in old] == ["warning", "ok"]
    assert old[0]["says"] == f"schema 7, this release has {SCHEMA_VERSION}"
    assert "gnd map backup" in old[0]["do"]
    assert (tmp_path / "old.sqlite").read_bytes() == before
    assert "no such store" in found[f"store {tmp_path / 'no'}"][0]["says"]


@pytest.mark.parametrize("damage", ["truncated", "overwritten", "other", "empty"])
def test_a_damaged_store_is_a_fault(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "map.sqlite"
    SqliteStore(path).close()
    data = bytearray(path.read_bytes())
    if damage == "overwritten":
        data[len(data) // 2 :] = b"\xff" * (len(data) - len(data) // 2)
    path.write_bytes(
        {"truncated": bytes(data[: len(data) // 2]), "other": b"text" * 999, "empty": b""}.get(damage, data)
    )
    assert "fault" in {one["state"] for one in looked_at("--store", path)[f"store {path}"]}


def test_a_router_that_runs_lets_in_and_one_that_does_not_is_a_fault(tmp_path: Path) -> None:
    endpoint, nobody = (f"tcp/127.0.0.1:{new_port()}" for _ in range(2))
    with open_router([endpoint]):
        found = looked_at("--connect", endpoint, "--connect", nobody)
        assert found[f"router {endpoint}"][0]["state"] == "ok"
        alone = found[f"tile server behind {endpoint}"][0]
        assert (alone["state"], "start one (gnd store)" in alone["do"]) == ("warning", True)
    lost = found[f"router {nobody}"][0]
    assert lost["state"] == "fault"
    assert f"no router at {nobody} for 3 s" in lost["says"]


def test_the_routers_of_a_file_of_settings_are_tried(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{new_port()}"
    (tmp_path / "agent.toml").write_text(f'vehicle = "v"\nconnect = ["{endpoint}"]\n')
    assert looked_at("--config", tmp_path / "agent.toml")[f"router {endpoint}"][0]["state"] == "fault"
    for text, why in (("connect = 3", "names no routers"), ("connect = [", "no valid TOML")):
        (tmp_path / "agent.toml").write_text(text)
        done = CliRunner().invoke(doctor, ["--config", str(tmp_path / "agent.toml")])
        assert why in str(done.exception)


@pytest.fixture
def folders(tmp_path: Path) -> FleetFolders:
    """Identities of one authority, and those of a stranger."""
    made: FleetFolders = {}
    for name in ("fleet", "stranger"):
        authority = Authority.create(tmp_path / name, name)
        for role, member in (("router", "router-1"), ("operator", "eve")):
            folder = made[f"{name} {role}"] = tmp_path / f"{name}-{role}"
            authority.issue(MemberName(role, member), folder, hosts=("127.0.0.1",) if role == "router" else ())
        authority.copy_lists([made[f"{name} router"]])
        if name == "fleet":
            now = dt.datetime.now(dt.UTC)
            for state, begins_d, ends_d in (("expired", -9, -2), ("early", 2, 9), ("ending", -9, 1)):
                made[state] = tmp_path / state
                begins, ends = (now + dt.timedelta(days=days) for days in (begins_d, ends_d))
                authority.issue(MemberName("operator", state), made[state], begins=begins, ends=ends)
    return made


@pytest.mark.parametrize(
    ("who", "state", "says"),
    [
        ("fleet operator", "ok", "operator.eve, holds"),
        ("ending", "warning", "holds 1.0 days more"),
        ("expired", "fault", "has expired"),
        ("early", "fault", "is not yet valid"),
    ],
)
def test_certificates_are_looked_at(folders: FleetFolders, who: str, state: str, says: str) -> None:
    found = only(looked_at("--identity", folders[who]), "identity")
    assert found["state"] == state
    assert says in found["says"]
    assert ("gnd certs renew" in found["do"]) == (state != "ok")


def test_an_identity_folder_that_is_none_is_a_fault(tmp_path: Path, folders: FleetFolders) -> None:
    assert only(looked_at("--identity", tmp_path / "absent"), "identity")["state"] == "fault"
    shutil.copy(folders["stranger operator"] / "key.pem", folders["fleet operator"] / "key.pem")
    assert "key of another certificate" in only(looked_at("--identity", folders["fleet operator"]), "identity")["says"]
    shutil.copy(folders["stranger operator"] / "authority.pem", folders["fleet router"] / "authority.pem")
    assert only(looked_at("--identity", folders["fleet router"]), "identity")["state"] == "fault"


def test_a_wrong_certificate_is_explained_by_the_router_s_answer(folders: FleetFolders) -> None:
    endpoint = f"tls/127.0.0.1:{new_port()}"
    with start_router([endpoint], identity=folders["fleet router"]):
        good = looked_at("--identity", folders["fleet operator"], "--connect", endpoint)
        assert good[f"router {endpoint}"][0]["state"] == "ok"
        wrong = looked_at("--identity", folders["stranger operator"], "--connect", endpoint)
        assert wrong[f"router {endpoint}"][0]["state"] == "fault"
        assert "does not come from our authority" in wrong[f"router {endpoint}"][0]["says"]
        assert "gnd certs check" in wrong[f"router {endpoint}"][0]["do"]
        plain = looked_at("--connect", endpoint)
        assert plain[f"router {endpoint}"][0]["state"] == "fault"


@pytest.mark.slow
def test_parts_that_run_tell_health_versions_and_clock(tmp_path: Path) -> None:
    parts = Parts(tmp_path)
    try:
        for name in ("router", "store"):
            parts.start(name)
        until("both are well", lambda: all(parts.is_healthy(name) for name in parts.running))
        pages = [f"http://127.0.0.1:{parts.ports[name]}" for name in ("router", "store")]
        found = looked_at("--connect", parts.endpoint, *(word for page in pages for word in ("--metrics", page)))
        assert found[f"tile server behind {parts.endpoint}"][0]["state"] == "ok"
        for page in pages:
            health, versions, clock = found[f"part {page}"]
            assert [one["state"] for one in (health, versions, clock)] == ["ok"] * 3
            assert build_info()["zenoh"] in versions["says"]
            assert "off by +0.00 s" in clock["says"]
        parts.running["router"].kill()
        parts.running["router"].wait()
        until("the store misses it", lambda: not parts.is_healthy("store"))
        found = looked_at("--metrics", pages[0], "--metrics", pages[1])
        assert "no pages there: [Errno 111] Connection refused" in found[f"part {pages[0]}"][0]["says"]
        ill = found[f"part {pages[1]}"][0]
        assert (ill["state"], "router" in ill["says"]) == ("fault", True)
    finally:
        parts.kill()


class _Told(BaseHTTPRequestHandler):
    """Pages of a part that a test makes up: of another release, with another clock."""

    metrics: Callable[[], str] = staticmethod(lambda: "")
    health, status = '{"checks": {"router": "ok"}}', 200

    def do_GET(self) -> None:
        body = (self.metrics() if self.path == "/metrics" else self.health).encode()
        self.send_response(self.status if self.path == "/healthz" else 200)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *arguments: object) -> None:  # noqa: A002
        pass


@pytest.fixture
def told() -> Iterator[type[_Told]]:
    """A page whose text a test chooses, served until its end; its address is `told.address`."""
    handler = type("Told", (_Told,), {})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    handler.address = f"http://127.0.0.1:{server.server_address[1]}"  # type: ignore[attr-defined]
    thread = Thread(target=server.serve_forever)
    thread.start()
    yield handler
    server.shutdown()
    server.server_close()
    thread.join()


def _page(version: str, off_s: float) -> Callable[[], str]:
    """A page of a part of that version whose clock is off by so much."""
    labels = build_info() | {"version": version}
    named = ",".join(f'{name}="{value}"' for name, value in labels.items())
    return staticmethod(lambda: f"gnd_build_info{{{named}}} 1.0\ngnd_clock_seconds {time.time() + off_s!r}\n")


@pytest.mark.parametrize(
    ("version", "off_s", "states"),
    [
        ("0.0.1", 0.0, ["ok", "warning", "ok"]),
        (build_info()["version"], 5.0, ["ok", "ok", "warning"]),
        (build_info()["version"], -3600.0, ["ok", "ok", "fault"]),
    ],
)
def test_another_release_and_another_clock_are_named(told, version: str, off_s: float, states: list[str]) -> None:
    told.metrics = _page(version, off_s)
    found = looked_at("--metrics", told.address)[f"part {told.address}"]
    assert [one["state"] for one in found] == states
    if version == "0.0.1":
        assert f"version 0.0.1 there, {build_info()['version']} here" in found[1]["says"]
    off = re.search(r"off by (\S+) s", found[2]["says"])
    assert off is not None
    assert float(off[1]) == pytest.approx(off_s, abs=0.9)


@pytest.mark.parametrize("text", ["", "gnd_tiles 3\n", "\x00\xff{", "gnd_build_info{version="])
def test_pages_of_something_else_are_no_good_news(told, text: str) -> None:
    told.metrics = staticmethod(lambda: text)
    found = looked_at("--metrics", told.address)[f"part {told.address}"]
    assert any(one["state"] != "ok" for one in found)
    told.health = "[]"
    assert looked_at("--metrics", told.address)[f"part {told.address}"]
    told.health = "no json"
    assert looked_at("--metrics", told.address)[f"part {told.address}"][-1]["state"] == "fault"


def test_an_ill_part_is_a_fault_that_names_the_check(told) -> None:
    told.metrics, told.status = _page(build_info()["version"], 0.0), 503
    told.health = '{"healthy": false, "checks": {"queue": "overdue by 90 s", "router": "ok"}}'
    ill = looked_at("--metrics", told.address)[f"part {told.address}"][0]
    assert (ill["state"], ill["says"]) == ("fault", "queue: overdue by 90 s")


def test_a_page_that_is_no_http_address_is_a_fault() -> None:
    assert "is not like http://" in only(looked_at("--metrics", "file:///etc/passwd"), "part")["says"]


def test_who_complains_says_what_to_do() -> None:
    with pytest.raises(ValueError, match="says to do ''"):
        Finding("x", "fault", "broken")
    with pytest.raises(ValueError, match="says to do 'y'"):
        Finding("x", "ok", "fine", "y")
    assert [graded("x", value, (2, 1), "v", "do").state for value in (2, 1.5, 0.5)] == ["ok", "warning", "fault"]
    assert worst([]) == "ok"
    assert worst([Finding("a", "warning", "b", "c"), Finding("a", "ok", "b")]) == "warning"
