"""Whole fleet runs with real processes, and what `kill -9` does to them."""

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
import pytest
from account_testing import assert_one_account
from fleet_testing import Run

from gnd.deploy.account import lost_reports, tile_histories
from gnd.deploy.map_use import read_ways
from gnd.deploy.run_folder import RunFolder
from gnd.gnd_map.tile import content_sha
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.sources.world_clock import SLACK_S

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("fleets")]
Start = Callable[..., Run]


def final_map(folder: Path) -> dict[int, bytes]:
    """Content hash of every tile of a finished run."""
    with SqliteStore(folder / "store.sqlite") as store:
        return {h.tile.tile.morton: content_sha(h.tile.tile, h.after) for h in tile_histories(store)}


def report_parts(folder: Path) -> list[tuple[int, str, int]]:
    with SqliteStore(folder / "store.sqlite") as store:
        return [(row.tile.morton, row.report_id, row.part) for row in store.reports()]


def assert_nothing_lost_or_doubled(folder: Path, summary: dict[str, object]) -> None:
    assert summary["reports_lost"] == 0
    assert summary["reports_sent"] == summary["reports_acknowledged"]
    assert int(str(summary["reports_sent"])) > 0
    rows = report_parts(folder)
    assert len(rows) == len(set(rows))
    with SqliteStore(folder / "store.sqlite") as store:
        assert lost_reports(RunFolder(folder), store) == []
        assert store.dirty_count() == 0
        assert store.quarantined() == []
        for history in tile_histories(store):
            versions = [info.version for info in store.history("ndt", history.tile.tile)]
            assert versions == sorted(set(versions))


def test_a_run_ends_by_itself_with_a_full_account(finished_run: Path) -> None:
    summary = json.loads((finished_run / "summary.json").read_text())
    assert_nothing_lost_or_doubled(finished_run, summary)
    assert summary["updates_received"] >= summary["tiles_published"] > 0
    assert summary["changed_voxels"] > 0
    assert summary["traffic"]["down_wire_bytes"] > summary["traffic"]["down_bytes"] > 0
    assert_one_account(finished_run, summary["traffic"])
    results = [json.loads(path.read_text())["traffic"] for path in finished_run.glob("agents/*/result.json")]
    for name in ("up_bytes", "down_bytes", "up_wire_bytes", "down_wire_bytes"):
        assert summary["traffic"][name] == sum(result[name] for result in results), "what the vehicles say themselves"
    assert summary["localisation_p95"]["lateral_m"] is not None
    assert summary["restarts"] == {}
    lines = [json.loads(line) for line in (finished_run / "updates.jsonl").read_text().splitlines()]
    assert len({(line["tile"], line["version"]) for line in lines}) == len(lines)


@pytest.mark.parametrize("victim", ["merger-0", "store", "router", "vehicle-00"])
def test_kill_9_in_mid_run_loses_nothing_and_applies_nothing_twice(start_run: Start, victim: str) -> None:
    run = start_run("--link", "none")
    run.wait_for(run.driving, "an agent has downloaded a tile")
    pid = run.kill(victim)
    run.wait_for(lambda: run.pid(victim) != pid, f"{victim} is started again")
    summary = run.finish()
    assert summary["restarts"] == {victim: 1}
    assert_nothing_lost_or_doubled(run.folder, summary)


def test_every_process_of_the_cloud_killed_in_turn(start_run: Start) -> None:
    run = start_run("--link", "none")
    run.wait_for(run.driving, "an agent has downloaded a tile")
    for victim in ("merger-1", "store", "merger-0", "router"):
        pid = run.kill(victim)
        run.wait_for(lambda victim=victim, pid=pid: run.pid(victim) != pid, f"{victim} is started again")  # type: ignore[misc]
    assert_nothing_lost_or_doubled(run.folder, run.finish())


def test_ctrl_c_ends_every_process_in_order(start_run: Start) -> None:
    run = start_run("--link", "3g")
    run.wait_for(run.driving, "an agent has downloaded a tile")
    processes = [psutil.Process(run.pid(name)) for name in ("router", "store", "merger-0", "vehicle-00")]
    run.process.send_signal(signal.SIGINT)
    _, err = run.process.communicate(timeout=30)
    assert run.process.returncode == 130
    assert err.strip().endswith("gnd: interrupted")
    _, alive = psutil.wait_procs(processes, timeout=5)
    assert alive == []
    assert json.loads((run.folder / "pids.json").read_text()) == {}


def test_vehicles_start_one_after_the_other_in_the_time_of_their_drives(start_run: Start) -> None:
    run = start_run("--link", "none", "--headway", "3")
    summary = run.finish()
    assert_nothing_lost_or_doubled(run.folder, summary)
    ways = read_ways(RunFolder(run.folder))
    assert list(ways) == ["vehicle-00", "vehicle-01"]
    ahead, behind = ways.values()
    wall_s = np.array([one.wall_ns for one in ahead]) * 1e-9
    drive_s = np.array([one.t_ns - ahead[0].t_ns for one in ahead]) * 1e-9
    while_both = [one for one in behind if wall_s[0] <= one.wall_ns * 1e-9 < wall_s[-1]]
    assert len(while_both) >= 3
    for one in while_both:  # the one ahead was between two of its milestones, however long they took on this machine
        after = int(np.searchsorted(wall_s, one.wall_ns * 1e-9, side="right"))
        own_s = (one.t_ns - behind[0].t_ns) * 1e-9
        assert drive_s[after] - own_s >= 3.0 - SLACK_S - 0.2
        assert drive_s[after - 1] - own_s <= 3.0 + SLACK_S + 0.2
    assert summary["learning"]["vehicles"] == 2
    assert summary["learning"]["known_share"] is None


def test_killing_the_launcher_leaves_no_orphan(start_run: Start) -> None:
    run = start_run("--link", "none")
    run.wait_for(run.driving, "an agent has downloaded a tile")
    names = ("router", "store", "merger-0", "merger-1", "watcher")
    processes = [psutil.Process(run.pid(name)) for name in names]
    os.kill(run.process.pid, signal.SIGKILL)
    run.process.communicate(timeout=30)
    _, alive = psutil.wait_procs(processes, timeout=20)
    assert alive == []
