"""The two ends of a copy, whichever databases they are in: rows by key, the log of changes, the fence."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final

from gnd.gnd_map.tile_id import TILES_OF_DISTRICT, District
from gnd.tile_store.copying.contents import ALL, MADE_WITH_THE_STORE, Contents, Row

LOG: Final = "copy_change"
"""Table of a source: keys of rows that have changed since the copy began."""
MARK: Final = "copy_of"
"""Table of both ends: which copy this is, where the other end is, and how far the copy has come."""
COPIED: Final = "copied"
MOVED: Final = "moved"
WHOLE: Final = "whole"
"""States of a copy: both ends while it goes on; a source that writes nothing more; a target that is a store."""
NOTE: Final = "copy_notes"
REFUSE: Final = "moved_away"
GUARD: Final = "district_guard"
"""Triggers begin with these words."""
EVENTS: Final = ("insert", "update", "delete")


class End(ABC):
    """A store at an end of a copy, outside the store's own reading and writing."""

    mark: str
    """What stands for a parameter."""

    def __init__(self, location: str) -> None:
        self.location = location

    @abstractmethod
    def run(self, sql: str, values: Sequence[Any] = ()) -> list[Row]:
        """Run a statement; its rows."""

    @abstractmethod
    def run_each(self, sql: str, rows: Sequence[Row]) -> None:
        """Run a statement for each of several rows."""

    @abstractmethod
    def fill(self, contents: Contents, columns: Sequence[str], rows: Sequence[Row]) -> None:
        """Insert rows that are not there."""

    @abstractmethod
    def columns(self, table: str) -> tuple[str, ...]:
        """The columns of a table, sorted, under the names that both databases use; none: there is no such table."""

    @abstractmethod
    def note_changes(self, which: Sequence[Contents] = ALL, district: District | None = None) -> None:
        """Have every change of a row noted in the log from now on, inside a transaction; of a district, its rows'."""

    @abstractmethod
    def stop_noting(self) -> None:
        """Note nothing more."""

    @abstractmethod
    def refuse(self, target: str) -> None:
        """Have every write refused: the store has moved to `target`."""

    @abstractmethod
    def allow(self) -> None:
        """Refuse nothing more."""

    @abstractmethod
    def guard(self) -> None:
        """Have writes to districts refused that `district_owner` says are not written to here, inside a transaction.
        It stays; a store that owns all its districts has no guard.
        """

    @abstractmethod
    def key_ends(self, column: str, path: str) -> str:
        """A condition: the key of a report ends with the path of a district."""

    @abstractmethod
    def begin(self, *, alone: bool = False) -> None:
        """Begin a transaction that reads at one instant; alone: nobody else writes meanwhile."""

    @abstractmethod
    def begin_to_read(self) -> None:
        """Begin one that only reads, at one instant."""

    @abstractmethod
    def hide(self) -> None:
        """Nobody may open it as a store: it is not whole."""

    @abstractmethod
    def reveal(self) -> None:
        """It is a store, with all that was copied; inside a transaction."""

    @abstractmethod
    def name_it(self) -> None:
        """After the transaction in which it was revealed: it is where it was wanted."""

    @abstractmethod
    def analyse(self) -> None:
        """Look at what the tables hold, to plan statements by."""

    @abstractmethod
    def close(self) -> None:
        """Free it."""

    @contextmanager
    def transaction(self, *, alone: bool = False) -> Iterator[None]:
        """All or nothing."""
        self.begin(alone=alone)
        try:
            yield
        except BaseException:
            self.run("ROLLBACK")
            raise
        self.run("COMMIT")

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Everything at one instant."""
        self.begin_to_read()
        try:
            yield
        finally:
            self.run("ROLLBACK")

    def of_district(self, table: str, district: District | None, row: str = "") -> str:
        """A condition: a row is of a district; `row`: "NEW." or "OLD." in a trigger."""
        if district is None:
            return "1 = 1"
        if table == "upload":
            return self.key_ends(f"{row}key", district.path)
        first = district.first_morton
        return f"{row}tile >= {first} AND {row}tile < {first + TILES_OF_DISTRICT}"

    def layers(self, table: str) -> list[str]:
        """The layers of a table whose index begins with them: as many steps as layers."""
        found, sql = list[str](), f"SELECT MIN(layer) FROM {table}"
        rows = self.run(sql)
        while rows[0][0] is not None:
            found.append(str(rows[0][0]))
            rows = self.run(f"{sql} WHERE layer > {self.mark}", (found[-1],))
        return found

    def in_district(self, table: str, district: District) -> str:
        """A condition for a district's rows, by which an index finds them."""
        here = self.of_district(table, district)
        if table == "upload":
            return here
        layers = ", ".join("'" + one.replace("'", "''") + "'" for one in self.layers(table))
        return f"layer IN ({layers}) AND {here}" if layers else "1 = 0"

    def name(self, column: str) -> str:
        """A column in a statement: some are reserved words."""
        return f'"{column}"'

    def listed(self, columns: Sequence[str]) -> str:
        """Columns in a statement."""
        return ", ".join(self.name(one) for one in columns)

    def marks(self, n: int) -> str:
        """So many parameters."""
        return ", ".join([self.mark] * n)

    def count(self, table: str) -> int:
        """Rows of a table."""
        return int(self.run(f"SELECT COUNT(*) FROM {table}")[0][0])

    def page(self, contents: Contents, columns: Sequence[str], after: Sequence[Any], n: int) -> list[Row]:
        """Up to `n` rows beyond a key, in the order of keys; an empty key: from the first."""
        key = self.listed(contents.key)
        beyond = f"WHERE ({key}) > ({self.marks(len(contents.key))})" if after else ""
        sql = f"SELECT {self.listed(columns)} FROM {contents.table} {beyond} ORDER BY {key} LIMIT {n}"
        return self.run(sql, tuple(after))

    def rows(self, contents: Contents, columns: Sequence[str], keys: Sequence[Row]) -> list[Row | None]:
        """The rows with these keys."""
        sql = f"SELECT {self.listed(columns)} FROM {contents.table} WHERE {self._with_key(contents)}"
        return [found[0] if found else None for found in self.find_each(sql, keys)]

    def find_each(self, sql: str, each: Sequence[Row]) -> list[list[Row]]:
        """The rows of a statement for each of several parameters."""
        return [self.run(sql, one) for one in each]

    def put(self, contents: Contents, columns: Sequence[str], rows: Sequence[Row]) -> None:
        """Write rows, over those with the same keys."""
        rest = [one for one in columns if one not in contents.key]
        changed = ", ".join(f"{self.name(one)} = excluded.{self.name(one)}" for one in rest)
        done = f"DO UPDATE SET {changed}" if rest else "DO NOTHING"
        self.run_each(
            f"INSERT INTO {contents.table} ({self.listed(columns)}) VALUES ({self.marks(len(columns))})"
            f" ON CONFLICT ({self.listed(contents.key)}) {done}",
            rows,
        )

    def remove(self, contents: Contents, keys: Sequence[Row]) -> None:
        """Remove rows."""
        self.run_each(f"DELETE FROM {contents.table} WHERE {self._with_key(contents)}", keys)

    def _with_key(self, contents: Contents) -> str:
        return " AND ".join(f"{self.name(one)} = {self.mark}" for one in contents.key)

    def changed(self, n: int) -> list[Row]:
        """Up to `n` notes of the log: number, table, key as JSON; hashes in hexadecimal."""
        return self.run(f"SELECT number, what, key FROM {LOG} ORDER BY number LIMIT {n}")

    def forget(self, numbers: Sequence[int]) -> None:
        """Remove notes; others, with lower numbers, may become visible later."""
        self.run_each(f"DELETE FROM {LOG} WHERE number = {self.mark}", [(one,) for one in numbers])

    def marked(self) -> tuple[str, str, str, str] | None:
        """Of a copy that is not finished, or was finished here: its id, the other end, state, how far it has come."""
        if not self.columns(MARK):
            return None
        rows = self.run(f"SELECT id, other, state, place FROM {MARK}")
        return (rows[0][0], rows[0][1], rows[0][2], rows[0][3]) if rows else None

    def state(self) -> str:
        """The state of a copy that this store is or was an end of; "": of none."""
        mark = self.marked()
        return "" if mark is None else mark[2]

    def put_mark(self, copy_id: str, other: str, state: str, place: str) -> None:
        """Write that down."""
        self.run(f"DELETE FROM {MARK}")
        self.run(
            f"INSERT INTO {MARK} (id, other, state, place) VALUES ({self.marks(4)})", (copy_id, other, state, place)
        )

    def is_empty(self) -> bool:
        """Whether nobody has put anything into the store."""
        return not any(
            self.run(f"SELECT 1 FROM {one.table} LIMIT 1")
            for one in ALL
            if one.table not in MADE_WITH_THE_STORE and self.columns(one.table)
        )
