"""Run the tests that failed once more, by themselves: what `make test` does where a few failed side by side.

    python tests/suite_again.py STATUS [ARGUMENTS of pytest ...]

Many tests wait for real processes, and three of them share what cores there are. A test that fails among others and
passes alone was late, or depends on another one. It is named in the last lines, so that somebody looks for the cause;
a test that fails again fails the run. More than `AT_MOST` failures are no bad luck, and nothing is run again.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Final

AT_MOST: Final = 8
FAILED: Final = Path(".pytest_cache/v/cache/lastfailed")
_TESTS_FAILED: Final = 1  # of pytest's statuses: others are errors of its own, a Ctrl-C, or no test at all


def failed_tests(file: Path) -> list[str]:
    """The tests that failed in the last run, as pytest has written them down; nothing where it wrote nothing."""
    return sorted(json.loads(file.read_text(encoding="utf-8"))) if file.is_file() else []


def run_again(status: int, arguments: list[str], *, file: Path = FAILED) -> int:
    """The status of the whole run, after those that failed have run once more in one process."""
    failed = failed_tests(file)
    if status != _TESTS_FAILED or not 0 < len(failed) <= AT_MOST:
        return status
    print(f"\n{len(failed)} tests failed side by side; once more, by themselves:", flush=True)
    alone = subprocess.run([sys.executable, "-m", "pytest", "--last-failed", *arguments], check=False).returncode
    if alone == 0:
        print("passed alone, failed side by side (look for the cause):", *failed, sep="\n  ", flush=True)
    return alone


if __name__ == "__main__":
    raise SystemExit(run_again(int(sys.argv[1]), sys.argv[2:]))
