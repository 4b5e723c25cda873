"""`gnd benchmark`: worlds as files for other programs, our own submissions, and the scorer."""

import json
import os
import sys
from pathlib import Path
from typing import Any, Final

import click
from rich.console import Console

from gnd.deploy.live import progress_bars
from studies.frame.options import PATH, click_options, options_of

_JOBS: Final = click.Option(["--jobs"], type=click.IntRange(1), help="Worker processes.  [default: one a core]")
_JSON: Final = click.Option(["--json", "as_json"], is_flag=True, help="Print one JSON object.")


@click.group()
def benchmark() -> None:
    """Score programs that find changes in a map: export worlds as files, run ours, score any submission."""


def _export_command() -> click.Command:
    from studies.benchmark.plan import ExportOptions

    def run(out: Path, jobs: int | None, *, as_json: bool, **given: Any) -> None:
        from studies.benchmark.export import export
        from studies.benchmark.plan import expected, planned_worlds

        options = options_of(ExportOptions, given)
        worlds = planned_worlds(options)
        cost, processes = expected(worlds), jobs or os.cpu_count() or 1
        click.echo(
            f"{len(worlds)} worlds, {sum(len(world.drives) for world in worlds)} drives: about"
            f" {cost.gigabytes:.1f} GB and {cost.core_minutes / processes:.0f} minutes on {processes} cores",
            err=True,
        )
        with progress_bars(Console(stderr=True)) as progress:
            found = export(options, out, processes, progress)
        size = sum(one["bytes"] for one in found["files"].values())
        plain = {"folder": str(out), "worlds": [w["name"] for w in found["worlds"]], "bytes": size}
        click.echo(json.dumps(plain) if as_json else f"{out}: {len(plain['worlds'])} worlds, {size / 1e9:.2f} GB")

    return click.Command(
        "export",
        callback=run,
        params=[click.Argument(["out"], type=PATH), *click_options(ExportOptions), _JOBS, _JSON],
        help="Write worlds into OUT: the map before, drives, truth, scorer, example. A second start goes on where the"
        " first ended. The small size is about 0.8 GB and a minute of one core, the full one 26 GB and half an hour.",
    )


def _run_command() -> click.Command:
    from studies.benchmark.run import EntryOptions

    def run(folder: Path, submission: Path, jobs: int | None, *, as_json: bool, **given: Any) -> None:
        from studies.benchmark.run import run_entry

        with progress_bars(Console(stderr=True)) as progress:
            found = run_entry(
                folder, submission, options_of(EntryOptions, given), jobs or os.cpu_count() or 1, progress
            )
        voxels = sum(found["voxels"].values())
        click.echo(json.dumps(found) if as_json else f"{submission}: {voxels} voxels in {len(found['voxels'])} maps")

    return click.Command(
        "run",
        callback=run,
        params=[click.Argument(["folder"], type=PATH), click.Argument(["submission"], type=PATH),
                *click_options(EntryOptions), _JOBS, _JSON],
        help="Run our vehicles and cloud, or a baseline, on the files of an export in FOLDER; write SUBMISSION (.csv).",
    )  # fmt: skip


@click.command("score")
@click.argument("folder", type=PATH)
@click.argument("submission", type=PATH)
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON instead of a table.")
def score_command(folder: Path, submission: Path, *, as_json: bool) -> None:
    """Score SUBMISSION against the truth of an export in FOLDER, by the very scorer that the export holds."""
    from studies.benchmark.kit.score import main

    code = main([str(folder), str(submission), *(["--json"] if as_json else [])])
    if code:
        sys.exit(code)


benchmark.add_command(_export_command())
benchmark.add_command(_run_command())
benchmark.add_command(score_command)
