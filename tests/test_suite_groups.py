"""Tests that share something run in one process, the longest first, and are named as one may call them."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
CONFTEST = "from suite_groups import *\n"
WORLD = "import pytest\n@pytest.fixture(scope='session')\ndef world():\n    return 1\n"
NOTE = "    open(__file__ + '.worker', 'a').write(os.environ.get('PYTEST_XDIST_WORKER', 'none') + ' ')\n"
SLOW = "@pytest.mark.slow\n@pytest.mark.parametrize('n', range(3))\n"
MODULES = {
    "street/test_one.py": f"def test_one(world):\n{NOTE}",
    "street/test_two.py": f"def test_two(world):\n{NOTE}",
    "other/test_world.py": f"def test_world(world):\n{NOTE}",
    "test_run.py": f"pytestmark = pytest.mark.xdist_group('fleets')\n\ndef test_run():\n{NOTE}",
    "test_lab.py": f"{SLOW}@pytest.mark.xdist_group('fleets')\ndef test_lab(n):\n{NOTE}",
    "test_wrong.py": f"def test_wrong():\n{NOTE}    assert False, 'a@b'\n",
    **{f"test_quick_{n}.py": f"def test_quick():\n{NOTE}" for n in range(6)},
}


pytestmark = pytest.mark.slow


@pytest.fixture
def suite(tmp_path: Path) -> Path:
    """A small suite in a folder of its own."""
    shutil.copy(HERE / "suite_groups.py", tmp_path)
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers =\n  slow: slow\n")
    for name, text in MODULES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(f"import os\nimport pytest\n\n{text}")
        (tmp_path / name).with_name("conftest.py").touch()
    for folder in ("street", "other"):
        (tmp_path / folder / "conftest.py").write_text(WORLD)
    return tmp_path


def ran(suite: Path, *arguments: str) -> str:
    alone = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-v", "-p", "no:cacheprovider", *arguments, str(suite)],
        capture_output=True, text=True, cwd=suite, check=False, timeout=120, env=alone,
    )  # fmt: skip
    assert "1 failed, 13 passed" in done.stdout, done.stdout + done.stderr
    return done.stdout


def worker_of(suite: Path, name: str) -> set[str]:
    return set((suite / f"{name}.worker").read_text().split())


def test_what_is_shared_stays_in_one_process_and_failures_can_be_called_again(suite: Path) -> None:
    shown = ran(suite, "-n", "2", "--dist", "loadscope")
    assert worker_of(suite, "street/test_one.py") == worker_of(suite, "street/test_two.py")
    fleets = worker_of(suite, "test_run.py")
    assert fleets == worker_of(suite, "test_lab.py")
    assert len(fleets) == 1
    assert {"gw0", "gw1"} == set().union(*(worker_of(suite, name) for name in MODULES)), "both had work"
    assert re.search(r"^FAILED test_wrong\.py::test_wrong - AssertionError: a@b", shown, re.M)
    first = next(line for line in shown.splitlines() if "PASSED" in line and next(iter(fleets)) in line)
    assert "test_lab.py" in first, "the longest begin"


def test_one_process_runs_everything_in_the_usual_order(suite: Path) -> None:
    shown = ran(suite)
    order = re.findall(r"^(\S+)::\S+ (?:PASSED|FAILED)", shown, re.M)
    assert order == sorted(order, key=order.index)
    assert worker_of(suite, "test_lab.py") == {"none"}
