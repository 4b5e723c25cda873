"""What the store's functions need of a connection, whichever database is behind it: statements by name, and a clock."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Protocol, TypeVar

T = TypeVar("T")
Row = tuple[Any, ...]
Bindings = Mapping[str, Any]
NOTHING: Bindings = MappingProxyType({})
Lock = tuple[str | int, ...]
"""Names what two writers must not change at the same time: a tile of a layer, a report of an upload, ..."""


class QueueClock(Protocol):
    """The clock by which leases run: one for all processes that share the store."""

    @property
    def name(self) -> str:
        """Which clock it is: times that another one has given mean nothing to it."""

    def steady_ns(self) -> int:
        """Now, ns."""


class SqlConnection(Protocol):
    """A connection inside a transaction. Values are int, float, str, bytes and None; a bool is the integer 0 or 1."""

    @property
    def clock(self) -> QueueClock:
        """The clock of the store's leases."""

    def fetch(self, statement: str, bindings: Bindings = NOTHING) -> list[Row]:
        """All rows of a named statement."""

    def change(self, statement: str, bindings: Bindings = NOTHING) -> int:
        """Run a named statement; the number of rows that it changed."""

    def post(self, statement: str, bindings: Bindings = NOTHING) -> None:
        """Run a named statement of which nothing is asked; it may go to the database with the next one."""

    def fetch_each(self, statement: str, each: Sequence[Bindings], shared: Bindings = NOTHING) -> list[list[Row]]:
        """All rows of a named statement, for each of several bindings, to which what they share is added; they go to
        the database together, so what it finds for one does not depend on another.
        """

    def ask_each(
        self, statement: str, each: Sequence[Bindings], shared: Bindings = NOTHING
    ) -> Callable[[], list[list[Row]]]:
        """As `fetch_each`, of what is there now; it may go to the database with the next one. The answer is given when
        it is called.
        """

    def post_each(self, statement: str, each: Sequence[Bindings], shared: Bindings = NOTHING) -> None:
        """Run a named statement of which nothing is asked for each of several bindings; no two may change one row."""


def fetch(connection: SqlConnection, statement: str, bindings: Bindings = NOTHING) -> list[Row]:
    """All rows of a named statement."""
    return connection.fetch(statement, bindings)


def change(connection: SqlConnection, statement: str, bindings: Bindings) -> int:
    """Run a named statement; the number of rows that it changed."""
    return connection.change(statement, bindings)


def post(connection: SqlConnection, statement: str, bindings: Bindings) -> None:
    """Run a named statement of which nothing is asked."""
    connection.post(statement, bindings)


class Writer(Protocol):
    """Runs functions in write transactions, many in one commit; each returns when its own is durable."""

    def run(self, work: Callable[[SqlConnection], T], about: Iterable[Lock] | None = None, patient_s: float = 0.0) -> T:
        """Run `work` in a transaction.

        Args:
            work: may be run more than once where the database gives up a transaction; only the last run counts.
            about: what it changes, where other writers may change other things at the same time; None: nobody else
                writes meanwhile.
            patient_s: for so long it waits for a commit of others before it causes one, s.
        """

    def change(self, statement: str, bindings: Bindings, about: Iterable[Lock], patient_s: float = 0.0) -> int:
        """Run one named statement in a transaction; the number of rows that it changed."""

    def close(self) -> None:
        """Commit what is queued, then free it."""
