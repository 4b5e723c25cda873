"""`gnd lab check` and `gnd lab clean` as commands: their output, their refusals, and what killed ones leave."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from lab_testing import finished, gnd_lab, has_namespaces, needs_root, own_name, profile_file, started, wait_until

from gnd.deploy.lab.lab import lab_lock, namespaces_of
from gnd.deploy.lab.namespaces import add_namespace
from gnd.deploy.lab.tools import TUN_DEVICE

pytestmark = pytest.mark.xdist_group("hosts")

TINY = "[tiny]\ndown_bit_s = 2e6\nup_bit_s = 1e6\ndelay_ms = 10\njitter_ms = 2\nloss = 0.02\n"
PROJECT = Path(__file__).resolve().parents[2]


NOBODY = """
import os, sys
import gnd.deploy.lab.command
from gnd.deploy.cli import main
if os.geteuid() == 0:
    os.setuid(65534)
sys.argv = ["gnd", "lab", *sys.argv[1:]]
main()
"""


@pytest.mark.parametrize("arguments", [("check",), ("clean",)])
def test_without_the_right_it_is_refused(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    script = tmp_path / "nobody.py"
    script.write_text(NOBODY)
    done = subprocess.run(
        [sys.executable, str(script), *arguments], capture_output=True, text=True, timeout=60, check=False,
        env={**os.environ, "PYTHONPATH": str(PROJECT / "src")},
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    assert "gnd: network namespaces need root, this is user" in done.stderr
    assert "run it with sudo" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--groups", "6g:1"), "no link profile '6g'; there are: none, 3g, 4g, 5g"),
        (("--groups", "4g"), "group '4g' is not like 4g:2"),
        (("--map", "x"), "--map goes with --drives"),
        (("check", "--links", ""), "hold 0 vehicles"),
    ],
)
def test_what_cannot_work_is_refused_before_anything_is_made(arguments: tuple[str, ...], words: str) -> None:
    code, out, err = finished(gnd_lab(*arguments))
    assert (code, out) == (2, "")
    assert err.startswith("gnd: ")
    assert words in err


@needs_root
def test_without_its_tools_it_is_refused(tmp_path: Path) -> None:
    code, _, err = finished(gnd_lab("clean", env={**os.environ, "PATH": str(tmp_path)}))
    assert (code, err) == (2, "gnd: ip and tc and ss missing: install iproute2\n")


@needs_root
@pytest.mark.slow
def test_check_measures_each_direction(tmp_path: Path) -> None:
    file, name = profile_file(tmp_path, TINY), own_name()
    arguments = ("check", "--links", str(file), "--seconds", "0.5", "--name", name, "--relay", "--json")
    code, out, err = finished(gnd_lab(*arguments))
    assert code == 0, err
    values = json.loads(out)
    assert values["tcp_congestion_control"]
    down, up = values["links"]
    assert (down["profile"], down["direction"], up["direction"]) == ("tiny", "down", "up")
    assert (down["wanted_bit_s"], up["wanted_bit_s"]) == (2e6, 1e6)
    for link in (down, up):
        assert link["stream"]["delay_ms"][0] >= 8
        assert link["stream"]["sent"] > link["stream"]["lost"]
        assert link["rate_bit_s"] > 0
        assert link["tcp"]["bit_s"] > 0
    assert not has_namespaces(name)


@needs_root
def test_interrupted_it_leaves_nothing(tmp_path: Path) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        name = own_name()
        links = str(profile_file(tmp_path, TINY))
        with started("check", "--links", links, "--seconds", "60", "--name", name) as process:
            wait_until(lambda name=name: len(namespaces_of(name)) == 2, "the lab is there")  # type: ignore[misc]
            process.send_signal(number)
            code, _, err = finished(process)
        assert code == 128 + number
        assert "gnd: interrupted" in err.splitlines()  # a relay that was just starting may complain behind it
        assert not has_namespaces(name)


@needs_root
def test_clean_removes_what_a_killed_lab_left_and_nothing_else(tmp_path: Path) -> None:
    name, running = own_name(), own_name()
    arguments = ("--links", str(profile_file(tmp_path, TINY)), "--seconds", "60", "--name", name, "--relay")
    with started("check", *arguments) as process:
        wait_until(lambda: bool(list_relays(process.pid)), "its relay runs")
        children = psutil.Process(process.pid).children(recursive=True)
        process.kill()
    assert has_namespaces(name)
    left = subprocess.Popen(["ip", "netns", "exec", f"gndlab.{name}.cloud", "sleep", "600"])
    code, _, err = finished(gnd_lab("check", *arguments))
    assert code == 2
    assert f"an earlier lab '{name}' left 2 namespaces: remove them with `gnd lab clean`" in err
    with lab_lock(running):
        add_namespace(f"gndlab.{running}.cloud")
        code, out, err = finished(gnd_lab("clean"))
        assert code == 0, err
        assert f"{name}: 2 namespaces removed" in out
        assert f"{running} runs: left alone" in out
        assert has_namespaces(running)
        assert not has_namespaces(name)
    code, out, _ = finished(gnd_lab("clean"))  # its lock is free again
    assert (code, has_namespaces(running)) == (0, False)
    assert left.wait(timeout=30) == -signal.SIGTERM  # what still ran in there has been ended
    _, alive = psutil.wait_procs(children, timeout=30)
    assert alive == []


def list_relays(launcher: int) -> list[int]:
    """Processes of a launcher that hold a TUN interface open."""
    children = psutil.Process(launcher).children(recursive=True)
    return [process.pid for process in children if TUN_DEVICE in open_files(process.pid)]


def open_files(pid: int) -> set[Path]:
    found = set()
    for entry in Path(f"/proc/{pid}/fd").glob("*"):
        with contextlib.suppress(OSError):  # closed meanwhile
            found.add(entry.readlink())
    return found
