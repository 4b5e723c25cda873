"""What the commands over a store have in common: their options, how they open it, how they answer."""

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, TypeVar

import click
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from gnd.tile_store.location import StoreLocation, file_of, open_store
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.values import DEFAULT_LAYER
from gnd.tile_store.waiting import WAIT_S

PATH: Final = click.Path(path_type=Path)
_F = TypeVar("_F", bound=Callable[..., Any])


def layer_option(command: _F) -> _F:
    """Adds --layer."""
    return click.option("--layer", default=DEFAULT_LAYER, show_default=True, help="Layer of the map.")(command)


def region_option(command: _F) -> _F:
    """Adds --region."""
    help_text = "Leading part of tile paths, such as 13033/03021.  [default: everywhere]"
    return click.option("--region", default="", help=help_text)(command)


def json_option(command: _F) -> _F:
    """Adds --json."""
    return click.option("--json", "as_json", is_flag=True, help="Print JSON instead of tables.")(command)


def wait_option(command: _F) -> _F:
    """Adds --wait."""
    help_text = "At the start wait so long for the server of the store's database, s."
    return click.option(
        "--wait", "wait_s", default=WAIT_S, show_default=True, type=click.FloatRange(0), help=help_text
    )(command)


def existing(location: StoreLocation) -> SqlStore:
    """A store that is there, to write to."""
    return open_store(location, create=False)


def to_publish(location: StoreLocation) -> SqlStore:
    """A store that is there, to publish in: with the identity of this process, where it has one."""
    return open_store(location, create=False, signing=Signing.of_environment())


def to_read(location: StoreLocation) -> SqlStore:
    """A store that is there, to read; also where nothing can be written."""
    path = file_of(location)
    if path is None:
        return open_store(location, create=False, read_only=True)
    is_writable = os.access(path, os.W_OK) and os.access(path.parent, os.W_OK)
    return open_store(path, create=False, read_only=path.is_file() and not is_writable)


def show(values: dict[str, Any], as_json: bool, print_it: Callable[[Console], None]) -> None:
    """Print an answer: as JSON, or as `print_it` does."""
    if as_json:
        click.echo(json.dumps(values, indent=1))
    else:
        print_it(Console(width=120))


@contextmanager
def bars() -> Iterator[Callable[[str, int, int], None]]:
    """A progress bar for each step, on standard error."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    shown, tasks = Progress(*columns, console=Console(stderr=True)), dict[str, TaskID]()

    def tell(step: str, done: int, total: int) -> None:
        shown.start()  # only now: what is refused at once shows no bars
        if step not in tasks:
            tasks[step] = shown.add_task(step, total=total)
        shown.update(tasks[step], completed=done, total=total)

    try:
        yield tell
    finally:
        if tasks:
            shown.stop()
