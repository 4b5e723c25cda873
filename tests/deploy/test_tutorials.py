"""docs/tutorials: every command of the three pages runs, and prints what its page shows.

The folders and bags are those of KITTI's drive 0027. A run of a fleet hangs on when reports meet, so its counts are
compared within a third; that the map is healed is asked of the files beside.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from console_pages import ShownCommand, check_printed, commands_of
from tutorial_folders import NAME, SCANS, bags_of_two_days, kitti_folder

pytestmark = [pytest.mark.slow, pytest.mark.timeout(420)]  # on a busy machine
ROOT = Path(__file__).resolve().parents[2]
TUTORIALS = ROOT / "docs" / "tutorials"
PORT = 7447  # of the page
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "COLUMNS": "120"}
FEW = {"rel": 0.34, "off": 5.0}
"""Of what hangs on the order of reports, and of counts of voxels that one report more or less tips over."""


def started(words: list[str], cwd: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "gnd.deploy.cli", *words[1:]], cwd=cwd, env=ENVIRONMENT, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def ran(command: ShownCommand, cwd: Path, more: tuple[str, ...] = ()) -> str:
    """What a command of a page prints on standard output."""
    assert command.words[0] == "gnd"
    process = started([*command.words, *more], cwd)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, f"$ {command.line}\n{out}\n{err}"
    return out


def check_page(commands: list[ShownCommand], cwd: Path) -> None:
    """Run commands one after the other, each named by the output before it or by the page."""
    for command in commands:
        check_printed(command, ran(command, cwd), **(FEW if named(command) in ("fleet", "diff", "view") else {}))


def named(command: ShownCommand) -> str:
    """Which command it is: map build and map diff by their second word."""
    return command.words[2] if command.words[1] == "map" else command.words[1]


def test_a_stranger_heals_a_map_of_one_kitti_folder(shared_data: Path, tmp_path: Path) -> None:
    commands = commands_of(TUTORIALS / "kitti_folder.md")
    folder = kitti_folder(shared_data, tmp_path)
    assert folder.name == NAME
    check_page(commands, folder.parent)
    summary = json.loads((folder.parent / "healed" / "summary.json").read_text())
    assert summary["reports_lost"] == 0
    assert summary["made_up"]["boxes"] == summary["made_up"]["boxes_in_map"] == 4
    assert summary["made_up"]["changes_elsewhere"] <= 8
    for name in ("healed/map_after.png", "changes.gpkg", "healed.rrd", "healed.laz"):
        assert (folder.parent / name).stat().st_size > 1000
    assert [named(command) for command in commands[:2]] == ["build", "fleet"]  # two commands from folder to healed map
    assert f"  or, without another day: {commands[1].line} (" in "\n".join(commands[0].shown)
    assert f"next: {commands[2].line} (" in "\n".join(commands[1].shown)


@pytest.fixture(scope="module")
def two_days(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Bags `monday` and `tuesday`, and the map of monday."""
    folder = tmp_path_factory.mktemp("two_days")
    bags_of_two_days(shared_data, folder)
    return folder


def linked(two_days: Path, cwd: Path) -> None:
    for bag in ("monday", "tuesday"):
        (cwd / bag).symlink_to(two_days / bag)


def test_a_stranger_heals_a_map_of_two_bags(two_days: Path, tmp_path: Path) -> None:
    linked(two_days, tmp_path)
    commands = commands_of(TUTORIALS / "ros2_bag.md")
    check_page(commands, tmp_path)
    assert [named(command) for command in commands[:2]] == ["build", "fleet"]
    changes = json.loads((tmp_path / "changes.geojson").read_text())["features"]
    assert sum(change["properties"]["change"] == "new" for change in changes) >= 2
    assert (tmp_path / "autoware" / "pointcloud_map_metadata.yaml").is_file()


@contextmanager
def running(commands: list[ShownCommand], cwd: Path, port: int) -> Iterator[list[subprocess.Popen[str]]]:
    """The commands of the cloud, on another port than the page's; ended as by Ctrl-C."""
    processes = [started([*one.words, *on_port(one, port)], cwd) for one in commands]

    def end() -> None:
        for process in processes:
            process.send_signal(signal.SIGINT)
        for process in processes:
            process.wait(timeout=30)

    try:
        yield processes
    except BaseException:
        end()
        for process in processes:
            print(*process.communicate())
        raise
    end()


def on_port(command: ShownCommand, port: int) -> tuple[str, ...]:
    endpoint = f"tcp/127.0.0.1:{port}"
    sensors = ("--set", f'live.connect=["{endpoint}"]') if named(command) == "agent" else ()
    return ("--listen" if named(command) == "router" else "--connect", endpoint, *sensors)


def test_a_live_vehicle_heals_the_map_over_a_real_router(two_days: Path, tmp_path: Path, free_port: int) -> None:
    linked(two_days, tmp_path)
    commands = {named(command): command for command in commands_of(TUTORIALS / "live_vehicle.md")}
    cloud = [commands[name] for name in ("router", "store", "merger")]
    check_page([commands["build"], commands["backup"]], tmp_path)
    with running(cloud, tmp_path, free_port) as processes:
        agent = started([*commands["agent"].words, *on_port(commands["agent"], free_port)], tmp_path)
        check_printed(commands["play"], ran(commands["play"], tmp_path, on_port(commands["play"], free_port)))
        out, err = agent.communicate(timeout=300)
        assert agent.returncode == 0, err
        check_printed(commands["agent"], out, **FEW)
        result = json.loads((tmp_path / "runs" / "car-7" / "result.json").read_text())
        assert result["scans"] + result["live"]["scans_left_out"] == SCANS
        assert result["live"]["scans_left_out"] <= SCANS // 4  # a busy machine does not keep up with the sensor
        wait_for_merges(tmp_path / "map.sqlite")
        check_printed(commands["diff"], ran(commands["diff"], tmp_path), **FEW)
    for command, process in zip(cloud, processes, strict=True):
        out, err = process.communicate()
        printed = (out + err).replace(str(free_port), str(PORT))
        check_printed(command, printed)
    assert set(commands) == {"build", "backup", "router", "store", "merger", "agent", "play", "diff"}


def wait_for_merges(store: Path, most_s: float = 20.0) -> None:
    """Until no report waits to be merged."""
    until_s = time.monotonic() + most_s
    while time.monotonic() < until_s:
        status = subprocess.run(
            [sys.executable, "-m", "gnd.deploy.cli", "map", "status", str(store), "--json"],
            env=ENVIRONMENT, capture_output=True, text=True, check=True,
        )  # fmt: skip
        if not json.loads(status.stdout)["queue"]["tiles"]:
            return
        time.sleep(0.2)  # between two looks; the deadline above bounds the wait
    raise AssertionError(f"reports still wait after {most_s} s: {status.stdout}")
