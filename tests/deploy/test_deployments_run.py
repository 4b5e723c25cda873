"""The command lines of compose files, Kubernetes manifests and units, run as plain processes: healthy, and a report is
acknowledged. What they cannot show is the containers, the cluster and systemd themselves.
"""

import json
import os
import re
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from database_process import PASSWORD, DatabaseProcess, self_signed
from deployed_fleet import GND, DeployedFleet, identities
from manifests import (
    DEPLOY,
    HOST,
    UNITS,
    Part,
    compose,
    compose_parts,
    kustomized,
    pod_parts,
    unit_environment,
    unit_words,
)
from metric_names import of_alerts, of_dashboard, of_scaling
from suite_ports import new_port

from gnd.fleet_bus.identity.names import MemberName
from gnd.tile_store.location import open_store

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600), pytest.mark.xdist_group("hosts")]
MEMBERS = {
    **{name: MemberName("router", name) for name in ("router", *(f"router-{which}" for which in "01ab2"))},
    **{name: MemberName("tiles", name) for name in ("store", "tiles", "tiles-a", "tiles-b")},
    **{f"shard-{n}": MemberName("shard", f"shard-{n}") for n in ("0", "1", "a-0", "a-1", "b-0", "b-1")},
    **{f"car-{n}": MemberName("vehicle", f"car-{n}") for n in range(2)},
    "operator": MemberName("operator", "operator"),
}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, small_world: Any) -> Path:
    """Identities, secrets, drives, and a map that an operator has signed."""
    folder = tmp_path_factory.mktemp("deployed")
    identities(folder / "identities", MEMBERS)
    for n, drive in enumerate(small_world.drives):
        (folder / "drives").mkdir(exist_ok=True)
        shutil.copy2(drive, folder / "drives" / f"car-{n}.mcap")
    (folder / "secrets").mkdir()
    (folder / "secrets" / "database_password").write_text(PASSWORD)
    self_signed(folder / "secrets", "localhost")
    shutil.copy2(small_world.base_map, folder / "base.sqlite")
    words = ["map", "sign", str(folder / "base.sqlite"), "--identity", str(folder / "identities" / "operator")]
    subprocess.run([*GND, *words], check=True, capture_output=True)
    return folder


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[DeployedFleet]:
    fleet = DeployedFleet(tmp_path)
    yield fleet
    for process in fleet.running.values():
        process.kill()
        process.wait()


@pytest.fixture
def database(place: Path) -> Iterator[DatabaseProcess]:
    """The server of compose.database.yaml with the map in it."""
    pytest.importorskip("psycopg", reason="pip install 'gnd-fleet[postgres]'")
    service = compose("compose.database.yaml")["services"]["database"]
    running = DatabaseProcess(service, place / "secrets", new_port())
    try:
        variables = {
            "PGSERVICEFILE": str(place / "secrets" / "pg_service.conf"),
            "PGSSLMODE": "verify-full",
            "PGSSLROOTCERT": str(place / "secrets" / "database.crt"),
            **running.client(place / "secrets"),
        }
        shutil.copy2(place / "base.sqlite", place / "moved.sqlite")
        words = ["store", "copy", str(place / "moved.sqlite"), "postgresql:service=gnd"]
        subprocess.run([*GND, *words], check=True, capture_output=True, env=os.environ | variables)
        yield running
    finally:
        running.end()


def parts_of_host(place: Path, tmp_path: Path, host: str) -> dict[str, Part]:
    """The services of a host of compose.cloud.yaml that run without a profile."""
    told = HOST | {"HOST": host, "IDENTITIES": str(place / "identities"), "SECRETS": str(place / "secrets")}
    read = compose("compose.cloud.yaml", told)
    found = compose_parts(read, tmp_path / "volumes")
    return {f"{name}-{host}": part for name, part in found.items() if not read["services"][name].get("profiles")}


def drives_along(fleet: DeployedFleet, place: Path, vehicle: str, ports: list[int]) -> dict[str, object]:
    """A vehicle with an endpoint of each router, as docs/how_to/deploy.md starts it; its result."""
    folder = fleet.folder / vehicle
    words = [
        "agent",
        "--vehicle",
        vehicle,
        "--drive",
        str(place / "drives" / f"{vehicle}.mcap"),
        "--work-dir",
        str(folder),
    ]
    words += ["--identity", str(place / "identities" / vehicle)]
    words += [word for port in ports for word in ("--connect", f"tls/127.0.0.1:{port}")]
    return fleet.drive(words, folder / "result.json")


