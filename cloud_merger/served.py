"""CPU that was spent on each vehicle's uploads of late: who has had least comes first, who has had too much waits.

Of names that are new one comes after every three that are known, however many they are: else an invented name, on which
nothing was spent yet, would always come first. Each vehicle has a bucket of CPU seconds, and while there are vehicles
that are known all newcomers share one more: what invented names cost is bounded, whatever else there is to do. Uploads
of those whose bucket is empty stay in the store until it has filled again.
"""

import logging
import math
import random
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Final

from gnd.cloud_merger.admission import TokenBucket
from gnd.fleet_bus.seldom import Seldom
from gnd.fleet_bus.turns import KNOWN_SHARE, KnownTurns

HALF_LIFE_S: Final = 60.0
REMEMBERED: Final = 16_384
CPU_S_A_MINUTE: Final = 15.0
"""Of a vehicle, on the average; ten reports of a street cost a hundredth of it."""
CPU_S_AT_ONCE: Final = 60.0
"""A vehicle that was out of reach has so much to be looked at."""
NEW_CPU_S_A_MINUTE: Final = 12.0
"""Of all newcomers together ..."""
NEW_CPU_S_AT_ONCE: Final = 3.0
KNOWN_COME_S: Final = 60.0
"""... while something of a known vehicle has come within so long."""
_SELDOM = Seldom(logging.getLogger(__name__))


class ServedCpu:
    """Accounts of CPU that fade, and buckets of it. Safe in several threads.

    Args:
        clock_s: a clock that does not step, s.
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._lock = threading.Lock()
        self._spent: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._buckets: OrderedDict[str, TokenBucket] = OrderedDict()
        self._newcomers = TokenBucket(NEW_CPU_S_A_MINUTE, NEW_CPU_S_AT_ONCE, clock_s())
        self._turns = KnownTurns(clock_s)
        self._known_s = -math.inf
        self.held_back = 0
        """Vehicles whose uploads waited at the last look because of what was spent on them."""
        self.spent_s = {"known": 0.0, "new": 0.0}
        """CPU seconds since this process began."""

    def spent(self, vehicle: str, cpu_s: float) -> None:
        """So much CPU went into an upload of a vehicle; "": Gaussians, which do not tell whose they are."""
        with self._lock:
            now_s = self._clock_s()
            is_known = not vehicle or self._turns.is_known(vehicle)
            self.spent_s["known" if is_known else "new"] += cpu_s
            if vehicle:
                bucket = self._bucket(vehicle, now_s)
                for one in (bucket,) if is_known else (bucket, self._newcomers):
                    one.missing_s(0.0, now_s)
                    one.take(cpu_s)
            self._spent[vehicle] = self._faded(vehicle) + cpu_s, now_s
            self._spent.move_to_end(vehicle)
            while len(self._spent) > REMEMBERED:
                self._spent.popitem(last=False)

    def in_turn(self, vehicles: Iterable[str]) -> list[str]:
        """The vehicles in the order in which their uploads are to be looked at, without those that have to wait."""
        with self._lock:
            now_s = self._clock_s()
            groups: dict[bool, list[tuple[float, float, str]]] = {True: [], False: []}
            every = list(vehicles)
            over = [vehicle for vehicle in every if self._is_over(vehicle, now_s)]
            for vehicle in set(every).difference(over):
                share = len(every) if not vehicle else 1  # those of all vehicles
                spent_s = self._faded(vehicle) / share
                is_known = bool(vehicle) and self._turns.is_known(vehicle)
                self._known_s = now_s if is_known else self._known_s
                group = groups[not vehicle or is_known]
                group.append((spent_s, random.random(), vehicle))  # among equals no name comes first
            known, new = ([vehicle for *_, vehicle in sorted(groups[is_known])] for is_known in (True, False))
            if now_s - self._known_s < KNOWN_COME_S and self._newcomers.missing_s(0.0, now_s) > 0:
                self.held_back, new = len(over) + len(new), []
            else:
                self.held_back = len(over)
        if over:
            _SELDOM.warning(
                "uploads of %d vehicles wait, more than %g s of CPU a minute went into theirs: %s ...",
                len(over), CPU_S_A_MINUTE, over[0],
            )  # fmt: skip
        return _mixed(known, new)

    def _is_over(self, vehicle: str, now_s: float) -> bool:
        bucket = self._buckets.get(vehicle)
        return bucket is not None and bucket.missing_s(0.0, now_s) > 0

    def _bucket(self, vehicle: str, now_s: float) -> TokenBucket:
        bucket = self._buckets.get(vehicle)
        if bucket is None:
            bucket = self._buckets[vehicle] = TokenBucket(CPU_S_A_MINUTE, CPU_S_AT_ONCE, now_s)
            if len(self._buckets) > REMEMBERED:
                self._buckets.popitem(last=False)
        self._buckets.move_to_end(vehicle)
        return bucket

    def _faded(self, name: str) -> float:
        amount, since_s = self._spent.get(name, (0.0, 0.0))
        return amount * 0.5 ** ((self._clock_s() - since_s) / HALF_LIFE_S) if amount else 0.0


def _mixed(known: list[str], new: list[str]) -> list[str]:
    """One that is new after each `KNOWN_SHARE` that are known, while there are of both."""
    found: list[str] = []
    for at, vehicle in enumerate(new):
        found += [*known[at * KNOWN_SHARE : (at + 1) * KNOWN_SHARE], vehicle]
    return found + known[len(new) * KNOWN_SHARE :]
