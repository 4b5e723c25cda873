"""A short street with three drives of few scans: what the tests of `gnd reproduce traffic` run on."""

import json
from pathlib import Path
from typing import Any

from click.testing import CliRunner, Result

from gnd.deploy.cli import gnd

STREET = ("--world-seed", "5", "--length", "100", "--edits", "1", "--scans", "24", "--no-traffic", "--base", "surveyed")
DRIVES = ("--drives", "3", "--at-once", "2", "--pcd-drives", "0", "--f1-drives", "2", "--jobs", "1")


def study(out: Path, *more: str) -> Result:
    """Run the command in this process."""
    return CliRunner().invoke(gnd, ["reproduce", "traffic", *STREET, *DRIVES, "--out", str(out), *more])


def result_of_study(out: Path, *more: str) -> dict[str, Any]:
    """Run the command and return its JSON."""
    ran = study(out, *more, "--json", "-")
    assert ran.exit_code == 0, f"{ran.output}{ran.exception!r}"
    return dict(json.loads(ran.stdout))
