"""`gnd reproduce` and `gnd benchmark`: the studies stand in the checkout, beside what is installed."""

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
            f"there is no folder `studies` in {root}: `gnd reproduce` and `gnd benchmark` work in a checkout of the"
            " sources, where `make setup` installs this command"
        )
    return root


def _command(module: str, name: str) -> click.Command:
    root = str(checkout())
    if root not in sys.path:
        sys.path.insert(0, root)
    command: click.Command = getattr(importlib.import_module(module), name)
    return command


def __getattr__(name: str) -> click.Command:
    modules = {"reproduce": "studies.cli", "benchmark": "studies.benchmark.cli"}
    if name not in modules:
        raise AttributeError(name)
    return _command(modules[name], name)
