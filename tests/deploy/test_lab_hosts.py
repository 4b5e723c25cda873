"""`gnd lab --regions R --hosts H` in earnest: PostgreSQL with a standby, routers, shards, vehicles, faults."""

import json
import signal
from pathlib import Path

import pytest
from lab_testing import gnd_lab, has_namespaces, needs_root, own_name, started, wait_until

from gnd.deploy.errors import LabError
from gnd.deploy.lab.hosts.data import labs_with_data
from gnd.deploy.lab.hosts.postgres import server_programs

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
    name, out = own_name(), tmp_path / "out"
    faults = ("--faults", "database-host,partition", "--away", "3", "--cut", "5")
    with started("hosts", *SMALL, *faults, "--name", name, "--out", str(out), "--json") as process:
        text, err = process.communicate(timeout=LONGEST_S)
    assert process.returncode == 0, err + text
    told = json.loads(text)
    assert told == json.loads((out / "lab_hosts.json").read_text())
    assert (told["lost"], told["doubled"], told["stuck_tiles"], told["failures"]) == (0, 0, 0, [])
    assert told["identical_map"]
    assert [one["fault"] for one in told["faults"]] == ["database-host", "partition"]
    assert min(one["acknowledged"] for one in told["faults"]) > 0
    logs = {path.stem: path.read_text() for path in (out / "logs").iterdir()}
    assert "database-b takes over" in logs["database-b"]
    assert "started streaming WAL" in logs["database-a"], "the lost host came back as the standby"
    assert json.loads((out / "witness.json").read_text()) == {"primary": "database-b", "is_alone": False}
    assert not has_namespaces(name)
    assert name not in labs_with_data()


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
