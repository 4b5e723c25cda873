"""One time for several drives that are replayed at once: who is ahead waits for those that are behind.

Drives are replayed as fast as the machine can, each by a process of its own. Where one vehicle is to drive on what
another found 10 s before it, 10 s must lie between them in the time of the drives, however busy the machine is. So
each process writes down how far it is, and none goes farther than `SLACK_S` beyond the slowest: the slowest waits for
nobody, so the clock never stands.
"""

import mmap
import struct
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gnd.schemas.drive import DriveItem
from gnd.schemas.errors import SchemaError
from gnd.vehicle_agent.errors import AgentConfigError

SLACK_S: Final = 0.5
"""Less makes processes wait for each other at every scan."""
LOOK_S: Final = 0.002
_DONE_NS: Final = 2**63 - 1
_NS_PER_S: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Departure:
    """When one vehicle of a common world starts.

    Attributes:
        clock: file of the clock that the vehicles share, made by `make_clock`.
        number: of this vehicle, from 0.
        start_s: when its drive begins, in seconds of the common time.
    """

    clock: Path
    number: int
    start_s: float

    def __post_init__(self) -> None:
        """A number and a time that can be."""
        if self.number < 0 or not 0 <= self.start_s < 1e6:
            raise AgentConfigError(f"departure of vehicle {self.number} at {self.start_s} s: both must be 0 or more")


def make_clock(path: Path, starts_s: Sequence[float]) -> None:
    """Write the clock of vehicles that all stand where they start; it stands until they drive.

    Args:
        path: a file that the vehicles' processes can map.
        starts_s: when each starts.
    """
    path.write_bytes(struct.pack(f"={len(starts_s)}q", *(round(start_s * _NS_PER_S) for start_s in starts_s)))


class WorldClock:
    """The common time as one process sees it.

    Args:
        path: file of the clock.

    Raises:
        AgentConfigError: there is no such clock.
    """

    def __init__(self, path: Path) -> None:
        try:
            with path.open("r+b") as file:
                self._map = mmap.mmap(file.fileno(), 0)
        except (OSError, ValueError) as error:
            raise AgentConfigError(f"no clock of a common world at {path}: {error}") from error
        # Whole aligned words: another process reads the old time or the new one.
        self._times_ns = memoryview(self._map).cast("q")

    @property
    def now_s(self) -> float | None:
        """How far the slowest vehicle is; None when all have arrived."""
        now_ns = min(self._times_ns)
        return None if now_ns == _DONE_NS else now_ns / _NS_PER_S

    def reach(self, number: int, t_ns: int, stop: threading.Event) -> None:
        """Wait until a vehicle may drive to `t_ns`, and write down that it does; a time that was reached stays so."""
        while t_ns > (slowest_ns := min(self._times_ns)) + SLACK_S * _NS_PER_S:
            if self._times_ns[number] == slowest_ns or stop.is_set():
                break  # a gap in the slowest vehicle's recording: all others wait for it
            stop.wait(LOOK_S)
        self._times_ns[number] = max(self._times_ns[number], t_ns)

    def arrive(self, number: int) -> None:
        """The vehicle's drive has ended: nobody waits for it any more."""
        self._times_ns[number] = _DONE_NS

    def close(self) -> None:
        """Let go of the file."""
        self._times_ns.release()
        self._map.close()


def in_common_time(
    items: Iterator[DriveItem], departure: Departure | None, stop: threading.Event
) -> Iterator[DriveItem]:
    """Hold back the items of a drive until its common world has come to their time; nothing is held without one.

    Raises:
        AgentConfigError: there is no such clock.
    """
    if departure is None:
        yield from items
        return
    clock, first_ns, start_ns = WorldClock(departure.clock), None, round(departure.start_s * _NS_PER_S)
    try:
        for item in items:
            first_ns = item.t_ns if first_ns is None else first_ns
            clock.reach(departure.number, start_ns + item.t_ns - first_ns, stop)
            yield item
        clock.arrive(departure.number)
    except SchemaError:  # a damaged recording ends here
        clock.arrive(departure.number)
        raise
    finally:  # an agent that was stopped or failed has not arrived: it is started again
        clock.close()
