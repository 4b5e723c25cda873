"""A fleet's page follows the run, and whatever happens to it harms nobody."""

import json
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from typing import Any

import pytest
from fleet_testing import Run
from page_testing import served

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900), pytest.mark.xdist_group("fleets")]


def asked(url: str, path: str) -> Any:
    with urllib.request.urlopen(f"{url}{path}", timeout=60) as answer:
        return json.load(answer)


def address_of(run: Run) -> str:
    """The address that the run prints before its first table."""
    assert run.process.stderr is not None
    for line in run.process.stderr:
        if line.startswith("live map: "):
            return line.split()[2]
    raise AssertionError("the run has told no address")


def status_follows(run: Run) -> None:
    """`gnd status RUN --watch` sees shards, vehicles and reports of the run."""
    command = [sys.executable, "-m", "gnd.deploy.cli", "status", str(run.folder), "--watch", "--json", "--every", "0.3"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            told = json.loads(line)
            known = {one["vehicle"] for one in told["vehicles"] if one.get("drive_km", 0.0) > 0.0}
            if told["parts"] and len(known) == 2 and any(one["is_alive"] for one in told["shards"]):
                break
            assert run.process.poll() is None, f"the run has ended before: {told}"
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 0


def test_the_page_follows_a_run_dies_alone_and_the_run_is_served_after_it(start_run: Callable[..., Run]) -> None:
    run = start_run()
    url = address_of(run)

    def has_vehicles() -> bool:
        try:
            return len(asked(url, "api/vehicles")) == 2
        except OSError:
            return False  # it is about to listen

    run.wait_for(has_vehicles, "both vehicles were seen")
    about = asked(url, "api/map")
    assert about["live"] is True
    assert about["tiles"] > 0
    status_follows(run)
    run.kill("page")
    summary = run.finish()
    assert summary["restarts"] == {}
    assert summary["reports_lost"] == 0

    with served(run.folder) as page:
        about = page.value("/api/map")
        assert (about["live"], about["changed_tiles"] > 0) == (False, True)
        assert {one["name"] for one in page.value("/api/vehicles")} == {"vehicle-00", "vehicle-01"}
        ways = page.value("/api/ways")
        assert all(len(way) > 3 for way in ways.values())
        traffic = page.value("/api/traffic")
        assert traffic["fleet"]["up_wire_bytes"] == summary["traffic"]["up_wire_bytes"]
        assert [one["link"] for one in traffic["links"]] == ["3g", "4g", "5g"]


def test_without_a_page_there_is_none(start_run: Callable[..., Run]) -> None:
    run = start_run("--no-page")
    names = run.folder / "pids.json"
    run.wait_for(lambda: names.exists() and "watcher" in json.loads(names.read_text()), "the cloud runs")
    assert "page" not in json.loads(names.read_text())
