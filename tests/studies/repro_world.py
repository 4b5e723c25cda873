"""A short street with two vehicles and few scans: what the tests of `gnd reproduce simulation` run on."""

import json
import shutil
from pathlib import Path
from typing import Any

from click.testing import CliRunner, Result

from gnd.deploy.cli import gnd

STREET = ("--world-seed", "5", "--length", "100", "--scans", "30", "--sensors", "vlp16,rs16", "--vehicles", "1,2")
PLAIN = ("--no-pcd", "--no-pictures", "--no-traffic", "--jobs", "1")


def reproduce(out: Path, *more: str) -> Result:
    """Run the command in this process."""
    return CliRunner().invoke(gnd, ["reproduce", "simulation", *STREET, *PLAIN, "--out", str(out), *more])


def result_of(out: Path, *more: str) -> dict[str, Any]:
    """Run the command and return its JSON."""
    ran = reproduce(out, *more, "--json", "-")
    assert ran.exit_code == 0, f"{ran.output}{ran.exception!r}"
    return dict(json.loads(ran.stdout))


def without_times(found: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in found.items() if key != "runtime_s"}


def copy_world(source: Path, target: Path) -> Path:
    """A folder with the world of another one, but no vehicles."""
    shutil.copytree(source, target, ignore=shutil.ignore_patterns("vehicle-*", "*.png", "result.json"))
    return target
