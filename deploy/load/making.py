"""The drives that are replayed where none are given: made once by two fleet runs, and kept.

In the first run four vehicles drive along a simulated street on the map of before its changes. In the second one they
make the same drives again, on the map that the first run has healed: what they report of a settled street.
"""

from pathlib import Path
from typing import Final

from rich.console import Console

from gnd.deploy.errors import LoadError
from gnd.deploy.fleet_cli import run as run_fleet
from gnd.deploy.fleet_config import FleetConfig
from gnd.deploy.load.drives import KeptRuns, healed_map
from gnd.deploy.run_folder import RunFolder, create_run_folder
from gnd.deploy.source import Source
from gnd.tile_store.sqlite_store import SqliteStore

DRIVES: Final = Path("runs/load-drives")
AGENTS: Final = 4
WORLD_SEED: Final = 21
MERGE_DELAY_S: Final = 45.0
"""So late that no vehicle of a run drives on what another one has found."""


def kept_runs(changed: Path | None, settled: Path | None, console: Console) -> KeptRuns:
    """The runs whose drives are replayed: those given, else those in `runs/load-drives`, made where they are missing.

    Raises:
        LoadError: only the run on the settled map is given.
        DeployError: a run cannot be made.
    """
    if changed is not None:
        return KeptRuns(changed, settled)
    if settled is not None:
        raise LoadError("--settled goes with --drives: both are runs of the same street")
    made = KeptRuns(DRIVES / "changed", DRIVES / "settled")
    first, second = RunFolder(DRIVES / "changed"), RunFolder(DRIVES / "settled")
    if not first.summary.exists():
        console.print(f"no --drives: {AGENTS} vehicles drive along a changed street, into {first.root}")
        _drive(first.root, Source(agents=AGENTS))
    if not second.summary.exists():
        console.print(f"... and once more, on the map that they have healed, into {second.root}")
        healed = DRIVES / "healed.sqlite"
        _put_healed(first, healed)
        drives = tuple(sorted((first.world / "drives").glob("vehicle-*.mcap")))
        _drive(second.root, Source(drives=drives, base_map=healed, agents=AGENTS))
        for drive in drives:  # some hundred MB
            drive.unlink()
    return made


def _drive(root: Path, source: Source) -> None:
    config = FleetConfig(
        agents=AGENTS,
        headway_s=0.0,
        link="none",
        world_seed=WORLD_SEED,
        merger={"store": {"merge_delay_s": MERGE_DELAY_S, "merge_after_reports": 1000}},
    )
    folder = create_run_folder(root, overwrite=True)
    folder.write_mark({"made_by": "gnd load"})
    run_fleet(config, folder, source, keep_drives=True)


def _put_healed(run: RunFolder, path: Path) -> None:
    """Write the newest map of a run into a store of its own, as a base."""
    for leftover in path.parent.glob(f"{path.name}*"):
        leftover.unlink()
    with SqliteStore(path) as store:
        store.put_tiles(healed_map(run).values())
