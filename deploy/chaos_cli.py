"""`gnd chaos`: inject seeded faults into a whole cloud of real processes, and check its guarantees."""

import json
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console
from rich.table import Table

from gnd.deploy.errors import ChaosError
from gnd.deploy.interruption import ending_in_order

if TYPE_CHECKING:
    from gnd.deploy.chaos.run import ChaosOutcome

PATH = click.Path(path_type=Path)
WIDTH = 120


@click.command()
@click.option("--kills", type=click.IntRange(1, 10_000), default=60, show_default=True, help="Faults, some 2 s apart.")
@click.option("--seed", type=int, default=1, show_default=True, help="Draws faults and reports.")
@click.option("--json", "json_file", type=PATH, help="Write the outcome to this file; - prints it.")
@click.option("--out", type=PATH, help="Keep store, outboxes and logs in this folder.  [default: only if it failed]")
def chaos(kills: int, seed: int, json_file: Path | None, out: Path | None) -> None:
    """Inject faults into the parts of a cloud and its clients while they work; then check what is left.

    The exit code is 1 if a report was lost or duplicated, a tile is torn or stuck, or the map differs from its journal.
    Ctrl-C ends the faults; everything up to then is checked and printed.
    """
    # The heavy imports wait until the options have been found good.
    from gnd.deploy.chaos.faults import plan
    from gnd.deploy.chaos.run import run_chaos
    from gnd.deploy.live import progress_bars

    console = Console(stderr=True)
    folder = _folder(out)
    with ending_in_order() as stop, progress_bars(console) as progress:
        task = progress.add_task("starting", total=kills)
        outcome = run_chaos(
            seed, plan(seed, kills), folder, stop,
            lambda what, n: progress.update(task, description=what, completed=n),
        )  # fmt: skip
    if json_file is not None:
        with click.open_file(str(json_file), "w", encoding="utf-8") as file:
            file.write(json.dumps(outcome.as_dict(), indent=2) + "\n")
    if str(json_file) != "-":
        print_outcome(Console(width=WIDTH), outcome)
    if out is None and not outcome.failures:
        shutil.rmtree(folder)
    else:
        console.print(f"everything else: {folder}", highlight=False, soft_wrap=True)
    if outcome.failures:
        raise SystemExit(1)


def _folder(out: Path | None) -> Path:
    if out is None:
        return Path(tempfile.mkdtemp(prefix="gnd-chaos-"))
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ChaosError(f"{out}: exists and is not empty; choose another folder for --out")
    out.mkdir(parents=True, exist_ok=True)
    return out.resolve()


def print_outcome(console: Console, outcome: "ChaosOutcome") -> None:
    """Tables for people: what must be 0, and what each kind of fault cost."""
    told = outcome.as_dict()
    table = Table(title=f"seed {outcome.seed}: {told['faults']} faults in {told['seconds']:.0f} s", show_header=False)
    rows = {
        "reports acknowledged": f"{told['acknowledged']} of {told['reports']}",
        "lost": told["lost"],
        "doubled": told["doubled"],
        "tiles received / torn": f"{told['received_tiles']} / {told['torn_tiles']}",
        "versions merged": told["versions"],
        "stuck": told["stuck_tiles"],
        "map agrees with its journal": "yes" if told["identical_map"] else f"NO: {told['verify']}",
        "parts that ended without a fault": told["deaths"] or "none",
        "settled after": "never" if told["settled_s"] is None else f"{told['settled_s']:.1f} s",
    }
    for name, value in rows.items():
        table.add_row(name, str(value))
    console.print(table)
    gaps = Table("fault", "times", "tile", "report", "update", title="longest time without service, s")
    for kind, values in told["gap_s_by_kind"].items():
        gaps.add_row(
            kind, str(told["by_kind"][kind]), *(f"{values[name]:.2f}" for name in ("tile", "report", "update"))
        )
    console.print(gaps)
    for name, lines in told["found"].items():
        for line in lines:
            console.print(f"{name}: {line}", highlight=False, soft_wrap=True)
    verdict = "; ".join(outcome.failures) if outcome.failures else "nothing lost, doubled, torn or stuck"
    console.print(("interrupted: " if outcome.interrupted else "") + verdict, highlight=False, soft_wrap=True)
