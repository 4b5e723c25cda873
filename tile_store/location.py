"""Where a store is: a file, or a PostgreSQL database."""

import re
from pathlib import Path
from typing import Any, Final

import click
from click.shell_completion import CompletionItem

from gnd.tile_store.errors import StoreUnavailable
from gnd.tile_store.signing import Signing
from gnd.tile_store.sqlite_store import SqliteStore, SqlStore
from gnd.tile_store.values import StoreConfig

StoreLocation = Path | str
"""A path, or text: a path, `sqlite:PATH`, a URL (`postgresql://…`), or `postgresql:` before what libpq takes, as
`service=…`.
"""
_URLS: Final = ("postgresql://", "postgres://")
_WORDS: Final = "postgresql:"
_FILE: Final = "sqlite:"
_SECRET: Final = re.compile(r"(?<=[^:/@]):[^:/@]*(?=@)|[?& ]?password=[^& ]*")


def file_of(location: StoreLocation) -> Path | None:
    """The file of a store; None: it is in a database."""
    if isinstance(location, Path):
        return location
    if location.startswith((*_URLS, _WORDS)):
        return None
    return Path(location.removeprefix(_FILE))


def conninfo_of(location: StoreLocation) -> str:
    """What libpq takes, of a store in a database."""
    told = str(location)
    return told if told.startswith(_URLS) else told.removeprefix(_WORDS)


def named(conninfo: str) -> str:
    """The location of what libpq takes, without the password."""
    return shown(conninfo if conninfo.startswith(_URLS) else f"{_WORDS}{conninfo}")


def shown(location: StoreLocation) -> str:
    """A location for messages, without the password."""
    return _SECRET.sub("", str(location))


def required_file(location: StoreLocation, what: str) -> Path:
    """The file of a store.

    Raises:
        StoreUnavailable: it is in a database, which has tools of its own for this.
    """
    file = file_of(location)
    if file is None:
        raise StoreUnavailable(f"{shown(location)}: `{what}` is for files; a database has pg_dump and pg_restore")
    return file


def open_store(
    location: StoreLocation,
    config: StoreConfig | None = None,
    *,
    create: bool = True,
    signing: Signing | None = None,
    read_only: bool = False,
) -> SqlStore:
    """The store at a location.

    Args:
        location: where it is.
        config: batching and waiting of this process.
        create: make it where there is none.
        signing: who signs what is published, and checks what is built upon; None: nobody does.
        read_only: whatever would write is StoreUnavailable.

    Raises:
        StoreUnavailable: it cannot be opened, or PostgreSQL is asked for and its library is not installed.
    """
    file = file_of(location)
    if file is not None:
        return SqliteStore(file, config, create=create, signing=signing, read_only=read_only)
    conninfo = conninfo_of(location)
    try:
        from gnd.tile_store.postgres_store import PostgresStore
    except ImportError as error:
        raise StoreUnavailable(
            f"{shown(location)}: a store in PostgreSQL needs psycopg ({error}): pip install 'gnd-fleet[postgres]'"
        ) from None
    return PostgresStore(conninfo, config, create=create, signing=signing, read_only=read_only)


class _Location(click.ParamType):  # type: ignore[type-arg]  # generic only in newer releases
    """A store on the command line."""

    name = "store"

    def convert(self, value: Any, *_where: Any) -> StoreLocation:
        """The file, or the text that tells the database."""
        file = file_of(value)
        return str(value) if file is None else file

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:  # noqa: ARG002  (click's signature)
        """Files, as the shell finds them."""
        return [CompletionItem(incomplete, type="file")]


LOCATION: Final = _Location()
