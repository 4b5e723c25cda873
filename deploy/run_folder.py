"""The folder of one run: where each of its files lies."""

import json
import shutil
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from gnd.deploy.errors import RunFolderError

MARK = "run.json"


@dataclass(frozen=True, slots=True)
class RunFolder:
    """Paths within `runs/NAME`.

    Attributes:
        root: the folder itself.
    """

    root: Path

    @property
    def logs(self) -> Path:
        """Folder of one log file per process."""
        return self.root / "logs"

    @property
    def world(self) -> Path:
        """Folder of the simulated world: truth and drives."""
        return self.root / "world"

    @property
    def imported(self) -> Path:
        """Folder of the drives that recordings became; it stays after the run."""
        return self.root / "imported"

    @property
    def agents(self) -> Path:
        """Folder of one work folder per vehicle."""
        return self.root / "agents"

    @property
    def ledger(self) -> Path:
        """Folder of one traffic ledger per vehicle."""
        return self.root / "ledger"

    @property
    def clock(self) -> Path:
        """The time that the vehicles have in common, see `gnd.vehicle_agent.sources.world_clock`."""
        return self.root / "clock.bin"

    def way(self, vehicle: str) -> Path:
        """Which map a vehicle drove on where, see `gnd.vehicle_agent.way`."""
        return self.agents / vehicle / "way.jsonl"

    def result(self, vehicle: str) -> Path:
        """What a vehicle says of its drive when it has ended."""
        return self.agents / vehicle / "result.json"

    @property
    def store(self) -> Path:
        """The tile store: every version, every report."""
        return self.root / "store.sqlite"

    @property
    def updates(self) -> Path:
        """What the watcher received, one JSON object a line."""
        return self.root / "updates.jsonl"

    @property
    def summary(self) -> Path:
        """The result of the run."""
        return self.root / "summary.json"

    @property
    def traffic_page(self) -> Path:
        """The account of the run's traffic as a page."""
        return self.root / "traffic.html"

    @property
    def pids(self) -> Path:
        """Process ids by process name."""
        return self.root / "pids.json"

    @property
    def endpoint(self) -> Path:
        """The endpoint of the run's router, for who wants to follow it."""
        return self.root / "endpoint.txt"

    @property
    def mark(self) -> Path:
        """The file that says that this folder is a run, with its effective configuration."""
        return self.root / MARK

    def write_mark(self, content: dict[str, Any]) -> None:
        """Write the effective configuration of the run."""
        self.mark.write_text(json.dumps(content, indent=2, default=str) + "\n", encoding="utf-8")


def default_run_path() -> Path:
    """Return `runs/<UTC time>`, relative to the current folder."""
    return Path("runs") / datetime.now(UTC).strftime("%Y%m%d-%H%M%S")


def create_run_folder(root: Path, *, overwrite: bool = False) -> RunFolder:
    """Make the folder of a run.

    Args:
        root: the folder to make.
        overwrite: replace an earlier run of that name; anything that is not a run is never removed.

    Returns:
        The paths of the run.

    Raises:
        RunFolderError: the folder exists and is in use, or cannot be written.
    """
    folder = RunFolder(root)
    try:
        if root.exists():
            _clear(folder, overwrite=overwrite)
        for path in (root, folder.logs, folder.world, folder.agents, folder.ledger):
            path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFolderError(f"cannot write to {root}: {error.strerror}; choose another folder with --out") from error
    return folder


def _clear(folder: RunFolder, *, overwrite: bool) -> None:
    root = folder.root
    if not root.is_dir():
        raise RunFolderError(f"{root} is a file; choose another folder with --out")
    if not any(root.iterdir()):
        return
    if not overwrite:
        raise RunFolderError(f"{root} is not empty; choose another folder with --out, or replace a run by --overwrite")
    if not folder.mark.exists():
        raise RunFolderError(f"{root} holds no run ({MARK} is missing), so it is not overwritten")
    shutil.rmtree(root)
