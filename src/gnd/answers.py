"""How small commands answer: lines for people, or one JSON object for programs."""

import json
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import click

_F = TypeVar("_F", bound=Callable[..., Any])


def json_option(command: _F) -> _F:
    """Adds --json."""
    return click.option("--json", "as_json", is_flag=True, help="Print JSON instead of lines.")(command)


def tell(values: Mapping[str, Any], as_json: bool, *lines: str) -> None:
    """Print an answer.

    Args:
        values: for programs, what `json` can write; anything else as text.
        as_json: whether a program reads.
        lines: for people.
    """
    if as_json:
        click.echo(json.dumps(values, indent=1, default=str))
        return
    for line in lines:
        click.echo(line)
