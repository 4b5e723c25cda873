"""Log lines that strangers can cause, so many a minute; what was left out is counted in the next line."""

import logging
import threading
import time
from collections.abc import Callable
from typing import Final

LINES_A_MINUTE: Final = 30
"""Of each `Seldom`."""
MAX_LINE_CHARACTERS: Final = 400
_MINUTE_S: Final = 60.0


class Seldom:
    """Writes at most `LINES_A_MINUTE` lines a minute, each of at most `MAX_LINE_CHARACTERS`. Safe in several threads.

    Args:
        log: where they go.
        clock_s: a clock that does not step, s.
    """

    def __init__(self, log: logging.Logger, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._log, self._clock_s = log, clock_s
        self._lock = threading.Lock()
        self._since_s, self._lines, self._left_out = clock_s(), 0, 0

    def warning(self, text: str, *values: object) -> None:
        """As `Logger.warning`, seldom."""
        self._write(logging.WARNING, text, values, with_trace=False)

    def info(self, text: str, *values: object) -> None:
        """As `Logger.info`, seldom."""
        self._write(logging.INFO, text, values, with_trace=False)

    def exception(self, text: str, *values: object) -> None:
        """As `Logger.exception`, seldom."""
        self._write(logging.ERROR, text, values, with_trace=True)

    def _write(self, level: int, text: str, values: tuple[object, ...], *, with_trace: bool) -> None:
        with self._lock:
            now_s = self._clock_s()
            if now_s - self._since_s >= _MINUTE_S:
                self._since_s, self._lines = now_s, 0
            if self._lines >= LINES_A_MINUTE:
                self._left_out += 1
                return
            self._lines += 1
            left_out, self._left_out = self._left_out, 0
        line = (text % values)[:MAX_LINE_CHARACTERS] + (f" ({left_out} lines like it left out)" if left_out else "")
        self._log.log(level, "%s", line, exc_info=with_trace)
