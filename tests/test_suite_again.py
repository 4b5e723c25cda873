"""What failed among others runs once more alone, and only a test that then passes is forgiven."""

import subprocess
import sys
from pathlib import Path

import pytest
from suite_again import AT_MOST, failed_tests

AGAIN = Path(__file__).with_name("suite_again.py")
LATE = """
from pathlib import Path
def test_late():
    seen = Path("seen")
    was_there = seen.exists()
    seen.touch()
    assert was_there
def test_good():
    pass
"""
WRONG = "def test_wrong():\n    assert 1 == 2\n"


def suite(folder: Path, **files: str) -> tuple[int, str]:
    """Run a suite of these files as `make test` does: its status, and what the second run said."""
    for name, text in files.items():
        (folder / f"test_{name}.py").write_text(text, encoding="utf-8")
    (folder / "pytest.ini").write_text("[pytest]\n", encoding="utf-8")
    first = subprocess.run([sys.executable, "-m", "pytest", "-q"], cwd=folder, capture_output=True, check=False)
    again = [sys.executable, str(AGAIN), str(first.returncode), "-q"]
    second = subprocess.run(again, cwd=folder, capture_output=True, text=True, check=False)
    return second.returncode, second.stdout


@pytest.mark.slow
def test_who_was_late_is_forgiven_and_named(tmp_path: Path) -> None:
    status, said = suite(tmp_path, late=LATE)
    assert status == 0
    assert "1 passed" in said  # the good one does not run again
    assert said.rstrip().endswith("test_late.py::test_late")


@pytest.mark.slow
def test_who_fails_again_fails_the_run(tmp_path: Path) -> None:
    status, said = suite(tmp_path, late=LATE, wrong=WRONG)
    assert status == 1
    assert "1 failed, 1 passed" in said
    assert "passed alone" not in said


@pytest.mark.slow
def test_many_failures_and_other_errors_stay(tmp_path: Path) -> None:
    many = "\n".join(f"def test_{k}():\n    assert False" for k in range(AT_MOST + 1))
    assert suite(tmp_path, many=many) == (1, "")
    assert suite(tmp_path, broken="this is no Python") == (2, "")
    assert failed_tests(tmp_path / "no file") == []
