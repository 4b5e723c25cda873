"""Ask the index which libraries have wheels for which Python and machine: the table of docs/how_to/packages.md.

Nothing is installed: pip resolves the base installation and each extra for machines of another kind, from wheels alone.
Where it finds no set, what is missing is named, one after the other.
"""

import re
import subprocess
import sys
import tempfile
import tomllib
from typing import Final

import click

from tools.changelog import ROOT

PYTHONS: Final = ("3.11", "3.12", "3.13")
_GLIBC: Final = range(17, 37)
"""Minor versions of glibc 2 up to that of Debian 12."""
MACHINES: Final = {
    "Linux x86-64": tuple(f"manylinux_2_{n}_x86_64" for n in _GLIBC),
    "Linux arm64": tuple(f"manylinux_2_{n}_aarch64" for n in _GLIBC),
    "macOS arm64": ("macosx_15_0_arm64",),
    "macOS Intel": ("macosx_15_0_x86_64",),
}
EXTRAS: Final = (
    "base", "vehicle", "lanes", "cloud", "sim", "serve", "ros", "import", "export", "objects", "postgres", "opendrive",
)  # fmt: skip
_MOST_MISSING: Final = 6
_NO_WHEEL: Final = re.compile(r"(?:No matching distribution found for|Cannot install) ([A-Za-z0-9._-]+)")
_NAME: Final = re.compile(r"[A-Za-z0-9_.-]+")


def requirements() -> dict[str, list[str]]:
    """Requirements by extra; those of the base under `base`.

    Markers are left out: pip would judge them for this machine, and none of these has any.
    """
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return {name: project["optional-dependencies"].get(name, project["dependencies"]) for name in EXTRAS}


def missing(wanted: list[str], python: str, platforms: tuple[str, ...]) -> list[str]:
    """Names of what has no wheel, of these requirements and all that they need; empty where all can be installed.

    Raises:
        click.ClickException: pip fails for another reason.
    """
    names: list[str] = []
    while len(names) < _MOST_MISSING:
        told = _resolve(wanted, python, platforms)
        if told is None:
            return names
        found = _NO_WHEEL.search(told)
        if found is None:
            raise click.ClickException(f"pip for Python {python} on {platforms[0]}: {told[-1500:]}")
        names.append(found[1])
        left = [one for one in wanted if _name(one) != _name(found[1])]
        if not left or len(left) == len(wanted):  # the latter: it is needed by one of them
            return names
        wanted = left
    return names


def _resolve(wanted: list[str], python: str, platforms: tuple[str, ...]) -> str | None:
    """None where pip finds a set of wheels, else what it said."""
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [
                sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--disable-pip-version-check",
                "--only-binary=:all:", "--ignore-installed", "--python-version", python, "--implementation", "cp",
                "--target", folder,
                *(word for one in platforms for word in ("--platform", one)), *wanted,
            ],
            check=False, capture_output=True, text=True, timeout=600,
        )  # fmt: skip
    return None if done.returncode == 0 else done.stderr


def missing_by_extra(python: str, platforms: tuple[str, ...]) -> dict[str, list[str]]:
    """What has no wheel, by extra: all extras are asked about at once, and one by one only where that does not tell."""
    by_extra = requirements()
    names = {extra: {_name(one) for one in wanted} for extra, wanted in by_extra.items()}
    found = missing(sorted({one for wanted in by_extra.values() for one in wanted}), python, platforms)
    if all(any(_name(one) in own for own in names.values()) for one in found):
        return {extra: [one for one in found if _name(one) in names[extra]] for extra in by_extra}
    return {extra: missing(wanted, python, platforms) for extra, wanted in by_extra.items()}


def _name(requirement: str) -> str:
    """Name of a requirement as the index spells it."""
    found = _NAME.match(requirement)
    return "" if found is None else found[0].lower().replace("_", "-")


@click.command(help=__doc__)
@click.option("--python", "pythons", multiple=True, default=PYTHONS, show_default=True)
def main(pythons: tuple[str, ...]) -> None:
    """Print the table."""
    told = {machine: {one: missing_by_extra(one, places) for one in pythons} for machine, places in MACHINES.items()}
    click.echo("| | " + " | ".join(MACHINES) + " |\n|---|" + "---|" * len(MACHINES))
    for extra in EXTRAS:
        cells = [_cell({python: found[extra] for python, found in told[machine].items()}) for machine in MACHINES]
        click.echo(f"| {'base' if extra == 'base' else f'`{extra}`'} | " + " | ".join(cells) + " |")


def _cell(found: dict[str, list[str]]) -> str:
    """What is missing, by Python where they differ."""
    if not any(found.values()):
        return "yes"
    if len({tuple(names) for names in found.values()}) == 1:
        return f"no {', '.join(next(iter(found.values())))}"
    return "; ".join(f"{python}: {'no ' + ', '.join(names) if names else 'yes'}" for python, names in found.items())


if __name__ == "__main__":
    main()
