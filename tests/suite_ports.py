"""TCP ports for tests that run side by side."""

import atexit
import errno
import os
import random
import socket
import sys
from collections.abc import Iterator
from typing import Final

# Below the ports that the system gives to clients (32768 and above on Linux): none of the many connections that other
# tests open takes one between this look and the listener's start.
FIRST, LAST = 12_000, 32_000
BLOCK = 100

_HELD: Final[list[socket.socket]] = []


def new_port() -> int:
    """A port of the loopback interface at which nobody listens; no two calls give the same, in whatever process.

    Also not while a test has closed its listener, to open it again.
    """
    return next(_PORTS)


def _ports() -> Iterator[int]:
    starts = list(range(FIRST, LAST, BLOCK))
    random.Random(os.getpid()).shuffle(starts)  # several processes, and several suites, begin at different places
    for start in starts:
        if is_ours(start):
            yield from filter(_is_free, range(start, start + BLOCK))
    raise RuntimeError(f"no port from {FIRST} to {LAST} is free")


def is_ours(start: int) -> bool:
    """Whether this process has the block of ports from now on: it holds a name that the machine has once.

    Names without a file go with their process, however it ends; other systems than Linux have none.
    """
    if not sys.platform.startswith("linux"):
        return True
    name = socket.socket(socket.AF_UNIX)
    if not _bound(name, f"\0gnd-suite-ports-{start}"):
        name.close()
        return False
    _HELD.append(name)
    atexit.register(name.close)
    return True


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        return _bound(probe, ("127.0.0.1", port))


def _bound(one: socket.socket, address: "str | tuple[str, int]") -> bool:
    try:
        one.bind(address)
    except OSError as error:
        if error.errno != errno.EADDRINUSE:
            raise
        return False
    return True


_PORTS: Final = _ports()
