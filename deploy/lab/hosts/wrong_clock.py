"""Clocks of hosts that are wrong: each host's processes read the time of day through libfaketime, by a file of offset.

The monotonic clock stays what it is, as on a machine whose time of day somebody sets. Programs that ask the kernel
without the C library (those in Go, as the S3 server) have the right time.
"""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

from gnd.deploy.errors import LabError
from gnd.deploy.lab.hosts.plan import LabHost
from gnd.deploy.repeating import repeated

LIBRARY: Final = "faketime/libfaketime.so.1"
PLACES: Final = ("/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib64", "/usr/lib")
FILE: Final = "FAKETIME_TIMESTAMP_FILE"
DRIFT: Final = 1 / 60
"""s a second."""
_READ_EVERY_S: Final = 1
_STEP_S: Final = 0.5


def library() -> Path:
    """The library that stands between programs and the time of day.

    Raises:
        LabError: it is not there.
    """
    found = next((path for place in PLACES if (path := Path(place) / LIBRARY).exists()), None)
    if found is None:
        raise LabError("wrong clocks need libfaketime: apt-get install libfaketime")
    return found


@contextmanager
def clocks_may_be_wrong(folder: Path) -> Iterator[None]:
    """All that are started while the block runs read the time through libfaketime; call it before the fork server.

    Args:
        folder: for the offset of those that belong to no host: none.
    """
    right = folder / "right.clock"
    right.write_text("+0\n", encoding="ascii")
    told = {
        "LD_PRELOAD": str(library()),
        "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        "FAKETIME_CACHE_DURATION": str(_READ_EVERY_S),
        FILE: str(right),
    }
    os.environ.update(told)
    try:
        yield
    finally:
        for name in told:
            os.environ.pop(name)


class HostClocks:
    """The clocks of all hosts.

    Args:
        folder: of a file for each host, which the database's user can read.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(mode=0o755, exist_ok=True)

    def environment(self, host: LabHost) -> tuple[tuple[str, str], ...]:
        """What processes of a host have in their environment."""
        self.put(host, 0.0)
        return ((FILE, str(self._file(host))),)

    def put(self, host: LabHost, offset_s: float) -> None:
        """Set a host's clock wrong by so much; it is read again within a second or so."""
        partial = self._file(host).with_suffix(".partial")
        partial.write_text(f"{offset_s:+.3f}\n", encoding="ascii")
        partial.replace(self._file(host))

    def step(self, *hosts: LabHost, offset_s: float) -> Callable[[], None]:
        """Set clocks wrong; what sets them right."""
        for host in hosts:
            self.put(host, offset_s)
        return lambda: self._right(hosts)

    def drift(self, *hosts: LabHost) -> Callable[[], None]:
        """Let clocks be fast from now on, a second a minute; what sets them right."""
        began_s, stack = time.monotonic(), ExitStack()

        def move(_number: int) -> None:
            for host in hosts:
                self.put(host, DRIFT * (time.monotonic() - began_s))

        stack.enter_context(repeated(move, _STEP_S, "drift"))

        def end() -> None:
            stack.close()
            self._right(hosts)

        return end

    def _right(self, hosts: tuple[LabHost, ...]) -> None:
        for host in hosts:
            self.put(host, 0.0)

    def _file(self, host: LabHost) -> Path:
        return self._folder / f"{host.name}.clock"
