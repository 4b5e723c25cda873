"""A short street, one sensor, few scans: what the tests of `gnd reproduce localisation` run on."""

import json
from pathlib import Path
from typing import Any

from click.testing import CliRunner, Result

from gnd.deploy.cli import gnd

STREET = ("--world-seed", "5", "--length", "100", "--scans", "45", "--base", "surveyed", "--jobs", "1")
SMALL = ("--sensors", "vlp16", "--fleet", "1", "--poses", "true", "--trials", "2")


def run_study(out: Path, *more: str) -> Result:
    """Run the command in this process."""
    return CliRunner().invoke(gnd, ["reproduce", "localisation", *STREET, *SMALL, "--out", str(out), *more])


def json_of(out: Path, *more: str) -> dict[str, Any]:
    """Run the command and return its JSON."""
    ran = run_study(out, *more, "--json", "-")
    assert ran.exit_code == 0, ran.output
    return dict(json.loads(ran.stdout))
