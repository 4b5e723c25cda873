"""A `gnd fleet` in a process of its own, to be watched, killed and read."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

RUN_TIMEOUT_S = 240
SEED = 11
"""Of the street of `small_world`."""


class Run:
    """A `gnd fleet` in a process of its own."""

    def __init__(self, folder: Path, *arguments: str, timeout_s: float = RUN_TIMEOUT_S) -> None:
        self.folder, self.timeout_s = folder, timeout_s
        self.process = subprocess.Popen(
            [sys.executable, "-m", "gnd.deploy.cli", "fleet", "--out", str(folder), *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def pid(self, name: str) -> int:
        pids: dict[str, int] = json.loads((self.folder / "pids.json").read_text())
        return pids[name]

    def kill(self, name: str) -> int:
        """kill -9 of one process of the run."""
        pid = self.pid(name)
        os.kill(pid, signal.SIGKILL)
        return pid

    def wait_for(self, condition: Callable[[], bool], what: str) -> None:
        deadline_s = time.monotonic() + self.timeout_s
        while not condition():
            assert self.process.poll() is None, f"the run ended before {what}:\n{self.logs()}"
            assert time.monotonic() < deadline_s, f"not within {self.timeout_s} s: {what}\n{self.logs()}"
            time.sleep(0.05)  # between two looks; the deadline above bounds the wait

    def finish(self) -> dict[str, Any]:
        """Wait for the end and return the summary."""
        out, err = self.process.communicate(timeout=self.timeout_s)
        assert self.process.returncode == 0, f"{out}\n{err}\n{self.logs()}"
        summary: dict[str, Any] = json.loads((self.folder / "summary.json").read_text())
        return summary

    def driving(self) -> bool:
        """Tell whether an agent has downloaded a tile."""
        return any(path.stat().st_size > 0 for path in self.folder.glob("ledger/*.jsonl"))

    def logs(self) -> str:
        parts = [f"== {path.name}\n{path.read_text()[-1500:]}" for path in sorted(self.folder.glob("logs/*.log"))]
        return "\n".join(parts)
