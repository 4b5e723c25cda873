"""CPU that was spent on each vehicle's uploads of late: who has had least comes first.

Of names that are new one comes after every three that are known, however many they are: else an invented name, on which
nothing was spent yet, would always come first.
"""

import random
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Final

from gnd.fleet_bus.turns import KNOWN_SHARE, KnownTurns

HALF_LIFE_S: Final = 60.0
REMEMBERED: Final = 4_096


class ServedCpu:
    """Accounts of CPU that fade. Safe in several threads.

    Args:
        clock_s: a clock that does not step, s.
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._lock = threading.Lock()
        self._spent: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._turns = KnownTurns(clock_s)

    def spent(self, vehicle: str, cpu_s: float) -> None:
        """So much CPU went into an upload of a vehicle; "": Gaussians, which do not tell whose they are."""
        with self._lock:
            self._turns.is_known(vehicle)
            self._spent[vehicle] = self._faded(vehicle) + cpu_s, self._clock_s()
            self._spent.move_to_end(vehicle)
            while len(self._spent) > REMEMBERED:
                self._spent.popitem(last=False)

    def in_turn(self, vehicles: Iterable[str]) -> list[str]:
        """The vehicles in the order in which their uploads are to be looked at."""
        with self._lock:
            groups: dict[bool, list[tuple[float, float, str]]] = {True: [], False: []}
            every = list(vehicles)
            for vehicle in every:
                share = len(every) if not vehicle else 1  # those of all vehicles
                spent_s = self._faded(vehicle) / share
                group = groups[not vehicle or self._turns.is_known(vehicle)]
                group.append((spent_s, random.random(), vehicle))  # among equals no name comes first
            known, new = ([vehicle for *_, vehicle in sorted(groups[is_known])] for is_known in (True, False))
        return _mixed(known, new)

    def _faded(self, name: str) -> float:
        amount, since_s = self._spent.get(name, (0.0, 0.0))
        return amount * 0.5 ** ((self._clock_s() - since_s) / HALF_LIFE_S) if amount else 0.0


def _mixed(known: list[str], new: list[str]) -> list[str]:
    """One that is new after each `KNOWN_SHARE` that are known, while there are of both."""
    found: list[str] = []
    for at, vehicle in enumerate(new):
        found += [*known[at * KNOWN_SHARE : (at + 1) * KNOWN_SHARE], vehicle]
    return found + known[len(new) * KNOWN_SHARE :]
