"""CPU that was spent on each vehicle's uploads of late: who has had least comes first.

Names that are new share one account of a quarter of it all, however many they are: else an invented name, on which
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
_NEW: Final = "\0new"
_KNOWN: Final = "\0known"


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
            group = _KNOWN if not vehicle or self._turns.is_known(vehicle) else _NEW
            for name in (vehicle, group):
                self._spent[name] = self._faded(name) + cpu_s, self._clock_s()
                self._spent.move_to_end(name)
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
            known_first = self._faded(_KNOWN) <= KNOWN_SHARE * self._faded(_NEW)
            ordered = sorted(groups[known_first]) + sorted(groups[not known_first])
        return [vehicle for *_, vehicle in ordered]

    def _faded(self, name: str) -> float:
        amount, since_s = self._spent.get(name, (0.0, 0.0))
        return amount * 0.5 ** ((self._clock_s() - since_s) / HALF_LIFE_S) if amount else 0.0
