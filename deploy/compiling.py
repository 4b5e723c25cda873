"""What a person hears while kernels are compiled: on a new machine a command would else seem to hang for a minute."""

import sys
from collections.abc import Callable
from typing import Final

LINE: Final = "gnd: compiling kernels for this machine; this happens once and takes a minute or two"


def say_once() -> Callable[[str], None]:
    """Return what says so on standard error, at the first kernel."""
    said: list[str] = []

    def say(kernel: str) -> None:
        if not said:
            print(LINE, file=sys.stderr, flush=True)
        said.append(kernel)

    return say
