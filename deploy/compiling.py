"""What a person sees while kernels are compiled: on a new machine a command would else seem to hang for a minute."""

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from gnd.gnd_map.jit import kernels_ready, tell_compiling

LINE: Final = "gnd: compiling kernels for this machine; this happens once and takes a minute or two"
EVERY_S: Final = 5.0
"""Time between two lines of progress."""
_FILE: Final = "GND_COMPILING"
_LOOK_S: Final = 0.3


def say_progress() -> Callable[[str], None]:
    """Return what prints a line at the first kernel, then one every few seconds: how many kernels are ready.

    On a terminal only, since programs read the lines of errors.
    """
    printed_s: list[float] = []

    def say(kernel: str) -> None:
        now_s = time.monotonic()
        if not sys.stderr.isatty() or (printed_s and now_s - printed_s[-1] < EVERY_S):
            return
        ready, known = kernels_ready()
        line = f"gnd: {ready} of at most {known} kernels are ready, compiling {kernel}" if printed_s else LINE
        print(line, file=sys.stderr, flush=True)
        printed_s.append(now_s)

    return say


@contextmanager
def watched_elsewhere(show: Callable[[int, int], object]) -> Iterator[None]:
    """Show how far the fork server that is started in the block is with its kernels.

    Args:
        show: gets the numbers of kernels that are ready and known; never called where none has to be compiled.
    """
    from gnd.deploy.repeating import repeated

    with TemporaryDirectory(prefix="gnd-") as folder:
        file = Path(folder) / "compiling"

        def look(_number: int) -> None:
            words = file.read_text(encoding="ascii").split() if file.exists() else []
            if len(words) == 2:  # else it is just being written
                show(int(words[0]), int(words[1]))

        os.environ[_FILE] = str(file)
        try:
            with repeated(look, _LOOK_S, "compiling"):
                yield
        finally:
            del os.environ[_FILE]


def tell_watcher() -> None:
    """Report each kernel that this process compiles to the process that watches it, if there is one."""
    if _FILE not in os.environ:
        return
    file = Path(os.environ[_FILE])

    def tell(_kernel: str) -> None:
        file.write_text("{} {}".format(*kernels_ready()), encoding="ascii")

    tell_compiling(tell)
