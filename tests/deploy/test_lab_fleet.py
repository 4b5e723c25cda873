"""A whole fleet in a lab: vehicles in namespaces, links shaped, the ledgers held against the interfaces."""

import json
import os
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import psutil
import pytest
from lab_testing import has_namespaces, needs_root, own_name, profile_file, started, wait_until

from gnd.deploy.lab.devices import MTU_BYTES

if TYPE_CHECKING:
    from conftest import SmallWorld

pytestmark = [needs_root, pytest.mark.slow, pytest.mark.xdist_group("hosts")]

RUN_TIMEOUT_S = 280
PROFILES = """
[far]
down_bit_s = 20e6
up_bit_s = 8e6
delay_ms = 15
jitter_ms = 3
loss = 0.01
send_buffer_bytes = 65536

[near]
down_bit_s = 50e6
up_bit_s = 10e6
"""


def arguments(world: "SmallWorld", folder: Path, name: str) -> list[str]:
    file = profile_file(folder, PROFILES)
    drives = [word for drive in world.drives for word in ("--drives", str(drive))]
    groups = f"{file}:far:1,{file}:near:1"
    out = str(folder / "run")
    return ["--groups", groups, "--name", name, *drives, "--map", str(world.base_map), "--out", out]


def test_a_fleet_over_shaped_links_accounts_for_every_byte(small_world: "SmallWorld", tmp_path: Path) -> None:
    name = own_name()
    with started(*arguments(small_world, tmp_path, name), "--relay", "--json") as process:
        out, err = process.communicate(timeout=RUN_TIMEOUT_S)
    assert process.returncode == 0, err
    summary: dict[str, Any] = json.loads(out)
    assert summary["reports_lost"] == 0
    assert summary["reports_sent"] == summary["reports_acknowledged"] > 0
    far, near = summary["lab"]["groups"]
    assert (far["carried_by"], near["carried_by"]) == ("relay", "kernel")
    for direction in ("up", "down"):
        assert near[direction]["agrees"], near
        # A relay that a busy machine holds up makes TCP send a few segments twice, of few in all.
        apart = abs(far[direction]["interface_bytes"] - far[direction]["ledger_bytes"])
        assert apart <= 0.05 * far[direction]["interface_bytes"] + 5 * MTU_BYTES, far
    # A vehicle's result is written before its connection ends, its ledger after.
    assert far["up"]["ledger_bytes"] + near["up"]["ledger_bytes"] >= summary["traffic"]["up_wire_bytes"] > 0
    assert far["round_trip_ms"] is None or far["shortest_ms"] >= 2 * 12
    assert json.loads((tmp_path / "run" / "lab.json").read_text()) == summary["lab"]
    assert not has_namespaces(name)


def test_ctrl_c_ends_the_fleet_and_removes_its_lab(small_world: "SmallWorld", tmp_path: Path) -> None:
    name = own_name()
    with started(*arguments(small_world, tmp_path, name)) as process:
        pids = tmp_path / "run" / "pids.json"
        wait_until(lambda: "vehicle-01" in (pids.read_text() if pids.exists() else ""), "the vehicles have started")
        running = [psutil.Process(pid) for pid in json.loads(pids.read_text()).values()]
        assert {"link-far", "router"} <= json.loads(pids.read_text()).keys()
        os.kill(process.pid, signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert err.strip().endswith("gnd: interrupted")
    _, alive = psutil.wait_procs(running, timeout=10)
    assert alive == []
    assert not has_namespaces(name)
