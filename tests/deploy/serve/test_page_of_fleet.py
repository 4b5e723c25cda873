"""A fleet's page follows the run, and whatever happens to it harms nobody."""

import json
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
    run.kill("page")
    summary = run.finish()
    assert summary["restarts"] == {}
    assert summary["reports_lost"] == 0

    with served(run.folder) as page:
        about = page.value("/api/map")
        assert (about["live"], about["changed_tiles"] > 0) == (False, True)
        vehicles = page.value("/api/vehicles")
        assert {(one["name"], one["ended"]) for one in vehicles} == {("vehicle-00", True), ("vehicle-01", True)}
        assert {one["health"] for one in vehicles} <= {"good", "degraded"}
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
