"""The options of commands that take settings; `settings_file` says what goes before what."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

_F = TypeVar("_F", bound=Callable[..., Any])


def settings_options(command: _F) -> _F:
    """Adds --config, --set and --dump-config as `config_file`, `changes` and `dump_config`."""
    file = click.option("--config", "config_file", type=click.Path(path_type=Path), help="TOML file of settings.")
    change = click.option("--set", "changes", multiple=True, metavar="NAME=VALUE", help="One setting; repeatable.")
    dump = click.option("--dump-config", is_flag=True, help="Print the effective settings, as --config takes them.")
    return file(change(dump(command)))
