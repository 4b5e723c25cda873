"""TCP ports for tests that run side by side."""

import errno
import itertools
import os
import random
import socket
from typing import Final

# Below the ports that the system gives to clients (32768 and above on Linux): none of the many connections that other
# tests open takes one between this look and the listener's start.
FIRST, LAST = 12_000, 32_000

_OWN: Final = random.Random(os.getpid())
_START: Final = _OWN.randrange(LAST - FIRST)  # several processes, and several suites, begin at different places
_STEPS: Final = itertools.count()


def new_port() -> int:
    """A port of the loopback interface at which nobody listens; no two calls in a process give the same."""
    for step in itertools.islice(_STEPS, LAST - FIRST):
        port = FIRST + (_START + step) % (LAST - FIRST)
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise
            else:
                return port
    raise RuntimeError(f"no port from {FIRST} to {LAST} is free")
