"""`gnd reproduce` and `gnd benchmark`: the studies stand in the checkout, beside what is installed."""

import importlib
import sys
from pathlib import Path
from typing import Any

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


def _study(module: str, name: str) -> Any:
    root = str(checkout())
    if root not in sys.path:
        sys.path.insert(0, root)
    return getattr(importlib.import_module(module), name)


def beside_peers(rounds: int) -> dict[str, float]:
    """CPU time of peers in units of ours, by name.

    Raises:
        NoStudies: as of `checkout`.
    """
    found: dict[str, float] = _study("studies.speed.ratios", "ratios")(rounds)
    return found


def _command(module: str, name: str) -> click.Command:
    command: click.Command = _study(module, name)
    return command


def __getattr__(name: str) -> click.Command:
    modules = {"reproduce": "studies.cli", "benchmark": "studies.benchmark.cli"}
    if name not in modules:
        raise AttributeError(name)
    return _command(modules[name], name)
