"""What a person hears while kernels are compiled: on a new machine a command would else seem to hang for a minute."""

import sys
from collections.abc import Callable
from typing import Final

LINE: Final = "gnd: compiling kernels for this machine; this happens once and takes a minute or two"


def say_once() -> Callable[[str], None]:
    """Return what says so at the first kernel: on a terminal only, since programs read the lines of errors."""
    said: list[str] = []

    def say(kernel: str) -> None:
        if not said and sys.stderr.isatty():
            print(LINE, file=sys.stderr, flush=True)
        said.append(kernel)

    return say
