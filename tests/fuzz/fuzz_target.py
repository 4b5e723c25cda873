"""What a fuzz target is, and the watch that says what a call did wrong."""

import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from random import Random
from traceback import walk_tb
from typing import Final

from gnd.gnd_map.errors import GndError

MAX_CALL_S: Final = 1.0
"""CPU time of this process: what other programs take does not count."""
MAX_GROWTH_BYTES: Final = 200 << 20

Mutate = Callable[[bytes, Random], bytes]
Seeds = Callable[[], Sequence[bytes]]


@dataclass(frozen=True)
class FuzzTarget:
    """One way in which bytes from outside come into the project.

    Attributes:
        name: of the target, and of its folder of inputs.
        reads: the functions that it covers, dotted as in the list of decoders (`fuzz_entries`).
        form: the format, in words.
        call: gives the bytes to the decoder, and opens what comes out as the programs do.
        seeds: good inputs, by the project's own encoders.
        mutate: changes that keep the structure, so that the decoder gets behind its first check.
        refuses: the errors by which the decoder may refuse.
        rounds: mutations in the tests; fewer where a call takes long.
    """

    name: str
    reads: tuple[str, ...]
    form: str
    call: Callable[[bytes], object]
    seeds: Seeds
    mutate: Mutate
    refuses: tuple[type[BaseException], ...] = (GndError,)
    rounds: int = 40


@dataclass(frozen=True)
class Finding:
    """What one input did that no input may do.

    Attributes:
        kind: "foreign", "hang" or "memory".
        where: the exception with its place, or the figure.
        data: the input.
    """

    kind: str
    where: str
    data: bytes = field(repr=False)


@dataclass
class Watch:
    """Calls a target and says what went wrong; counts what was refused."""

    target: FuzzTarget
    calls: int = 0
    refused: int = 0
    longest_s: float = 0.0
    outcome: str = ""

    def call(self, data: bytes) -> Finding | None:
        """One call; `outcome` says where it was refused."""
        self.calls += 1
        self.outcome = "read"
        before_bytes, began_s = peak_rss_bytes(), time.process_time()
        try:
            self.target.call(data)
        except self.target.refuses as error:
            self.refused += 1
            self.outcome = place_of(error)
            if _of_memory(error):
                return Finding("memory", f"no room at {place_of(error)}", data)
        except (Exception, SystemExit) as error:
            return Finding("foreign", f"{type(error).__name__} at {place_of(error)}: {str(error)[:200]}", data)
        took_s = time.process_time() - began_s
        self.longest_s = max(self.longest_s, took_s)
        if took_s > MAX_CALL_S:
            return Finding("hang", f"{took_s:.1f} s", data)
        grown = peak_rss_bytes() - before_bytes  # the peak never falls: who lifts it by so much has taken so much
        return Finding("memory", f"{grown >> 20} MB", data) if grown > MAX_GROWTH_BYTES else None


def _of_memory(error: BaseException) -> bool:
    """Whether a refusal came of memory that was not there: on a larger machine it would have been taken."""
    before: BaseException | None = error
    while before is not None and not isinstance(before, MemoryError):
        before = before.__cause__ or before.__context__
    return before is not None


def peak_rss_bytes() -> int:
    """The largest resident set that this process ever had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


def place_of(error: BaseException) -> str:
    """Class, file and line where an error was raised, innermost of our own files, then innermost of all."""
    frames = [(frame.f_code.co_filename, line) for frame, line in walk_tb(error.__traceback__)]  # reads no source
    if not frames:
        return type(error).__name__
    ours = [one for one in frames if "/gnd/" in one[0] or "/studies/" in one[0]]
    named = [(ours or frames)[-1], frames[-1]]
    return f"{type(error).__name__} " + " < ".join(
        dict.fromkeys(f"{'/'.join(name.split('/')[-2:])}:{line}" for name, line in named)
    )
