"""`gnd lab --regions R --hosts H` in earnest: PostgreSQL with a standby, routers, shards, vehicles, faults."""

import json
import signal
from pathlib import Path

import pytest
from lab_testing import gnd_lab, has_namespaces, needs_root, own_name, started, started_gnd, wait_until
from load_testing import make_run

from gnd.deploy.errors import LabError
from gnd.deploy.lab.hosts.data import labs_with_data
from gnd.deploy.lab.hosts.postgres import server_programs
from gnd.fleet_bus.identity.folder import load_identity

pytest.importorskip("psycopg", reason="pip install 'gnd-fleet[postgres]'")
LONGEST_S = 900.0  # the test's own bound on a busy machine; alone it takes a minute
SMALL = ("--every", "1", "--vehicles", "1", "--gap", "600")


def _has_server() -> bool:
    try:
        server_programs()
    except LabError:
        return False
    return True


pytestmark = [
    needs_root,
    pytest.mark.slow,
    pytest.mark.timeout(1000),
    pytest.mark.xdist_group("hosts"),
    pytest.mark.skipif(not _has_server(), reason="needs the programs of a PostgreSQL server"),
]


def test_a_lost_database_host_and_a_cut_region_lose_nothing(tmp_path: Path) -> None:
    """With certificates: what is the same without is tested by it, too."""
    name, out = own_name(), tmp_path / "out"
    faults = ["database-host", "partition"]
    options = ("--secure", "--faults", ",".join(faults), "--away", "3", "--cut", "5")
    with started("hosts", *SMALL, *options, "--name", name, "--out", str(out), "--json") as process:
        text, err = process.communicate(timeout=LONGEST_S)
    assert process.returncode == 0, err + text
    told = json.loads(text)
    assert told == json.loads((out / "lab_hosts.json").read_text())
    assert (told["lost"], told["doubled"], told["stuck_tiles"], told["failures"]) == (0, 0, 0, [])
    assert told["identical_map"]
    assert told["signed"] >= told["versions"] > 0
    assert (told["damages"], told["unreleased"]) == (0, 0)
    assert [one["fault"] for one in told["faults"]] == faults
    assert min(one["acknowledged"] for one in told["faults"]) > 0
    logs = {path.stem: path.read_text() for path in (out / "logs").iterdir()}
    assert "database-b takes over" in logs["database-b"]
    assert "started streaming WAL" in logs["database-a"], "the lost host came back as the standby"
    assert json.loads((out / "witness.json").read_text()) == {"primary": "database-b", "is_alone": False}
    assert "router listens at tls/198.19." in logs["router-0"]
    assert "linked with the router at tls/198.19." in logs["hub"]
    identities = {path.name: load_identity(path).member.common_name for path in (out / "identities").iterdir()}
    assert {"router-1": "router.router-1", "shard-0": "shard.shard-0", "tiles-0": "tiles.tiles-0"}.items() <= (
        identities.items()
    )
    assert identities["vehicle-1-0"] == "vehicle.vehicle-1-0-000"
    assert not has_namespaces(name)
    assert name not in labs_with_data()


def test_a_load_is_sent_through_the_routers_of_all_regions(tmp_path: Path) -> None:
    """With certificates, so that clients, hosts and rights fit together; without it is a part of it."""
    run, keep = make_run(tmp_path / "run"), tmp_path / "kept"
    options = "--hosts 2 --regions 2 --secure --vehicles 4 --km 0.15 --kmh 180 --per-street 2 --in-flight 8 --drain 300"
    with started_gnd("load", *options.split(), "--drives", str(run), "--keep", str(keep), "--json", "-") as process:
        text, err = process.communicate(timeout=LONGEST_S)
    assert process.returncode == 0, err + text
    told = json.loads(text)
    assert told["reports"] == told["acknowledged"] > 15
    assert told["lost"] == 0
    late = ("late", "wait for", "within", "grew")  # as a busy machine is
    assert [one for one in told["why_not"] if not any(word in one for word in late)] == []
    assert sorted(told["hosts"]) == ["host-0", "host-1"]
    assert told["secure"] is True
    assert min(told["cpu_ms_by_part"][part] for part in ("router", "shards", "workers", "database")) > 0
    assert {"load-0-0", "load-1-2", "router-1"} <= {path.name for path in (keep / "identities").iterdir()}
    assert [len((keep / f"client-{n}.jsonl").read_text().splitlines()) > 0 for n in (0, 1)] == [True, True]
    assert not has_namespaces(f"load-{process.pid}")


def test_what_a_killed_run_leaves_is_cleaned(tmp_path: Path) -> None:
    name, pids = own_name(), tmp_path / "out" / "pids.json"
    with started("--regions", "1", "--hosts", "2", "--name", name, "--out", str(pids.parent)) as process:
        wait_until(lambda: pids.exists() and "database-b" in pids.read_text(), "the databases are started")
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert has_namespaces(name)
        said, err = gnd_lab("clean").communicate(timeout=120)
    assert f"{name}: " in said, err
    assert f"/{name} removed" in said
    assert not has_namespaces(name)
    assert name not in labs_with_data()
