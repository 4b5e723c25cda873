"""What a bus has declared on its session: handlers, subscriptions, tokens, publishers."""

import threading
from abc import ABC, abstractmethod
from typing import Self


class Part(ABC):
    """Something declared, which `close` or the end of a `with` block takes back once."""

    def __init__(self) -> None:
        self._ended = threading.Event()

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