def assert_acknowledged(result: Mapping[str, object]) -> None:
    assert result["reports_acknowledged"] == result["reports_sent"], result
    assert int(str(result["reports_acknowledged"])) > 0


def wait_merged(url: str) -> None:
    """Until no upload and no tile waits."""
    end_s = time.monotonic() + 60.0
    with open_store(url, read_only=True) as store:
        while store.counts().waiting or store.dirty_count():
            assert time.monotonic() < end_s, store.counts()
            time.sleep(0.1)


def test_one_host_with_compose(place: Path, fleet: DeployedFleet) -> None:
    told = {name.upper(): str(place / name) for name in ("identities", "drives")}
    told |= {"VEHICLE": "car-0", "DRIVE": "car-0.mcap", "LINK": "none"}
    volumes = fleet.folder / "volumes"
    (volumes / "data").mkdir(parents=True)
    shutil.copy2(place / "base.sqlite", volumes / "data" / "store.sqlite")
    parts = compose_parts(compose("compose.yaml", told), volumes)
    endpoints = {"0.0.0.0": new_port()}
    endpoints["router"] = endpoints["0.0.0.0"]
    for name in ("router", "store", "merger-0", "merger-1"):
        fleet.start(parts[name], endpoints)
    fleet.wait_healthy()
    fleet.start(parts["agent"], endpoints)
    assert fleet.running["agent"].wait(240) == 0, fleet.logs()
    fleet.running.pop("agent")
    assert_acknowledged(json.loads((volumes / "agents" / "car-0" / "result.json").read_text()))
    fleet.end()


def test_two_hosts_and_a_database_with_compose_lose_a_host(
    place: Path, fleet: DeployedFleet, database: DatabaseProcess
) -> None:
    fleet.environment = database.client(place / "secrets")
    ports = {"a": new_port(), "b": new_port()}
    names = {f"cloud-{host}.example": port for host, port in ports.items()}
    for host, port in ports.items():
        for name, part in parts_of_host(place, fleet.folder, host).items():
            fleet.start(part, names | {"0.0.0.0": port, "router": port}, name)
    assert len(fleet.running) == 8
    fleet.wait_healthy()
    assert_acknowledged(drives_along(fleet, place, "car-0", list(ports.values())))
    seen = fleet.metrics()
    assert seen["gnd_shard_alive"]["shard"] == {"shard-a-0", "shard-a-1", "shard-b-0", "shard-b-1"}
    assert_every_metric_exists(seen)

    for name in [name for name in fleet.running if name.endswith("-a")]:
        fleet.kill(name)
    assert_acknowledged(drives_along(fleet, place, "car-1", list(ports.values())))
    fleet.wait_healthy()
    fleet.end()


def assert_every_metric_exists(seen: dict[str, dict[str, set[str]]]) -> None:
    """Alerts, dashboard and autoscaling ask for metrics that the fleet shows, by labels that these have."""
    of_prometheus = {"up"}
    if "-wal" not in seen["gnd_store_file_bytes"]["file"]:
        of_prometheus.add("gnd_store_disk_free_bytes")  # a store in a database has no disk that its shards know
    asked = [*of_alerts(), *of_dashboard(), *of_scaling()]
    assert len(asked) > 40
    for expression, name, labels in asked:
        assert name in seen or name in of_prometheus, f"{expression}: the fleet shows no {name}"
        if seen.get(name):
            known = set(seen[name]) | {"job", "instance"}
            assert labels <= known, f"{expression}: {name} has the labels {known}"


def test_a_cluster(place: Path, fleet: DeployedFleet, database: DatabaseProcess) -> None:
    fleet.environment = database.client(place / "secrets")
    of_database = fleet.folder / "database"  # what docs/how_to/deploy.md puts into that Secret
    of_database.mkdir()
    for name in ("pg_service.conf", "database.crt"):
        shutil.copy2(place / "secrets" / name, of_database)
    secrets = {f"identity-{name}": place / "identities" / name for name in MEMBERS} | {"database": of_database}
    parts = pod_parts(kustomized("production"), secrets, fleet.folder / "kubelet")
    assert sorted(parts) == ["router-0", "router-1", "shard-0", "shard-1", "tiles-0", "tiles-1"]
    names = {"router-0.router": new_port(), "router-1.router": new_port()}
    for name, part in parts.items():
        fleet.start(part, names | {"0.0.0.0": names.get(f"{name}.router", 0)})
    fleet.wait_healthy()
    assert_acknowledged(drives_along(fleet, place, "car-0", list(names.values())))
    linked = fleet.metrics()["gnd_router_sessions"]["kind"]
    assert linked == {"client", "router"}
    fleet.end()


