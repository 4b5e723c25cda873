"""`python -m studies.speed [--out docs/benchmarks.md]`: every contest, as a page with command, machine and versions."""

import os
import platform
import subprocess
import sys
from collections.abc import Collection, Iterator
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import click

from studies.frame.options import click_options, options_of
from studies.frame.tables import Sheet, print_sheets
from studies.speed import yardstick
from studies.speed.coding import coding_contests, tile_contests
from studies.speed.contest import Contest, raced
from studies.speed.matching import matching_contest, odometry_contest
from studies.speed.rays import kernel_contest, scan_contest
from studies.speed.scene import SpeedOptions, scene_of

SENSOR: Final = "HDL-32E"
SPARSE: Final = "VLP-16"
PACKAGES: Final = (
    "numpy", "numba", "small_gicp", "kiss-icp", "octomap-python", "dufomap", "laspy", "lazrs", "DracoPy",
)  # fmt: skip
INTRODUCTION: Final = """\
# Speed beside others

What else does this work, and how long does it take on the same input, in the same run? Written by `make bench`. Every
entrant runs once a round, each round begun by another; a time is the processor's, of all threads, and a ratio is taken
within a round, so that what else the machine does weighs on all alike. Shown are medians (least to greatest). "Times
ours" above 1: slower than ours. Beside each time stands how good the result is: a fast answer that is worse is no gain.
"""


WORKS: Final = ("rays", "scans", "matching", "odometry", "coding", "tiles")


def contests(options: SpeedOptions, folder: Path, works: Collection[str] = WORKS) -> Iterator[Contest]:
    """Those of the given works, each made when it is asked for."""
    scene = scene_of(options, SENSOR, folder)
    if "rays" in works:
        yield kernel_contest(scene, folder)
    if "scans" in works:
        yield scan_contest(scene)
    if "matching" in works:
        yield matching_contest(scene)
    if "odometry" in works:
        yield odometry_contest(scene_of(options, SPARSE, folder))
    if "coding" in works:
        yield from coding_contests(scene)
    if "tiles" in works:
        yield from tile_contests(scene)


def page(command: str, sheets: list[Sheet], now: datetime) -> str:
    """The document."""
    head = [INTRODUCTION, f"    {command}", "", f"{now:%Y-%m-%d}, {machine()}.", "", f"{versions()}.", ""]
    return "\n".join([*head, *(f"## {sheet.title}\n\n{_untitled(sheet)}" for sheet in sheets)]).rstrip() + "\n"


def _untitled(sheet: Sheet) -> str:
    return sheet.markdown().split("\n", 2)[2]


def machine() -> str:
    """The processor and its cores."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{models[0] if models else platform.processor()}, {os.cpu_count()} cores, {platform.system()}"


def versions() -> str:
    """Of the interpreter, the compiler and every peer."""
    found = [f"Python {platform.python_version()}"]
    if yardstick.compiler() is not None:
        told = subprocess.run(["gcc", "-dumpfullversion"], capture_output=True, text=True, check=True)  # noqa: S607
        found.append(f"gcc {told.stdout.strip()}")
    for name in PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name} not installed")
    return ", ".join(found)


def run(*, out: Path | None, only: tuple[str, ...], **given: Any) -> None:
    """Run every contest, or those of some works; print the tables, and write the page where a file is given."""
    options, sheets = options_of(SpeedOptions, given), []
    with TemporaryDirectory() as folder:
        for contest in contests(options, Path(folder), only or WORKS):
            sheets.append(raced(contest, options.rounds))
            print_sheets(sheets[-1:])
    if out is not None:
        command = " ".join(["python -m studies.speed", *sys.argv[1:]])
        out.write_text(page(command, sheets, datetime.now(UTC)), encoding="utf-8")


OUT: Final = click.Option(["--out"], type=click.Path(path_type=Path, dir_okay=False), help="Write the page here.")
ONLY: Final = click.Option(["--only"], type=click.Choice(WORKS), multiple=True, help="This work, no other.")
COMMAND: Final = click.Command("speed", callback=run, params=[*click_options(SpeedOptions), OUT, ONLY], help=__doc__)

if __name__ == "__main__":
    COMMAND.main(prog_name="python -m studies.speed")
