"""A whole run, short: one fault of every kind, close together, and the command's end."""

import json
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from gnd.deploy.chaos.faults import KINDS, plan
from gnd.deploy.chaos.run import run_chaos
from gnd.deploy.chaos.service import SERVICES

pytestmark = pytest.mark.xdist_group("fleets")

SEED = 1_003
APART_S = (0.3, 0.5)


@pytest.mark.slow
def test_a_cloud_keeps_its_word_through_one_fault_of_every_kind(tmp_path: Path) -> None:
    kinds = tuple(kind for kind in KINDS if kind.held_s[0] < 2.0)
    outcome = run_chaos(SEED, plan(SEED, len(kinds), kinds, APART_S), tmp_path / "run")
    told = outcome.as_dict()
    assert outcome.failures == []
    assert list(told)[:7] == [
        "acknowledged", "lost", "doubled", "torn_tiles", "stuck_tiles", "identical_map", "max_gap_s",
    ]  # fmt: skip
    assert (told["lost"], told["doubled"], told["torn_tiles"], told["stuck_tiles"]) == (0, 0, 0, 0)
    assert told["identical_map"] is True
    assert told["acknowledged"] > 20
    assert told["versions"] > 20
    assert set(told["max_gap_s"]) == set(SERVICES)
    assert Counter(row["kind"] for row in told["list"]) == {kind.name: 1 for kind in kinds}
    # each of the three is told to a few milliseconds
    assert all(row["ended_s"] >= row["began_s"] + row["held_s"] - 0.01 for row in told["list"])
    assert set(told["restarts"]) >= {"router", "store"}, "they were killed"


@pytest.mark.slow
def test_the_command_ends_early_and_cleanly_and_tells_what_was_found(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "gnd.deploy.cli", "chaos", "--kills", "500", "--seed", "9"]
    file, out = tmp_path / "chaos.json", tmp_path / "run"
    process = subprocess.Popen(
        [*command, "--json", str(file), "--out", str(out)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    deadline_s = time.monotonic() + 60.0
    while not list((out / "vehicles").glob("vehicle-*.sqlite")):
        assert time.monotonic() < deadline_s
        assert process.poll() is None
        time.sleep(0.1)
    time.sleep(5.0)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=90.0)
    told = json.loads(file.read_text())
    assert process.returncode == (1 if told["failures"] else 0), stderr
    assert told["interrupted"] is True
    assert told["faults"] < 500
    assert (told["lost"], told["doubled"], told["torn_tiles"]) == (0, 0, 0)
    assert "interrupted: " in stdout
    assert "Traceback" not in stderr
