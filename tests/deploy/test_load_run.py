"""Real processes: a cloud that keeps up with a few vehicles, and one whose workers hang."""

import json
import os
import signal
import threading
import time
from contextlib import closing, suppress
from pathlib import Path

import apsw
import pytest
from load_testing import make_run
from suite_kernels import has_library

from gnd.deploy.errors import LoadError
from gnd.deploy.load.client import start_file
from gnd.deploy.load.cpu import children
from gnd.deploy.load.drives import KeptRuns
from gnd.deploy.load.plan import LoadOptions
from gnd.deploy.load.run import run_load
from gnd.deploy.load.verdict import summary
from gnd.tile_store.location import open_store

pytestmark = pytest.mark.xdist_group("fleets")

OPTIONS = LoadOptions(vehicles=4, km=0.25, kmh=180.0, per_street=2, shards=1, clients=1, in_flight=8)


def loaded(tmp_path, options, store=None, look=lambda *_: None, **given):
    run, folder = make_run(tmp_path / "run"), tmp_path / "load"
    folder.mkdir()
    return run_load(options, KeptRuns(run), folder, look, threading.Event(), store, **given), folder


class LookForCompiler:
    """Which processes of a load have had the compiler of numba in their memory, and which were looked at."""

    def __init__(self, folder):
        self.pids, self.seen, self.compiling = folder / "pids.json", set(), set()

    def __call__(self, *_told):
        if self.pids.exists():
            for name, pid in json.loads(self.pids.read_text(encoding="utf-8")).items():
                for one in (pid, *children(pid)):
                    with suppress(OSError):
                        mapped = Path(f"/proc/{one}/maps").read_text(encoding="utf-8")
                        self.seen.add(name if one == pid else f"{name}'s worker")
                        self.compiling |= {f"{name} ({one})"} if "llvmlite" in mapped else set()


@pytest.mark.slow
def test_a_cloud_keeps_up_with_a_few_vehicles(tmp_path):
    """With certificates; without it is tested with a database."""
    compiler = LookForCompiler(tmp_path / "load")
    outcome, folder = loaded(tmp_path, OPTIONS, look=compiler, secure=True)
    told = summary(outcome)
    assert told["secure"] is True
    assert outcome.unsigned == 0
    names = {path.name for path in (folder / "identities").iterdir()}
    assert {"router", "store", "merger-0", "fleet", "load-0-0", "load-0-3"} <= names
    assert told["why_not"] == []
    assert told["kept_up"] is True
    assert {"store", "merger-0", "merger-0's worker"} <= compiler.seen
    if has_library():  # as `make test` has it
        assert compiler.compiling == set(), "a kernel that it needs is not in the library"
    assert told["reports"] == told["acknowledged"] == outcome.planned > 25
    assert told["lost"] == 0
    with closing(apsw.Connection(str(folder / "store.sqlite"), flags=apsw.SQLITE_OPEN_READONLY)) as store:
        journaled = {report_id for (report_id,) in store.execute("SELECT DISTINCT report_id FROM report")}
        (heads,) = store.execute("SELECT COUNT(*) FROM tile_head WHERE version > 1")
    assert {one.report_id for one in outcome.acknowledged} == journaled
    assert heads[0] == 6  # the three tiles of both streets
    assert told["second_halves"] > 0
    assert told["sent_whole"] == 0
    assert len(outcome.notices_s) == told["versions"] >= 6
    assert told["cpu_ms_per_report"] > 0
    assert {name for name, ms in told["cpu_ms_by_part"].items() if ms > 0} >= {"workers", "shards"}
    assert told["cpu_share"]["clients"] > 0


@pytest.mark.slow
def test_a_database_keeps_up_too_and_its_server_is_a_part_of_the_cost(tmp_path, new_database):
    database = new_database()
    outcome, folder = loaded(tmp_path, OPTIONS, database)
    told = summary(outcome)
    assert told["why_not"] == []
    assert told["reports"] == told["acknowledged"] == outcome.planned > 25
    assert told["lost"] == 0
    assert (told["secure"], outcome.unsigned) == (False, None)
    assert not (folder / "store.sqlite").exists()
    with open_store(database, create=False) as store:
        journaled = {row.report_id for row in store.reports()}
    assert {one.report_id for one in outcome.acknowledged} == journaled
    assert told["cpu_ms_by_part"]["database"] > 0
    (tmp_path / "again").mkdir()
    with pytest.raises(LoadError, match="holds a map"):
        loaded(tmp_path / "again", OPTIONS, database)


def hang_workers(folder, after_s, for_s):
    """Stop the workers of all shards some time after the start, and let them go on later, so that they can end."""
    while not start_file(folder).exists():
        time.sleep(0.05)
    time.sleep(after_s)
    pids = json.loads((folder / "pids.json").read_text(encoding="utf-8"))
    workers = [child for name, pid in pids.items() if name.startswith("merger-") for child in children(pid)]
    for worker in workers:
        os.kill(worker, signal.SIGSTOP)
    time.sleep(for_s)
    for worker in workers:
        os.kill(worker, signal.SIGCONT)


@pytest.mark.slow
def test_a_cloud_whose_workers_hang_does_not_keep_up(tmp_path):
    options = LoadOptions(vehicles=4, km=0.3, kmh=180.0, per_street=2, shards=1, clients=1, in_flight=8, drain_s=2.0)
    hanging = threading.Thread(target=hang_workers, args=(tmp_path / "load", 2.0, 9.0))
    hanging.start()
    outcome, _ = loaded(tmp_path, options)
    hanging.join()
    told = summary(outcome)
    assert told["kept_up"] is False
    assert told["acknowledged"] == told["reports"] > 30  # acks are a disk write and go on
    assert told["lost"] == 0
    assert any("not empty" in one for one in told["why_not"])
    assert told["limit"] == "cloud"
    assert told["cpu_ms_per_report"] is None
