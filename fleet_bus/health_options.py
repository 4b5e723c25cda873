"""The options of commands that show their metrics."""

from collections.abc import Callable
from typing import Any, TypeVar

import click

_F = TypeVar("_F", bound=Callable[..., Any])


def metrics_options(command: _F) -> _F:
    """Adds --metrics-port and --metrics-host."""
    host = click.option(
        "--metrics-host", default="127.0.0.1", show_default=True, help="Address for them; 0.0.0.0 is every one."
    )
    port = click.option(
        "--metrics-port", type=click.IntRange(0, 65_535), help="Serve /metrics, /healthz, /livez here.  [default: no]"
    )
    return port(host(command))
