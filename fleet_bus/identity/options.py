"""The option of commands that join the bus: --identity."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from gnd.fleet_bus.identity.names import IDENTITY_VARIABLE

_F = TypeVar("_F", bound=Callable[..., Any])


def identity_option(command: _F) -> _F:
    """Adds --identity: the folder becomes that of this process and of those that it starts."""
    return click.option(
        "--identity",
        type=click.Path(path_type=Path),
        expose_value=False,
        callback=_use,
        help=f"Identity folder (`gnd certs`), which tls/ endpoints need.  [default: {IDENTITY_VARIABLE}]",
    )(command)


def _use(_context: click.Context, _option: click.Parameter, folder: Path | None) -> None:
    if folder is not None:
        os.environ[IDENTITY_VARIABLE] = str(folder)
