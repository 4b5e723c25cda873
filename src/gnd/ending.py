"""The end of a program that has used the bus: by the system's own exit, once everything is written.

A thread that comes back from zenoh while the interpreter is being taken down is ended by force inside zenoh's frames,
and the whole process aborts with "FATAL: exception not rethrown" and status -6 although its work was done. So a program
of ours is not taken down: when its threads have ended and what others registered for the end has run, it exits.

Import this module before others: what is registered first runs last.
"""

import atexit
import logging
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Final

_status: int | None = None
_FAILED: Final = 1


def run_program(main: Callable[[], None]) -> None:
    """Run a program's main function and let the process exit with its status as soon as it is over.

    Raises:
        SystemExit: with the status; whatever else `main` raises.
    """
    global _status  # noqa: PLW0603 - one end a process
    _status = _FAILED
    try:
        main()
    except SystemExit as end:
        _status = _number_of(end.code)
        raise
    _status = 0


def _number_of(code: object) -> int:
    """Status of a process that ends with this code, by the rules of `sys.exit`."""
    if code is None:
        return 0
    return code & 0xFF if isinstance(code, int) else _FAILED


def _exit() -> None:
    if _status is None:
        return
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):  # whoever read it has gone, or it was closed
            stream.flush()
    os._exit(_status)


atexit.register(_exit)
