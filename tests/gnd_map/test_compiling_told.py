"""Who waits at a terminal for a kernel that the disk does not hold yet hears it; who finds it there hears nothing."""

import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

from gnd.deploy.compiling import watched_elsewhere

PROGRAM = """
from gnd.deploy import compiling
from gnd.gnd_map.jit import kernel, tell_compiling
names = []
tell_compiling(names.append)
compiling.EVERY_S = 0.0
tell_compiling(compiling.say_progress())
from own_kernels import outer
print(outer(2), sorted(set(names)))
"""
KERNELS = """
from gnd.gnd_map.jit import kernel

@kernel
def inner(x):
    return x + 1

@kernel
def outer(x):
    return 2 * inner(x)
"""


def run(folder: Path) -> tuple[str, str]:
    """What a first use of the kernels prints, and what the terminal behind its standard error shows."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*sys.path, str(folder)])}
    screen, terminal = pty.openpty()
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env=environment,
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=terminal,
        check=True,
    )
    os.write(terminal, b"end")
    os.close(terminal)
    with os.fdopen(screen, "rb", buffering=0) as shown:
        text = b""
        while not text.endswith(b"end"):
            text += shown.read(4096)
    return done.stdout.decode().strip(), text.decode().removesuffix("end")


def test_the_first_run_at_a_terminal_says_so_once_and_the_second_nothing(tmp_path: Path) -> None:
    (tmp_path / "own_kernels.py").write_text(KERNELS)
    told, shown = run(tmp_path)
    assert told == "6 ['inner', 'outer']"
    assert shown.count("compiling kernels for this machine") == 1
    assert "gnd: 0 of at most 2 kernels are ready, compiling inner" in shown
    assert run(tmp_path) == ("6 []", "")


def test_who_reads_the_lines_of_errors_reads_nothing_of_it(tmp_path: Path) -> None:
    (tmp_path / "own_kernels.py").write_text(KERNELS)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*sys.path, str(tmp_path)])}
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert (done.stdout.strip(), done.stderr) == ("6 ['inner', 'outer']", "")


def test_a_process_that_waits_for_another_ones_kernels_sees_how_many_are_ready(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_kernels.py").write_text(KERNELS)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([*sys.path, str(tmp_path)]))
    program = (
        "from gnd.deploy.compiling import tell_watcher; tell_watcher()\n"
        "from own_kernels import outer; outer(2); import time; time.sleep(1.0)"
    )

    def watched() -> set[tuple[int, int]]:
        shown: set[tuple[int, int]] = set()
        with watched_elsewhere(lambda ready, known: shown.add((ready, known))):
            subprocess.run([sys.executable, "-c", program], cwd=tmp_path, check=True)
        return shown

    assert set() < watched() <= {(0, 2), (1, 2)}
    assert watched() == set()  # the disk holds them
    assert "GND_COMPILING" not in os.environ
