"""What a bus has declared on its session: handlers, subscriptions, tokens, publishers."""

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Self

import zenoh

from gnd.fleet_bus.connection import Connection


class Part(ABC):
    """Something declared, which `close` or the end of a `with` block takes back once.

    Attributes:
        declared: zenoh's object; None while there is no session yet.
    """

    def __init__(self) -> None:
        self.declared: Any = None
        self._ended = threading.Event()
        self._declaring = threading.Lock()

    def declare(self, connection: Connection, declare: Callable[[zenoh.Session], Any]) -> None:
        """Declares it as soon as there is a session, unless it was taken back before."""

        def now(session: zenoh.Session) -> None:
            with self._declaring:
                if not self.is_closed:
                    self.declared = declare(session)

        connection.when_open(now)

    def undeclare(self) -> None:
        """Takes back what was declared, if it was."""
        with self._declaring:
            if self.declared is not None:
                self.declared.undeclare()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    @property
    def is_closed(self) -> bool:
        """Whether it was taken back."""
        return self._ended.is_set()

    def close(self) -> None:
        """Takes it back; further calls do nothing."""
        if not self._ended.is_set():
            self._ended.set()
            self._end()

    @abstractmethod
    def _end(self) -> None:
        """Undeclares and ends the threads."""
