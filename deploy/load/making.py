"""The drives that are replayed where none are given: made once by a fleet run, and kept."""

from pathlib import Path
from typing import Final

from rich.console import Console

from deploy.fleet_cli import run as run_fleet
from deploy.fleet_config import FleetConfig
from deploy.load.drives import read_street
from deploy.load.errors import LoadError
from deploy.run_folder import create_run_folder
from deploy.source import Source

DRIVES: Final = Path("runs/load-drives")
AGENTS: Final = 4
WORLD_SEED: Final = 21
MERGE_DELAY_S: Final = 45.0
"""So late that no vehicle of the run drives on what another one has found."""


def kept_run(drives: Path | None, console: Console) -> Path:
    """The run whose drives are replayed: the one given, else that in `runs/load-drives`, which is made where missing.

    Raises:
        LoadError: the run that was made has no drives that can be replayed.
    """
    if drives is not None:
        return drives
    if not (DRIVES / "summary.json").exists():
        console.print(f"no --drives: {AGENTS} vehicles drive once, into {DRIVES}")
        config = FleetConfig(
            agents=AGENTS,
            headway_s=0.0,
            link="none",
            world_seed=WORLD_SEED,
            merge_delay_s=MERGE_DELAY_S,
            merge_after_reports=1000,
        )
        folder = create_run_folder(DRIVES, overwrite=True)
        folder.write_mark({"made_by": "gnd load"})
        run_fleet(config, folder, Source(agents=AGENTS), keep_drives=False)
    if read_street(DRIVES).reports == 0:
        raise LoadError(f"{DRIVES} holds no reports")
    return DRIVES
