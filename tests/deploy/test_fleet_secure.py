"""`gnd fleet --secure`: the same fleet with certificates, TLS and rights on."""

import json
import re
from collections.abc import Callable

import pytest
from fleet_testing import Run

from gnd.deploy.account import lost_reports
from gnd.deploy.run_folder import RunFolder
from gnd.fleet_bus.identity.folder import load_identity
from gnd.fleet_bus.publishers import Publishers
from gnd.tile_store.signatures import signatures
from gnd.tile_store.sqlite_store import SqliteStore

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("fleets")]


def test_a_fleet_with_identities_heals_its_map(start_run: Callable[..., Run]) -> None:
    run = start_run("--secure", "--link", "none")
    summary = run.finish()
    assert summary["reports_lost"] == 0
    assert summary["reports_sent"] == summary["reports_acknowledged"] > 0
    assert summary["updates_received"] >= summary["tiles_published"] > 0
    assert summary["restarts"] == {}
    with SqliteStore(run.folder / "store.sqlite") as store:
        assert lost_reports(RunFolder(run.folder), store) == []
        assert store.quarantined() == []
        publishers = Publishers(run.folder / "identities" / "vehicle-00")  # what a vehicle knows is enough
        found = list(signatures(store, publishers, "ndt", all_versions=True))
    by_kind = {kind: {one.who for one in found if one.kind == kind} for kind in ("base", "merged")}
    assert {one.status for one in found} == {"good"}
    assert by_kind["base"] == {"operator fleet"}
    assert by_kind["merged"]
    assert all(who.startswith("shard shard-") for who in by_kind["merged"])
    assert sum(one.kind == "merged" for one in found) >= summary["tiles_published"]

    names = {path.name for path in (run.folder / "identities").iterdir()}
    assert {"router", "store", "merger-0", "watcher", "fleet", "vehicle-00"} <= names
    assert load_identity(run.folder / "identities" / "vehicle-00").member.common_name == "vehicle.vehicle-00"
    logs = run.logs()
    assert "unable to connect" not in logs
    assert "nobody has signed" not in logs
    assert "does not fit" not in logs
    assert not re.search(r"Traceback|cut off", logs), logs
    assert json.loads((run.folder / "run.json").read_text())["config"]["link"] == "none"
