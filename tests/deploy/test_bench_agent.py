"""`gnd bench agent` on a short recording, with the real router, tile server and shard."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from gnd.deploy.bench.holders import ALLOCATED
from gnd.fleet_sim.drives import DriveConfig, simulate_drive
from gnd.fleet_sim.street import StreetOptions, street

pytestmark = pytest.mark.slow


def test_a_recording_is_driven_and_every_stage_is_told(tmp_path: Path) -> None:
    drive = simulate_drive(street(5, StreetOptions(100.0)), DriveConfig("car", "VLP-16", scans=30), tmp_path / "a.mcap")
    command = [sys.executable, "-m", "gnd.deploy.cli", "bench", "agent", str(drive), "--no-first", "--rounds", "0"]
    command += ["--out", str(tmp_path / "run"), "--json"]
    told = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600)
    found = json.loads(told.stdout)
    assert json.loads((tmp_path / "run" / "bench.json").read_text(encoding="utf-8")) == found
    assert found["real_time"]["a"] > 0
    stages = found["ms"]
    assert {"reading the recording", "tiles", "whole scan", "memory meter"} <= set(stages)
    assert all(0 <= one["p50"] <= one["p99"] for one in stages.values())
    summed = sum(one["mean"] for name, one in stages.items() if name != "whole scan")
    assert summed == pytest.approx(stages["whole scan"]["mean"], rel=1e-6)
    assert 20 < found["memory_mb"]["start"] <= found["memory_mb"]["peak"] < 4000
    holders = found["drives"]["a"]["holders_mb"]
    assert {"numpy", ALLOCATED} <= set(holders)
    assert 0.5 * found["memory_mb"]["start"] < sum(holders.values()) < 1.1 * found["memory_mb"]["peak"]
    assert found["start_s"]["warm"] > 0
    assert found["start_s"]["first"] is None
    assert found["ratio"] == {}
    logs = {file.stem: file.read_text(encoding="utf-8") for file in (tmp_path / "run" / "logs").glob("*.log")}
    assert {"router", "store", "merger-0", "a"} <= set(logs)
    assert not [
        line for log in logs.values() for line in log.splitlines() if "Traceback" in line or "failed after" in line
    ]


def test_a_recording_that_is_none_is_refused_with_its_log(tmp_path: Path) -> None:
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"no recording")
    command = [sys.executable, "-m", "gnd.deploy.cli", "bench", "agent", str(broken), "--no-first", "--rounds", "0"]
    told = subprocess.run(
        [*command, "--out", str(tmp_path / "run")], capture_output=True, text=True, check=False, timeout=600
    )
    assert told.returncode == 2
    assert "broken.mcap" in told.stderr
    assert "Traceback" not in told.stderr
