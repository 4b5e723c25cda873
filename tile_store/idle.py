"""Connections of a store that nobody uses at present, and how one is lent and comes back."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Generic, Protocol, TypeVar

from gnd.tile_store.errors import NO_ROW, StoreClosed, odd_row


class IdleConnection(Protocol):
    """What a connection must be able to do."""

    def close(self) -> object:
        """Free it."""


C = TypeVar("C", bound=IdleConnection)


class IdleConnections(Generic[C]):
    """Connections outside any transaction; any thread may ask.

    Args:
        location: of the store, for messages.
        errors: of the database's library.
        as_store_error: what becomes of one of them.
    """

    def __init__(
        self, location: str, errors: type[Exception], as_store_error: Callable[[Exception], Exception]
    ) -> None:
        self._location, self._errors, self._as_store_error = location, errors, as_store_error
        self._idle: list[C] = []
        self._lock = threading.Lock()
        self._closed = False

    def take(self) -> C | None:
        """One of them; None: there is none.

        Raises:
            StoreClosed: the store is closed.
        """
        with self._lock:
            if self._closed:
                raise StoreClosed(f"{self._location}: the store is closed")
            return self._idle.pop() if self._idle else None

    @contextmanager
    def lent(self, connection: C) -> Iterator[C]:
        """A connection while it is used; it is not used again after an error."""
        try:
            yield connection
        except self._errors as error:
            connection.close()
            raise self._as_store_error(error) from None
        except NO_ROW as error:
            connection.close()
            raise odd_row(self._location, error) from error
        except BaseException:
            connection.close()
            raise
        self._give_back(connection)

    def close(self) -> None:
        """Close them; those in use close when they come back."""
        with self._lock:
            self._closed = True
            idle, self._idle = self._idle, []
        for connection in idle:
            connection.close()

    def _give_back(self, connection: C) -> None:
        with self._lock:
            if not self._closed:
                self._idle.append(connection)
                return
        connection.close()
