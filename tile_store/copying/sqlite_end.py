"""An end of a copy in an SQLite file. A target is written beside its place and gets its name when it is whole."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, Final

import apsw

from gnd.gnd_map.tile_id import TILES_OF_DISTRICT, District
from gnd.tile_store.copying.contents import ALL, FENCED, OF_DISTRICT, Contents, DistrictPart, Row
from gnd.tile_store.copying.ends import EVENTS, GUARD, LOG, MARK, NOTE, REFUSE, End
from gnd.tile_store.districts import REST, WRITTEN
from gnd.tile_store.errors import DISTRICT_REFUSED, StoreError, StoreUnavailable
from gnd.tile_store.migrations import SCHEMA_VERSION, schema_of
from gnd.tile_store.sqlite_connection import open_reader, open_writer

BUSY_TIMEOUT_S: Final = 30.0


class SqliteEnd(End):
    """See `End`.

    Raises:
        StoreError: as a target, a file stands there that no copy has made.
        StoreUnavailable: as a source, no store is there, or one of another schema.
    """

    mark = "?"

    def __init__(self, path: Path, *, is_target: bool) -> None:
        super().__init__(str(path.absolute()))  # who follows may be in another folder
        self._wanted = path
        is_new = is_target and not path.exists()
        self._path = path.with_name(f"{path.name}.copying") if is_new else path
        if not is_new:
            _require_schema(path)
        self._connection = open_writer(self._path, create=is_new, busy_timeout_s=BUSY_TIMEOUT_S)
        if is_target and not is_new and self.marked() is None:
            self.close()
            raise StoreError(f"{path}: exists; nothing is overwritten, move it away or choose another path")
        self._connection.execute(
            "CREATE TABLE IF NOT EXISTS feature_source (name TEXT NOT NULL PRIMARY KEY, created_ns INTEGER NOT NULL,"
            " about TEXT NOT NULL, body BLOB NOT NULL) STRICT;"
            f"CREATE TABLE IF NOT EXISTS {MARK} (id TEXT NOT NULL, other TEXT NOT NULL, state TEXT NOT NULL,"
            " place TEXT NOT NULL) STRICT"
        )

    def run(self, sql: str, values: Sequence[Any] = ()) -> list[Row]:
        """See `End`."""
        return list(self._connection.execute(_with_rowid(sql), values))

    def run_each(self, sql: str, rows: Sequence[Row]) -> None:
        """See `End`."""
        if rows:
            self._connection.executemany(_with_rowid(sql), rows)

    def fill(self, contents: Contents, columns: Sequence[str], rows: Sequence[Row]) -> None:
        """See `End`."""
        into = f"{contents.table} ({self.listed(columns)})"
        self.run_each(f"INSERT OR REPLACE INTO {into} VALUES ({self.marks(len(columns))})", rows)

    def put(self, contents: Contents, columns: Sequence[str], rows: Sequence[Row]) -> None:
        """See `End`."""
        if contents.table == "trial_steered":  # no clause of conflict knows a rowid
            self.fill(contents, columns, rows)
        else:
            super().put(contents, columns, rows)

    def columns(self, table: str) -> tuple[str, ...]:
        """See `End`."""
        found = [str(name) for (name,) in self._connection.execute(f"SELECT name FROM pragma_table_info('{table}')")]
        return tuple(sorted([*found, "number"] if table == "trial_steered" else found))

    def note_changes(self, which: Sequence[Contents] = ALL, district: District | None = None) -> None:
        """See `End`."""
        self.run(
            f"CREATE TABLE IF NOT EXISTS {LOG} (number INTEGER PRIMARY KEY AUTOINCREMENT, what TEXT NOT NULL,"
            " key TEXT NOT NULL) STRICT"
        )
        for one, event in product(which, EVENTS):
            told = " UNION ".join(
                f"{_noted(one, row)} WHERE {self.of_district(one.table, district, f'{row}.')}" for row in _ROWS[event]
            )
            self.run(
                f"CREATE TRIGGER {NOTE}_{event}_{one.table} AFTER {event} ON {one.table} BEGIN"
                f" INSERT INTO {LOG} (what, key) {told}; END"
            )

    def stop_noting(self) -> None:
        """See `End`."""
        for one, event in product(ALL, EVENTS):
            self.run(f"DROP TRIGGER IF EXISTS {NOTE}_{event}_{one.table}")

    def refuse(self, target: str) -> None:
        """See `End`."""
        said = f"moved to {target}".replace("'", "''")
        for table, event in product(FENCED, EVENTS):
            self.run(
                f"CREATE TRIGGER {REFUSE}_{event}_{table} BEFORE {event} ON {table} BEGIN"
                f" SELECT RAISE(ABORT, '{said}'); END"
            )

    def allow(self) -> None:
        """See `End`."""
        for table, event in product(FENCED, EVENTS):
            self.run(f"DROP TRIGGER IF EXISTS {REFUSE}_{event}_{table}")

    def guard(self) -> None:
        """See `End`."""
        for part, event in product(OF_DISTRICT, EVENTS):
            if event == "delete" and not part.keeps:
                continue
            of = f" OF {self.listed(part.guarded)}" if event == "update" and part.guarded else ""
            self.run(  # an expression in RAISE would make the file unreadable for programs with an older SQLite
                f"CREATE TRIGGER IF NOT EXISTS {GUARD}_{event}_{part.table} BEFORE {event}{of} ON {part.table}"
                f" WHEN {_refused(part, event)} BEGIN SELECT RAISE(ABORT, '{DISTRICT_REFUSED}'); END"
            )

    def key_ends(self, column: str, path: str) -> str:
        """See `End`."""
        return f"substr({column}, -{len(path)}) = '{path}'"

    def begin(self, *, alone: bool = False) -> None:  # noqa: ARG002  # whoever writes is alone
        """See `End`."""
        self.run("BEGIN IMMEDIATE")

    def begin_to_read(self) -> None:
        """See `End`."""
        self.run("BEGIN")
        self.run("SELECT 1 FROM sqlite_schema LIMIT 1")  # from here on it reads the store of this instant

    def hide(self) -> None:
        """See `End`: nobody looks for it under this name."""

    def reveal(self) -> None:
        """See `End`."""
        self.run("DELETE FROM queue_boot")
        self.run("DELETE FROM shard")

    def name_it(self) -> None:
        """See `End`."""
        if self._path == self._wanted:
            return
        self._connection.close()  # the last connection folds the log into the file
        if self._wanted.exists():
            raise StoreError(f"{self._wanted}: somebody has made it meanwhile; the copy is {self._path}")
        self._path.rename(self._wanted)
        self._path = self._wanted
        self._connection = open_writer(self._wanted, create=False, busy_timeout_s=BUSY_TIMEOUT_S)

    def analyse(self) -> None:
        """See `End`: SQLite is told by hints."""

    def close(self) -> None:
        """See `End`."""
        self._connection.close()


_ROWS: Final = {"insert": ("NEW",), "update": ("OLD", "NEW"), "delete": ("OLD",)}


def _noted(contents: Contents, row: str) -> str:
    parts = [f'hex({row}."{one}")' if one in contents.hashes else f'{row}."{one}"' for one in contents.key]
    return f"SELECT '{contents.table}', json_array({', '.join(parts)})"


def _refused(part: DistrictPart, event: str) -> str:
    """The condition that an event is refused for the district of a row."""
    row = "OLD" if event == "delete" else "NEW"
    column, place = (
        ("path", f"substr({row}.key, -17)")
        if part.kind == "upload"
        else ("district", f"({row}.tile / {TILES_OF_DISTRICT})")
    )
    state = (
        f"COALESCE((SELECT state FROM district_owner WHERE {column} = {place}),"
        f" (SELECT state FROM district_owner WHERE district = {REST}), 'owned')"
    )
    if event == "delete":
        return f"{state} = 'leaving'"
    written = ", ".join(f"'{one}'" for one in (*WRITTEN, *(() if part.kind == "late" else ("arriving",))))
    is_refused = f"{state} NOT IN ({written})"
    if part.kind == "upload" and event == "insert":  # what waits comes late
        is_refused += f" OR ({state} = 'arriving' AND NEW.state = 'waiting')"
    return is_refused


def _with_rowid(sql: str) -> str:
    """PostgreSQL numbers what operators did to trials in a column, SQLite by the row itself."""
    return sql.replace('"number"', "rowid") if "trial_steered" in sql else sql


def _require_schema(path: Path) -> None:
    connection = open_reader(path)
    try:
        found = schema_of(connection, path)
    except apsw.Error as error:
        raise StoreUnavailable(f"{path}: {error}") from None
    finally:
        connection.close()
    if found != SCHEMA_VERSION:
        raise StoreUnavailable(
            f"{path}: store schema {found}, this release copies {SCHEMA_VERSION}; open it with this release first"
        )
