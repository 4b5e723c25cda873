"""A recorded drive as a source: its items in time order, at its pace, from its first position on the Earth."""

import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator
from itertools import chain

from gnd.schemas.drive import DriveItem, GnssFix
from gnd.vehicle_agent.errors import VehicleError


def first_fix(
    items: Iterable[DriveItem], name: object, *, most_ns: int | None = None
) -> tuple[GnssFix, Iterator[DriveItem]]:
    """Return the first position of a drive, where the map frame is laid, and all its items again.

    Args:
        items: in time order.
        name: of the drive, for the message.
        most_ns: items that are older than the first position by more are left out; None: all are kept.

    Raises:
        VehicleError: there is none.
    """
    before: deque[DriveItem] = deque()
    coming = iter(items)
    for item in coming:
        before.append(item)
        while most_ns is not None and item.t_ns - before[0].t_ns > most_ns:
            before.popleft()
        if isinstance(item, GnssFix):
            return item, chain(before, coming)
    raise VehicleError(f"{name} has no GNSS fix: the vehicle would not know which tiles to ask for")


def paced(items: Iterator[DriveItem], pace: float, stop: threading.Event) -> Iterator[DriveItem]:
    """Hold items back until their time has come, at `pace` times real time; 0 holds nothing back."""
    start_s, first_ns = time.monotonic(), None
    for item in items:
        first_ns = item.t_ns if first_ns is None else first_ns
        if pace > 0:
            due_s = start_s + (item.t_ns - first_ns) * 1e-9 / pace
            stop.wait(max(0.0, due_s - time.monotonic()))
        yield item
