"""`gnd kernels`: which machine code this installation runs, and compiling all of it ahead of time."""

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import click

from gnd.ahead.library import VARIABLE, UnfitLibrary, library_path, load, name_of
from gnd.answers import json_option, tell
from gnd.deploy.doctor.programs import all_kernels, is_cached
from gnd.deploy.errors import DeployError

_SHOWN: Final = 8


@dataclass(frozen=True, slots=True)
class KernelsHere:
    """What machine code there is for the kernels of the parts that are installed.

    Attributes:
        library: path of the library that was compiled ahead of time, "" where the environment asks for numba.
        fault: why it is not used, "" where it is.
        cpu: that it was compiled for.
        ahead: kernels whose present source it holds.
        changed: kernels that it holds of another source.
        cached: other kernels that numba has compiled before and keeps on the disk.
        rest: kernels that numba compiles when they are first called, or that are parts of others.
    """

    library: str
    fault: str
    cpu: str
    ahead: tuple[str, ...]
    changed: tuple[str, ...]
    cached: tuple[str, ...]
    rest: tuple[str, ...]

    @property
    def used(self) -> str:
        """In words, what a program does here."""
        if self.ahead:
            return "compiled ahead of time"
        return "numba's cache" if self.cached else "numba compiles now"


def kernels_here() -> KernelsHere:
    """Look at the library and at numba's cache; compiles nothing.

    Raises:
        GndError: a part that is installed cannot be imported.
    """
    known, path = all_kernels(), library_path()
    library, fault = None, ""
    if path is None:
        fault = "GND_KERNELS=numba"
    elif not path.is_file():
        fault = f"{path}: there is none (gnd kernels build)"
    else:
        try:
            library = load(path)
        except UnfitLibrary as error:
            fault = str(error)
    ahead = {name_of(one) for one in known if library is not None and library.is_valid_for(one)}
    changed = {name_of(one) for one in known if library is not None and name_of(one) in library.kernels} - ahead
    cached = {name_of(one) for one in known if is_cached(one.plain)} - ahead
    rest = {name_of(one) for one in known} - ahead - cached
    told = tuple(tuple(sorted(names)) for names in (ahead, changed, cached, rest))
    return KernelsHere(str(path or ""), fault, "" if library is None else library.cpu, *told)


@click.group(short_help="Which machine code runs here, and compiling it ahead of time.")
def kernels() -> None:
    """Kernels are the inner loops, written in Python and compiled to machine code.

    Where a library of them was compiled ahead of time, programs need neither numba nor a compiler for them. Else numba
    compiles each when it is first called, and keeps it on the disk.
    """


@kernels.command("status")
@json_option
def status(as_json: bool) -> None:
    """Say where the machine code of the kernels comes from here. Compiles nothing."""
    here = kernels_here()
    values = {"used": here.used, "library": here.library, "fault": here.fault, "cpu": here.cpu}
    lists = {"ahead": here.ahead, "changed": here.changed, "numba_cache": here.cached, "numba": here.rest}
    lines = [f"used: {here.used}"]
    lines.append(f"library: not used: {here.fault}" if here.fault else f"library: {here.library}, for {here.cpu}")
    if here.changed:
        lines.append(f"changed since it was compiled, so numba compiles them: {_some(here.changed)}")
    lines.append(
        f"kernels: {len(here.ahead)} in the library, {len(here.cached)} in numba's cache, {len(here.rest)} in neither "
        "(parts of others, or compiled by numba when they are first called)"
    )
    tell({**values, **lists}, as_json, *lines)


@kernels.command("build")
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    help="File to write; programs use it with GND_KERNELS=FILE.  [default: into this installation]",
)
@json_option
def build(out: Path | None, as_json: bool) -> None:
    """Compile every kernel that vehicles, shards and tile servers call, as one library (minutes; needs a C compiler).

    It is for this version of Python and for x86-64-v3 (on other machines: for any processor of their kind). Processors
    that have less, and kernels whose source changes later, are left to numba.
    """
    values = built(out)
    size = values["bytes"] / 1e6
    left = [f"left to numba: {name}: {why}" for name, why in values["left_out"].items()]
    line = (
        f"{values['file']}: {values['kernels']} kernels for {values['cpu']}, {values['entries']} entries, {size:.1f} MB"
    )
    tell(values, as_json, line, *left)


@kernels.command("check")
@json_option
@click.pass_context
def check(context: click.Context, as_json: bool) -> None:
    """Compare the library with numba on this machine, bit for bit, on what the programs' warm-ups call (a minute).

    The exit code is 1 where any bit differs.
    """
    path = library_path()
    if path is None:
        raise DeployError("GND_KERNELS=numba: there is no library to compare")
    command = [sys.executable, "-c", _CHECK, str(path)]
    done = _run(command, {**os.environ, VARIABLE: "numba"}, "nothing was compared")
    values: dict[str, Any] = json.loads(done)
    counted = f"{len(values['kernels'])} kernels, {sum(values['kernels'].values())} calls"
    lines = [f"{counted}: {'every bit as with numba' if not values['unequal'] else 'not equal'}"]
    ours_us, numbas_us = (sum(one[k] for one in values["times_us"].values()) for k in (0, 1))
    if numbas_us:
        lines.append(
            f"time of these calls: {ours_us / 1e3:.1f} ms, by numba for this processor {numbas_us / 1e3:.1f} ms"
        )
    lines += [f"other bits than with numba: {name}" for name in values["unequal"]]
    lines += [f"not in the library: {name}" for name in values["by_numba"]]
    tell(values, as_json, *lines)
    if values["unequal"]:
        context.exit(1)


_CHECK: Final = """
import json, sys
from dataclasses import asdict
from pathlib import Path
from gnd.ahead.check import check
from gnd.ahead.library import UnfitLibrary, load
try:
    print(json.dumps(asdict(check(load(Path(sys.argv[1]))))))
except UnfitLibrary as error:
    sys.exit(f"gnd: {error}")
"""


def built(out: Path | None) -> dict[str, Any]:
    """Build in a process of its own, which compiles for another processor than programs here.

    Raises:
        DeployError: no compiler, or it failed; nothing was written.
    """
    from gnd.ahead.build import build_environment
    from gnd.ahead.library import __file__ as library_file
    from gnd.ahead.library import file_name

    path = Path(library_file).parent / file_name() if out is None else out
    with tempfile.TemporaryDirectory(prefix="gnd-kernels-") as cache:
        command = [sys.executable, "-m", "gnd.ahead.build", str(path.absolute())]
        done = _run(command, build_environment(Path(cache)), "no library of kernels was built")
    values: dict[str, Any] = json.loads(done)
    return values


def _run(command: list[str], environment: dict[str, str], without: str) -> str:
    """The last line that a process of ours prints.

    Raises:
        DeployError: it failed; the message begins with `without`.
    """
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)  # noqa: S603 - ours
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1:] or [f"ended with {done.returncode}"]
        raise DeployError(f"{without}: {last[0].removeprefix('gnd: ')}")
    return done.stdout.strip().splitlines()[-1]


def _some(names: tuple[str, ...]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more
