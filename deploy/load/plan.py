"""Who sends what when: every vehicle drives along street after street, and sends what its drive has sent there."""

import heapq
import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Literal

import numpy as np

from gnd.deploy.errors import LoadError

Pace = Literal["real", "max"]
MAX_VEHICLES: Final = 20_000
MAX_CLIENTS: Final = 8


@dataclass(frozen=True, slots=True)
class LoadOptions:
    """What to replay.

    Attributes:
        vehicles: how many.
        km: way of each.
        pace: "real": at `kmh`; "max": as fast as they are acknowledged.
        kmh: speed of all.
        seconds: no report is sent later than this after the start; inf: all are sent.
        seed: of where vehicles start and of the ids of their reports.
        per_street: vehicles that are on a street at the same time, on the average.
        changed_share: of the streets, how many are mapped as they were before they changed; the map of the others is as
            it was after the kept drives had healed it.
        shards: merger shards.
        clients: processes that send; vehicles are shared out among them.
        in_flight: requests that each of them has under way at most.
        drain_s: what has come must be in the map so long after the last report.
    """

    vehicles: int = 100
    km: float = 1.0
    pace: Pace = "real"
    kmh: float = 30.0
    seconds: float = math.inf
    seed: int = 1
    per_street: int = 4
    changed_share: float = 1.0
    shards: int = 2
    clients: int = 2
    in_flight: int = 50
    drain_s: float = 10.0

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        _require(1 <= self.vehicles <= MAX_VEHICLES, f"vehicles must be 1 to {MAX_VEHICLES}, got {self.vehicles}")
        _require(0 < self.km <= 10_000, f"km must be above 0, at most 10,000, got {self.km}")
        _require(self.pace in ("real", "max"), f"pace must be real or max, got {self.pace!r}")
        _require(0 < self.kmh <= 300, f"kmh must be above 0, at most 300, got {self.kmh}")
        _require(self.seconds > 0, f"seconds must be positive, got {self.seconds}")
        _require(1 <= self.per_street <= 1000, f"per_street must be 1 to 1000, got {self.per_street}")
        _require(0 <= self.changed_share <= 1, f"changed_share must lie in [0, 1], got {self.changed_share}")
        _require(1 <= self.shards <= 32, f"shards must be 1 to 32, got {self.shards}")
        _require(1 <= self.clients <= MAX_CLIENTS, f"clients must be 1 to {MAX_CLIENTS}, got {self.clients}")
        _require(1 <= self.in_flight <= 1000, f"in_flight must be 1 to 1000, got {self.in_flight}")
        _require(self.drain_s > 0, f"drain_s must be positive, got {self.drain_s}")

    @property
    def streets(self) -> int:
        """Copies of the street."""
        return max(1, math.ceil(self.vehicles / self.per_street))

    @property
    def speed_m_s(self) -> float:
        """Of all vehicles."""
        return self.kmh / 3.6

    def is_changed(self, street: int) -> bool:
        """Whether the map of a street is older than its changes; those that are, are spread evenly."""
        return math.floor((street + 1) * self.changed_share) > math.floor(street * self.changed_share)


@dataclass(frozen=True, slots=True, order=True)
class Due:
    """One report of one vehicle.

    Attributes:
        at_s: when it is to be sent, from the start of the run.
        vehicle: its number.
        passage: the how many-th street of this vehicle it is, from 0.
        street: number of the copy.
        drive: number of the kept drive.
        report: number among the drive's reports.
    """

    at_s: float
    vehicle: int
    passage: int
    street: int
    drive: int
    report: int


@dataclass(frozen=True, slots=True)
class Timetable:
    """When each vehicle sends.

    Attributes:
        options: of the load.
        changed_at_m: of each kept drive the ways at which it reports on a street that has changed, ascending.
        settled_at_m: the same of one that has not.
        length_m: of a street.
    """

    options: LoadOptions
    changed_at_m: tuple[tuple[float, ...], ...]
    settled_at_m: tuple[tuple[float, ...], ...]
    length_m: float

    def due(self, vehicles: range) -> Iterator[Due]:
        """The reports of these vehicles in the order of their times."""
        return heapq.merge(*(self._of(vehicle) for vehicle in vehicles))

    def count(self, vehicles: range) -> int:
        """How many they are."""
        return sum(1 for vehicle in vehicles for _ in self._of(vehicle))

    def _of(self, vehicle: int) -> Iterator[Due]:
        """It begins somewhere in its first street, so that all together send evenly from the first second on. Vehicles
        that share a street repeat different drives, as far as there are.
        """
        options = self.options
        first_m = float(np.random.default_rng((options.seed, vehicle)).uniform(0.0, self.length_m))
        last_m, passage = first_m + 1000.0 * options.km, 0
        while passage * self.length_m < last_m:
            street = (vehicle + passage) % options.streets
            drives = self.changed_at_m if options.is_changed(street) else self.settled_at_m
            drive = (vehicle // options.streets) % len(drives)
            for number, here_m in enumerate(drives[drive]):
                way_m = passage * self.length_m + here_m
                at_s = (way_m - first_m) / options.speed_m_s
                if first_m <= way_m < last_m and (at_s <= options.seconds or options.pace == "max"):
                    yield Due(at_s, vehicle, passage, street, drive, number)
            passage += 1


def shared_out(vehicles: int, clients: int) -> list[range]:
    """The vehicles of each client; clients without any are left out."""
    bounds = [vehicles * n // clients for n in range(clients + 1)]
    return [range(a, b) for a, b in pairwise(bounds) if b > a]


def _require(is_good: bool, complaint: str) -> None:
    if not is_good:
        raise LoadError(complaint)
