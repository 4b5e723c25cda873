"""`gnd bench`: what the programs cost on this machine."""

import json
import shutil
from pathlib import Path
from typing import Any

import click
from rich.console import Console
from rich.table import Table

from gnd.answers import json_option
from gnd.deploy.errors import NoStudies
from gnd.deploy.run_folder import create_run_folder
from gnd.ending import ending_at_once, orderly

_PATH = click.Path(path_type=Path)
_DEFAULT = Path("runs/bench-agent")


@click.group()
def bench() -> None:
    """What the programs cost on this machine."""


@bench.command()
@click.argument("drive", type=click.Path(exists=True, path_type=Path, dir_okay=False), required=False)
@click.option("--map", "base_map", type=_PATH, help="Store with the map of DRIVE (`gnd map build`).")
@click.option("--world-seed", type=int, default=7, show_default=True, help="Seed of the simulated street.")
@click.option(
    "--first/--no-first", default=True, show_default=True, help="Measure the first start ever, too (minutes)."
)
@click.option(
    "--rounds", type=click.IntRange(min=0), default=5, show_default=True, help="Rounds beside peers; 0: none."
)
@click.option("--flame", type=_PATH, help="Write a flame graph of the last drive here (speedscope; needs py-spy).")
@click.option("--out", type=_PATH, default=_DEFAULT, show_default=True, help="Folder of the run, replaced if need be.")
@json_option
def agent(
    drive: Path | None,
    base_map: Path | None,
    world_seed: int,
    first: bool,
    rounds: int,
    flame: Path | None,
    out: Path,
    as_json: bool,
) -> None:
    """Drive a simulated street with three sensors, or one recording, and print CPU, memory and start-up by stage.

    Each vehicle is an agent alone in its process, against a real router, tile server and shard. A time is the
    processor's: what else the machine does is not in it, though it slows caches down.
    """
    with ending_at_once():
        from gnd.deploy.bench.agent_bench import bench_agent, flame_graph
        from gnd.deploy.live import progress_bars

    folder = create_run_folder(out, overwrite=True)
    folder.write_mark({"bench": "agent", "world_seed": world_seed, "drive": None if drive is None else str(drive)})
    with orderly():
        with progress_bars(Console(stderr=True)) as progress:
            measured = bench_agent(folder, drive, base_map, world_seed, first=first, progress=progress)
        ratio = _ratios(rounds) if rounds else {}
    found = measured.as_json(ratio)
    (folder.root / "bench.json").write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    if flame is not None:
        flame_graph(folder.agents / list(measured.warm)[-1], flame, folder.logs / "py-spy.log")
    shutil.rmtree(folder.world / "drives", ignore_errors=True)
    if as_json:
        click.echo(json.dumps(found, indent=2))
    else:
        _show(found)


def _ratios(rounds: int) -> dict[str, float]:
    """Peers beside us, where this is a checkout."""
    from gnd.deploy.reproduce import beside_peers

    try:
        return beside_peers(rounds)
    except NoStudies as error:
        click.echo(f"no comparison with peers: {error}", err=True)
        return {}


def _show(found: dict[str, Any]) -> None:
    console = Console()
    drives = found["drives"]
    table = Table("", *drives, box=None, pad_edge=False, title="CPU of a scan, ms: mean (99 of 100 are below)")
    stages = sorted({stage for one in drives.values() for stage in one["ms"]} - {"whole scan"})
    last = list(drives.values())[-1]["ms"]
    for stage in [*sorted(stages, key=lambda s: -last.get(s, {"mean": 0.0})["mean"]), "whole scan"]:
        table.add_row(stage, *(_ms(one["ms"].get(stage)) for one in drives.values()))
    table.add_row("times real time, one core", *(f"{one['real_time']:.2f}" for one in drives.values()), style="bold")
    table.add_row("memory, MB: start", *(f"{one['memory_mb']['start']:.0f}" for one in drives.values()))
    table.add_row("memory, MB: peak", *(f"{one['memory_mb']['peak']:.0f}" for one in drives.values()))
    for holder in dict.fromkeys(holder for one in drives.values() for holder in one["holders_mb"]):
        table.add_row(
            f"memory, MB: {holder}", *(f"{one['holders_mb'].get(holder, 0.0):.0f}" for one in drives.values())
        )
    for step in next(iter(drives.values()))["start_s"]:
        table.add_row(f"start, s: {step}", *(f"{one['start_s'][step]:.2f}" for one in drives.values()))
    console.print(table)
    start = found["start_s"]
    first = "" if start["first"] is None else f"; ever, with all kernels to compile: {start['first']:.1f} s"
    console.print(f"start of a vehicle until its first scan is worked on: {start['warm']:.2f} s of CPU{first}")
    for name, ratio in found["ratio"].items():
        console.print(f"{name}: {ratio:.2f} times our time")


def _ms(spread: dict[str, float] | None) -> str:
    return "" if spread is None else f"{spread['mean']:.1f} ({spread['p99']:.0f})"
