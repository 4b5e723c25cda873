"""Statements on their way to PostgreSQL and back: prepared once a connection, in binary form, many in one way.

This talks to libpq by psycopg's `pq`: for statements as short as the store's, cursors take longer than the server.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from select import POLLIN, POLLOUT, poll
from struct import Struct
from typing import Any, ClassVar, Final

import psycopg
from psycopg import errors as pg
from psycopg.adapt import Transformer
from psycopg.pq import ExecStatus, Format
from psycopg.pq.abc import PGconn, PGresult

from gnd.tile_store.connection import Bindings, Row

_PARAMETER: Final = re.compile(r"(?<![:\w]):([a-z_]+)")
_INTEGER: Final = Struct(">q")
_FLOAT: Final = Struct(">d")
_ARRAY: Final = Struct(">iiiii")
"""Dimensions, whether there are NULLs, type of the elements, how many, number of the first."""
_LENGTH: Final = Struct(">i")
_FAILED: Final = (ExecStatus.FATAL_ERROR, ExecStatus.BAD_RESPONSE, ExecStatus.NONFATAL_ERROR)


@dataclass(frozen=True, slots=True)
class BoundStatement:
    """What is sent: `$1`, `$2`, … stand for the names in their order."""

    sql: str
    names: tuple[str, ...] = ()

    @classmethod
    def of(cls, sql: str) -> "BoundStatement":
        """Of SQL in which `:name` stands for what is bound."""
        names = tuple(dict.fromkeys(_PARAMETER.findall(sql)))
        return cls(_PARAMETER.sub(lambda found: f"${names.index(found[1]) + 1}", sql), names)


class Array:
    """Values of one type, none of them None, ready to be sent."""

    __slots__ = ("data",)
    oid: ClassVar[int]
    element_oid: ClassVar[int]

    def __init__(self, values: Sequence[Any]) -> None:
        self.data = _ARRAY.pack(1, 0, self.element_oid, len(values), 1) + self._elements(values)

    def _elements(self, values: Sequence[Any]) -> bytes:
        raise NotImplementedError


class IntegerArray(Array):
    """bigint[]."""

    __slots__ = ()
    oid, element_oid = 1016, 20

    def _elements(self, values: Sequence[int]) -> bytes:
        told = [8] * (2 * len(values))
        told[1::2] = values
        return Struct(">" + "iq" * len(values)).pack(*told)


class BytesArray(Array):
    """bytea[]."""

    __slots__ = ()
    oid, element_oid = 1001, 17

    def _elements(self, values: Sequence[bytes]) -> bytes:
        return _joined(values)


class TextArray(Array):
    """text[]."""

    __slots__ = ()
    oid, element_oid = 1009, 25

    def _elements(self, values: Sequence[str]) -> bytes:
        return _joined([value.encode() for value in values])


def _joined(values: Sequence[bytes]) -> bytes:
    return b"".join(part for value in values for part in (_LENGTH.pack(len(value)), value))


_ARRAYS: Final[dict[type, type[Array]]] = {int: IntegerArray, bool: IntegerArray, str: TextArray, bytes: BytesArray}


def columns_of(rows: Sequence[Bindings], names: Iterable[str]) -> dict[str, Array]:
    """The values of rows under those of the names that they have, each an array in the order of the rows."""
    first = rows[0]
    return {name: _ARRAYS[type(first[name])]([row[name] for row in rows]) for name in names if name in first}


def _encoded(value: Any) -> tuple[int, bytes | None]:
    """A value's type and bytes. Each type of Python has one of PostgreSQL, so that a statement is prepared once; True
    is 1, as in SQLite.
    """
    if isinstance(value, int):
        return 20, _INTEGER.pack(value)
    if isinstance(value, str):
        return 25, value.encode()
    if isinstance(value, Array):
        return value.oid, value.data
    if value is None:
        return 0, None
    if isinstance(value, float):
        return 701, _FLOAT.pack(value)
    return 17, bytes(value)


class PostgresWire:
    """Runs statements over one connection; one thread at a time."""

    def __init__(self, raw: psycopg.Connection[Any]) -> None:
        self._pq: PGconn = raw.pgconn
        self._transformer = Transformer(raw)
        self._prepared: dict[tuple[str, tuple[int, ...]], bytes] = {}
        self._incoming, self._both = poll(), poll()
        self._incoming.register(self._pq.socket, POLLIN)
        self._both.register(self._pq.socket, POLLIN | POLLOUT)

    def run(self, commands: Sequence[tuple[BoundStatement, Bindings]]) -> list[PGresult]:
        """What came of each, all in one way to the server and back. Only the last one may find many rows.

        Raises:
            psycopg.Error: the first that failed, as psycopg names it; what follows it was not run.
        """
        told = [self._told(statement, bindings) for statement, bindings in commands]
        try:
            return self._one(*told[0]) if len(told) == 1 else self._many(told)
        except (psycopg.Error, OSError):
            raise
        except BaseException:  # interrupted: answers are on their way for which nobody waits
            self._pq.finish()
            raise

    def rows(self, result: PGresult) -> list[Row]:
        """The rows that a statement has found."""
        self._transformer.set_pgresult(result)
        return self._transformer.load_rows(0, result.ntuples, tuple)

    def has_farewell(self) -> bool:
        """Whether the server has said something unasked: that it goes, as a rule."""
        return bool(self._incoming.poll(0))

    def _told(self, statement: BoundStatement, bindings: Bindings) -> tuple[bytes, list[bytes | None]]:
        """The name of the prepared statement, and its parameters."""
        encoded = [_encoded(bindings[name]) for name in statement.names]
        key = statement.sql, tuple(oid for oid, _ in encoded)
        name = self._prepared.get(key)
        if name is None:
            name = b"gnd%d" % len(self._prepared)
            self._checked([self._pq.prepare(name, statement.sql.encode(), key[1])])
            self._prepared[key] = name
        return name, [data for _, data in encoded]

    def _send(self, name: bytes, values: list[bytes | None]) -> None:
        self._pq.send_query_prepared(name, values, [Format.BINARY] * len(values), Format.BINARY)

    def _one(self, name: bytes, values: list[bytes | None]) -> list[PGresult]:
        self._send(name, values)
        results = []
        while (result := self._next()) is not None:
            results.append(result)
        return self._checked(results)

    def _many(self, told: Sequence[tuple[bytes, list[bytes | None]]]) -> list[PGresult]:
        self._pq.enter_pipeline_mode()
        for name, values in told:
            self._send(name, values)
        self._pq.pipeline_sync()
        results = list[PGresult]()
        while (result := self._next()) is None or result.status != ExecStatus.PIPELINE_SYNC:
            if result is not None:
                results.append(result)
        self._pq.exit_pipeline_mode()
        return self._checked(results)

    def _next(self) -> PGresult | None:
        """The next result; None: no more of this statement. Other threads run meanwhile."""
        while self._pq.is_busy():
            (self._both if self._pq.flush() else self._incoming).poll()
            self._pq.consume_input()
        return self._pq.get_result()

    def _checked(self, results: list[PGresult]) -> list[PGresult]:
        for result in results:
            if result.status in _FAILED:
                raise pg.error_from_result(result, encoding="utf-8")
        if not results or results[-1].status == ExecStatus.PIPELINE_ABORTED:
            raise psycopg.OperationalError("the connection was lost")
        return results
