"""`gnd reproduce`: the studies stand in the checkout, beside what is installed, and are found there."""

import importlib
import sys
from pathlib import Path

import click

import gnd
from gnd.deploy.errors import NoStudies


def checkout() -> Path:
    """Return the folder that holds `studies`.

    Raises:
        NoStudies: this installation was not made from a checkout (`pip install -e .`).
    """
    root = Path(gnd.__file__).resolve().parents[2]
    if not (root / "studies" / "cli.py").is_file():
        raise NoStudies(
            f"there is no folder `studies` in {root}: the papers' results are reproduced in a checkout of the"
            " sources, where `make setup` installs this command"
        )
    return root


def _reproduce() -> click.Command:
    root = str(checkout())
    if root not in sys.path:
        sys.path.insert(0, root)
    command: click.Command = importlib.import_module("studies.cli").reproduce
    return command


reproduce = _reproduce()
