"""The store in a PostgreSQL database that the processes of many machines may open."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import psycopg

from gnd.tile_store import clocks
from gnd.tile_store import sql_inbox as inbox
from gnd.tile_store.errors import StoreError, StoreUnavailable
from gnd.tile_store.migrations import SCHEMA_VERSION, STEPS
from gnd.tile_store.postgres_connection import (
    DatabaseClock,
    PostgresConnection,
    PostgresReaders,
    ServerNotReady,
    as_store_error,
    connect,
    patiently,
    shown,
)
from gnd.tile_store.postgres_writer import LOCKS, PostgresWriter
from gnd.tile_store.signing import Signing
from gnd.tile_store.sql import statements
from gnd.tile_store.sqlite_store import GROUP_MAX, SqlStore
from gnd.tile_store.values import Claim, StoreConfig
from gnd.tile_store.writer import NoWriter

_LOG: Final = logging.getLogger(__name__)

PROGRAM: Final = "gnd"
FIRST_SCHEMA: Final = 12
"""The number of the schema with which `schema` of postgresql.sql begins; it has the steps beyond it, too."""


@dataclass(frozen=True, slots=True)
class _ToldClock:
    """A clock of a queue that reads what it is told to."""

    name: str
    read_ns: Callable[[], int]

    def steady_ns(self) -> int:
        return self.read_ns()


class PostgresStore(SqlStore):
    """`Store` in PostgreSQL: one writer a process that groups commits, a pool of connections for readers.

    Args:
        conninfo: as libpq takes it: a URL (postgresql://…) or words (service=…, host=/run/postgresql dbname=…).
        config: batching and waiting of this process.
        create: an empty database gets the schema; else there must be a store.
        signing: who signs what is published, and checks what is built upon; None: nobody does.
        read_only: nothing is written; whatever would write is StoreUnavailable.
        now_ns: the time of day, int ns UTC; it may step.
        steady_ns: the clock of the queue, ns; None: the database's.

    Raises:
        StoreUnavailable: the server is not to be reached, lets nobody in under this name or is too old, the database
            is missing, no store, or written by a newer release.
    """

    def __init__(
        self,
        conninfo: str,
        config: StoreConfig | None = None,
        *,
        create: bool = True,
        signing: Signing | None = None,
        read_only: bool = False,
        now_ns: Callable[[], int] = clocks.day_ns,
        steady_ns: Callable[[], int] | None = None,
    ) -> None:
        location, clock = shown(conninfo), DatabaseClock()

        def open_one() -> PostgresConnection:
            return connect(conninfo, clock)

        _bring_up_to_date(open_one, location, create=create, read_only=read_only)
        writer = NoWriter(location) if read_only else PostgresWriter(location, open_one, group_max=GROUP_MAX)
        self._database_clock = clock
        queue = clock if steady_ns is None else _ToldClock(clock.name, steady_ns)
        super().__init__(location, PostgresReaders(conninfo, clock), writer, config, signing, now_ns, queue, clock)
        if not read_only:
            self._enter_boot()

    def claim(self, owner: str, n: int, lease_s: float, is_own: inbox.IsOwn | None = None) -> list[Claim]:
        """See `Store.claim`. Where the database's clock has gone back, all that waits by it is free first."""
        if self._database_clock.stepped_back():
            _LOG.warning("%s: the clock of the database has gone back: what waits by it is free", self.location)
            self._writer.run(lambda c: inbox.forget_times(c, self._steady_ns()))
        return super().claim(owner, n, lease_s, is_own)

    def backup(self, path: str | Path) -> None:
        """A database is backed up with its own tools.

        Raises:
            StoreError: always; it names them.
        """
        raise StoreError(f"{self.location}: not copied to {path}; a database has its own tools, such as pg_dump")

    def sizes(self) -> dict[str, int]:
        """Of the whole database."""
        return {"store": self.look(lambda c: int(c.fetch("size_of_database")[0][0]))}


def schema_of(connection: PostgresConnection, location: str) -> int:
    """The number of a store's schema, 0 of an empty database.

    Raises:
        StoreUnavailable: tables of another program, or a store of a newer release.
    """
    ((is_store, has_tables, schema),) = connection.fetch("state_of_schema")
    if schema is None:
        raise StoreUnavailable(f"{location}: no schema of the search_path is there; create one, or set another")
    if not is_store and has_tables:
        raise StoreUnavailable(
            f"{location}: schema {schema} holds tables of another program and no tile store; choose an empty database"
        )
    if not is_store:
        return 0
    ((program, version),) = connection.fetch("number_of_schema")
    if program != PROGRAM:
        raise StoreUnavailable(f"{location}: a store of another program, {str(program)[:80]!r}")
    if version > SCHEMA_VERSION:
        raise StoreUnavailable(
            f"{location}: store schema {version}, this release reads up to {SCHEMA_VERSION}; use the gnd that wrote it"
        )
    return int(version)


def _bring_up_to_date(
    open_one: Callable[[], PostgresConnection], location: str, *, create: bool, read_only: bool
) -> None:
    connection = patiently(open_one, ServerNotReady)
    try:
        found = schema_of(connection, location)
        if not found and (read_only or not create):
            raise StoreUnavailable(f"{location}: an empty database, not a tile store; `gnd map build` makes one")
        if found < SCHEMA_VERSION and read_only:
            raise StoreUnavailable(f"{location}: store schema {found}, this release reads {SCHEMA_VERSION}")
        if found < SCHEMA_VERSION:
            _migrate(connection, location)
    except psycopg.Error as error:
        raise as_store_error(error, location) from None
    finally:
        connection.close()


def _migrate(connection: PostgresConnection, location: str) -> None:
    """Run the steps that the store lacks, all or none; of several processes one does it, the others wait."""
    sql = statements("postgresql")
    connection.run("BEGIN")
    connection.run(f"SELECT pg_advisory_xact_lock({LOCKS}, 0)")
    found = schema_of(connection, location)
    if not found:
        connection.run_script(sql["schema"])
    for number, name in STEPS:
        if number > max(found, FIRST_SCHEMA):
            connection.run_script(sql[name])
    connection.change("put_schema_version", {"program": PROGRAM, "version": SCHEMA_VERSION})
    connection.run("COMMIT")