@pytest.mark.parametrize("where", ["file", "postgresql"])
def test_units(place: Path, fleet: DeployedFleet, where: str, request: pytest.FixtureRequest) -> None:
    drop_in, more = "", {}
    if where == "postgresql":
        fleet.environment = request.getfixturevalue("database").client(place / "secrets")
        drop_in = (DEPLOY / "systemd" / "postgresql.conf").read_text()
        loaded = re.findall(r"^LoadCredential=([^:]+):/etc/gnd/(.+)$", drop_in, re.M)
        more = {f"/run/credentials/{name}": place / "secrets" / file for name, file in loaded}
        assert len(more) == 2
    mounts = {"/etc/gnd": place / "identities", "/var/lib/gnd": fleet.folder / "state", **more}
    (fleet.folder / "state").mkdir()
    shutil.copy2(place / "base.sqlite", fleet.folder / "state" / "store.sqlite")
    endpoints = {"0.0.0.0": new_port()}
    endpoints["127.0.0.1"] = endpoints["0.0.0.0"]
    for path in UNITS:
        for instance in ("0", "1") if "@" in path.name else ("",):
            unit = path.read_text() + (drop_in if "router" not in path.name else "")
            environment = unit_environment(unit, instance, "/run/credentials")
            words = tuple(unit_words(unit, instance, environment))
            fleet.start(Part(f"{path.stem}{instance}", words, environment, mounts), endpoints)
    assert len(fleet.running) == 4
    fleet.wait_healthy()
    assert_acknowledged(drives_along(fleet, place, "car-0", [endpoints["0.0.0.0"]]))
    fleet.end()


def test_the_two_lines_of_the_readme(place: Path, fleet: DeployedFleet, new_database: Callable[[], str]) -> None:
    """The store moves while the fleet runs; with a second router, shards and vehicles go on without the first."""
    text = (DEPLOY.parent / "README.md").read_text()
    (block,) = re.findall(r"## From one machine to several\n.*?```\n(.*?)```", text, re.S)
    copy_line, router_line = (line.split("#")[0].split() for line in block.splitlines())
    assert copy_line[:3] == ["gnd", "store", "copy"]
    assert router_line[:2] == ["gnd", "router"]
    first, second = new_port(), new_port()
    mounts = {"map.sqlite": fleet.folder / "map.sqlite", "id": place / "identities"}
    shutil.copy2(place / "base.sqlite", mounts["map.sqlite"])

    def start(words: list[str], endpoints: Mapping[str, int], name: str) -> None:
        more = () if name.startswith("router") else ("--connect", "tls/FIRST:7447", "--connect", "tls/SECOND:7447")
        part = Part(name, (*words, *more, "--metrics-port", "0"), {}, mounts)
        fleet.start(part, endpoints | {"FIRST": first, "SECOND": second})

    def cloud(store: str) -> None:
        start(["store", "--path", store, "--identity", "id/tiles"], {}, "tiles")
        for n in range(2):
            start(["merger", "--id", f"shard-{n}", "--store", store, "--identity", f"id/shard-{n}"], {}, f"shard-{n}")

    start(["router", "--listen", "tls/0.0.0.0:7447", "--identity", "id/router"], {"0.0.0.0": first}, "router")
    cloud("map.sqlite")
    fleet.wait_healthy()
    before = drives_along(fleet, place, "car-0", [first, second])
    assert_acknowledged(before)

    url = new_database()
    words = [url if word.startswith("postgresql://") else str(mounts.get(word, word)) for word in copy_line]
    done = subprocess.run([*GND, *words[1:]], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    start(router_line[1:], {"0.0.0.0": second, "ROUTER": first}, "router-2")
    for name in ("tiles", "shard-0", "shard-1"):
        fleet.stop(name, ended="map.sqlite: moved to")
    cloud(url)
    fleet.wait_healthy()

    fleet.kill("router")
    after = drives_along(fleet, place, "car-1", [first, second])
    assert_acknowledged(after)
    fleet.wait_healthy()
    wait_merged(url)  # an acknowledgement says that it is kept, not that it is merged
    fleet.end()
    with open_store(url, read_only=True) as store:
        vehicles = {one.vehicle for one in store.vehicle_accounts()}
    assert vehicles == {"car-0", "car-1"}
