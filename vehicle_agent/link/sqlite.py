"""One SQLite file of the vehicle: opened as the store's, guarded by one lock."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any, Final, Literal

import apsw

from gnd.tile_store.sqlite_connection import log_ahead
from gnd.vehicle_agent.errors import VehicleError

BUSY_TIMEOUT_S: Final = 5.0


class Database:
    """A connection behind a lock; each call is one transaction.

    Args:
        path: of the file; its folder is made.
        schema: SQL that may be run again.
        synchronous: "full": every commit survives a power cut; "normal": a crash of the process only.
        error: raised where SQLite or the disk fails.
    """

    def __init__(
        self, path: Path, schema: str, *, synchronous: Literal["full", "normal"], error: type[VehicleError]
    ) -> None:
        self._error, self._path = error, path
        self._lock = Lock()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._connection = apsw.Connection(str(path))
            log_ahead(self._connection, synchronous, BUSY_TIMEOUT_S)
            self._connection.execute(schema)
        except (apsw.Error, OSError) as cause:
            raise error(f"cannot open {path}: {cause}. Give a folder that may be written.") from cause

    @contextmanager
    def transaction(self) -> Iterator[apsw.Connection]:
        """Several statements that all hold or none; the lock is held as long."""
        try:
            with self._lock, self._connection as connection:
                yield connection
        except (apsw.Error, OSError) as cause:
            raise self._error(f"{self._path}: {cause}") from cause

    def run(self, sql: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """Execute one statement and return its rows."""
        with self.transaction() as connection:
            return list(connection.execute(sql, values))

    def run_many(self, sql: str, rows: Iterable[Sequence[Any]]) -> None:
        """Execute one statement for each row, in one transaction."""
        with self.transaction() as connection:
            connection.executemany(sql, rows)

    def changes(self, sql: str, values: Sequence[Any] = ()) -> int:
        """Execute one statement and return how many rows it changed."""
        with self.transaction() as connection:
            connection.execute(sql, values)
            return connection.changes()

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        with self._lock:
            self._connection.close()
