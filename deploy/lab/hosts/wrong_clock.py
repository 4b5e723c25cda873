"""Clocks of hosts that are wrong: each host's processes get the time of day with an offset that a file holds.

A small library stands between programs and the C library's time of day; the monotonic clock stays what it is, as on a
machine whose time of day somebody sets. libfaketime of Debian cannot do that: with the monotonic clock left alone its
release 0.9.10 refuses `clock_nanosleep`, which Python sleeps by, and else it makes one clock of both. Programs that ask
the kernel without the C library (those in Go, as the S3 server) have the right time.
"""

import os
import shutil
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

from gnd.deploy.errors import LabError
from gnd.deploy.repeating import repeated

VARIABLE: Final = "GND_LAB_CLOCK"
DRIFT: Final = 1 / 60
"""s a second."""
_STEP_S: Final = 0.5
_COMPILE_S: Final = 60.0
_NS_PER_S: Final = 1_000_000_000
_SOURCE: Final = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static const char *name;
static volatile int64_t *offset;

/* A forked process is told another file after the fork, before it has threads. */
static int64_t now_ns(int64_t ns)
{
    const char *told = getenv("GND_LAB_CLOCK");
    if (told != name) {
        int file = told ? open(told, O_RDONLY | O_CLOEXEC) : -1;
        void *page = file < 0 ? MAP_FAILED : mmap(0, 8, PROT_READ, MAP_SHARED, file, 0);
        if (file >= 0)
            close(file);
        offset = page == MAP_FAILED ? 0 : page;
        name = told;
    }
    return offset ? ns + *offset : ns;
}

int clock_gettime(clockid_t clock, struct timespec *t)
{
    static int (*real)(clockid_t, struct timespec *);
    if (!real)
        real = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
    int code = real(clock, t);
    if (!code && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) {
        int64_t ns = now_ns((int64_t)t->tv_sec * 1000000000 + t->tv_nsec);
        t->tv_sec = ns / 1000000000;
        t->tv_nsec = ns % 1000000000;
    }
    return code;
}

int gettimeofday(struct timeval *t, void *zone)
{
    struct timespec now;
    (void)zone;
    clock_gettime(CLOCK_REALTIME, &now);
    t->tv_sec = now.tv_sec;
    t->tv_usec = now.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *t)
{
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (t)
        *t = now.tv_sec;
    return now.tv_sec;
}
"""


def compiler() -> str:
    """The C compiler that makes the library.

    Raises:
        LabError: there is none.
    """
    found = shutil.which("cc")
    if found is None:
        raise LabError("wrong clocks need a C compiler: apt-get install gcc libc6-dev")
    return found


@contextmanager
def clocks_may_be_wrong(folder: Path) -> Iterator[None]:
    """All that are started while the block runs have the clock that `VARIABLE` names; call it before the fork server.

    Args:
        folder: for the library.

    Raises:
        LabError: it cannot be compiled.
    """
    library = folder / "wrong_clock.so"
    command = [compiler(), "-shared", "-fPIC", "-O2", "-x", "c", "-", "-o", str(library), "-ldl"]
    done = subprocess.run(  # noqa: S603  (words of our own, no shell)
        command, input=_SOURCE, capture_output=True, text=True, timeout=_COMPILE_S, check=False
    )
    if done.returncode:
        raise LabError(f"the library of wrong clocks cannot be compiled: {' '.join(done.stderr.split())[-300:]}")
    folder.chmod(0o755)  # the database's user reads it
    os.environ["LD_PRELOAD"] = str(library)
    try:
        yield
    finally:
        os.environ.pop("LD_PRELOAD")


class HostClocks:
    """The clocks of all hosts, and of vehicles, by name.

    Args:
        folder: of a file for each of them, which the database's user can read.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(mode=0o755, exist_ok=True)

    def environment(self, host: str) -> tuple[tuple[str, str], ...]:
        """What processes of a host have in their environment."""
        self.put(host, 0.0)
        return ((VARIABLE, str(self._file(host))),)

    def put(self, host: str, offset_s: float) -> None:
        """Set a host's clock wrong by so much."""
        file = self._file(host)
        with file.open("r+b" if file.exists() else "w+b") as opened:
            opened.write(struct.pack("=q", round(offset_s * _NS_PER_S)))

    def step(self, *hosts: str, offset_s: float) -> Callable[[], None]:
        """Set clocks wrong; what sets them right."""
        for host in hosts:
            self.put(host, offset_s)
        return lambda: self._right(hosts)

    def drift(self, *hosts: str) -> Callable[[], None]:
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

    def _right(self, hosts: tuple[str, ...]) -> None:
        for host in hosts:
            self.put(host, 0.0)

    def _file(self, host: str) -> Path:
        return self._folder / f"{host}.clock"
