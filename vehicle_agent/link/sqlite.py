"""One SQLite file of the vehicle: opened with checked settings, guarded by one lock."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any, Literal

import apsw

from gnd.vehicle_agent.errors import VehicleError


class Database:
    """A connection behind a lock; each `run` or `run_many` is one transaction."""

    def __init__(
        self, path: Path, schema: str, *, synchronous: Literal["FULL", "NORMAL"], error: type[VehicleError]
    ) -> None:
        self._error = error
        self._lock = Lock()
        self._what = str(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._connection = apsw.Connection(str(path))
            self._connection.set_busy_timeout(5000)
            self._connection.execute(f"PRAGMA journal_mode = WAL; PRAGMA synchronous = {synchronous}")
            self._connection.execute(schema)
        except (apsw.Error, OSError) as cause:
            raise error(f"cannot open {path}: {cause}. Give a folder that may be written.") from cause

    def run(self, sql: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """Execute one statement and return its rows."""
        try:
            with self._lock, self._connection:
                rows = list(self._connection.execute(sql, values))
        except (apsw.Error, OSError) as cause:
            raise self._error(f"{self._what}: {cause}") from cause
        return rows

    def run_many(self, sql: str, rows: Iterable[Sequence[Any]]) -> None:
        """Execute one statement for each row, in one transaction."""
        try:
            with self._lock, self._connection:
                self._connection.executemany(sql, rows)
        except (apsw.Error, OSError) as cause:
            raise self._error(f"{self._what}: {cause}") from cause

    @contextmanager
    def transaction(self) -> Iterator[apsw.Connection]:
        """Several statements that all hold or none; the lock is held as long."""
        try:
            with self._lock, self._connection as connection:
                yield connection
        except (apsw.Error, OSError) as cause:
            raise self._error(f"{self._what}: {cause}") from cause

    def changes(self, sql: str, values: Sequence[Any] = ()) -> int:
        """Execute one statement and return how many rows it changed."""
        try:
            with self._lock, self._connection:
                self._connection.execute(sql, values)
                changed = self._connection.changes()
        except (apsw.Error, OSError) as cause:
            raise self._error(f"{self._what}: {cause}") from cause
        return changed

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        with self._lock:
            self._connection.close()
