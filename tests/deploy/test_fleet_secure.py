"""`gnd fleet --secure`: the same fleet with certificates, TLS and rights on."""

import json
import re
from collections.abc import Callable

import pytest
from fleet_testing import Run

from gnd.deploy.account import lost_reports
from gnd.deploy.run_folder import RunFolder
from gnd.fleet_bus.identity.folder import load_identity
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

    names = {path.name for path in (run.folder / "identities").iterdir()}
    assert {"router", "store", "merger-0", "watcher", "fleet", "vehicle-00"} <= names
    assert load_identity(run.folder / "identities" / "vehicle-00").member.common_name == "vehicle.vehicle-00"
    logs = run.logs()
    assert "unable to connect" not in logs
    assert not re.search(r"Traceback|cut off", logs), logs
    assert json.loads((run.folder / "run.json").read_text())["config"]["link"] == "none"
