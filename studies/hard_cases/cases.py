"""The hard cases by name: where each drives, how fast, among whom, and what is wrong with its sensors."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import radians
from typing import Final

import numpy as np

from gnd.fleet_sim.cars import parked_cars
from gnd.fleet_sim.courses.company import Companion, car, keeping, lagging, lorry, passing, van
from gnd.fleet_sim.courses.course import CoursePlace, DrivenCourse
from gnd.fleet_sim.courses.faults import Faults
from gnd.fleet_sim.courses.places import LENGTH_M
from gnd.fleet_sim.courses.ride import Ride, cruise, halting, lively

_CRUISE_MPS: Final = 9.0
_PARKED_SHARE: Final = 0.2
_BACK_M: Final = 1.4
"""Middle of the vehicle that measures, ahead of its rear axle."""
_NEIGHBOUR_M: Final = 3.5
"""Middle of the next lane, to the left."""
_END_M: Final = 2.0

Rides = Callable[[np.random.Generator, float], Ride]
"""From chance and the way that there is [m]."""
Companies = Callable[[np.random.Generator], tuple[Companion, ...]]
Errors = Callable[[np.random.Generator], Faults]


@dataclass(frozen=True, slots=True)
class Kidnap:
    """A start that is trusted and wrong: the vehicle was moved since it got its pose.

    Attributes:
        nearest_m, farthest_m: how far off the given pose is.
    """

    nearest_m: float
    farthest_m: float


def _cruising(rng: np.random.Generator, way_m: float) -> Ride:
    return cruise(rng, _CRUISE_MPS, way_m)


def _nobody(_: np.random.Generator) -> tuple[Companion, ...]:
    return ()


def _oncoming(rng: np.random.Generator) -> tuple[Companion, ...]:
    """Two cars that come towards the vehicle."""
    return tuple(
        passing(car(int(rng.integers(2**31))), float(rng.uniform(60.0, 260.0)), -8.0, _NEIGHBOUR_M) for _ in range(2)
    )


def _sound(_: np.random.Generator) -> Faults:
    return Faults()


@dataclass(frozen=True, slots=True)
class HardCase:
    """One case.

    Attributes:
        about: what it is, a line.
        place: a name of `gnd.fleet_sim.courses.places.PLACES`.
        ride, company, faults: drawn for each seed.
        kidnap: a wrong start, None for the usual search.
        length_m: of the place, roughly.
    """

    about: str
    place: str = "street"
    ride: Rides = _cruising
    company: Companies = _oncoming
    faults: Errors = _sound
    kidnap: Kidnap | None = None
    length_m: float = LENGTH_M

    def course(self, place: CoursePlace, seed: int) -> DrivenCourse:
        """Return the drive of a seed through a place that was made for this case."""
        rng = np.random.default_rng([seed, 0xCA5E])
        ride = self.ride(rng, place.lane.length_m - _END_M)
        cars = parked_cars(place.world, "after", _PARKED_SHARE, seed) if self.place in _WITH_KERBS else ()
        return DrivenCourse(place, ride, self.company(rng), self.faults(rng), cars)


_WITH_KERBS: Final = ("street", "followed", "rebuilt")
"""Places in which cars park at the kerb (the hill's kerb climbs, the others have none)."""


def _platoon(rng: np.random.Generator) -> tuple[Companion, ...]:
    """A van ahead whose rear is 12 to 15 m before the rear axle, all along."""
    return (keeping(van(), float(rng.uniform(12.0, 15.0)) + 2.8), *_oncoming(rng))


def _van_alone(rng: np.random.Generator) -> tuple[Companion, ...]:
    return _platoon(rng)[:1]


def _lorries(rng: np.random.Generator) -> tuple[Companion, ...]:
    """Lorries before, behind and beside the vehicle, at its speed."""
    ahead, behind = float(rng.uniform(13.0, 16.0)), float(rng.uniform(-15.0, -12.0))
    return (
        keeping(lorry(), ahead, 0.0, 0.3, float(rng.uniform(0, 6))),
        keeping(lorry(), behind, 0.0, 0.3, float(rng.uniform(0, 6))),
        keeping(lorry(), float(rng.uniform(-3.0, 5.0)), _NEIGHBOUR_M, 0.5, float(rng.uniform(0, 6))),
    )


def _jam(rng: np.random.Generator) -> tuple[Companion, ...]:
    """Queues in both lanes, all creeping, each a little after the one before it."""
    found = []
    for left_m in (0.0, _NEIGHBOUR_M):
        for place in (-3, -2, -1, 0, 1, 2, 3, 4):
            if place == 0 and left_m == 0.0:
                continue
            shapes = (van(), lorry(), car(int(rng.integers(2**31))))[int(rng.choice(3, p=(0.25, 0.1, 0.65)))]
            ahead = _BACK_M + 10.5 * place + float(rng.uniform(-0.8, 0.8)) + (5.0 if left_m else 0.0)
            found.append(lagging(shapes, ahead, -0.5 * place + (0.4 if left_m else 0.0), left_m))
    return tuple(found)


def _queue(rng: np.random.Generator) -> tuple[Companion, ...]:
    """A car and a van before the vehicle that stop and go with it, oncoming traffic."""
    ahead = float(rng.uniform(9.0, 11.0))
    return (lagging(van(), ahead, -0.6), lagging(car(int(rng.integers(2**31))), ahead + 10.0, -1.2), *_oncoming(rng))


def _creeping(rng: np.random.Generator, way_m: float) -> Ride:
    del way_m
    return halting(rng, 3.0, 24.0, (2.5, 5.0), (3.0, 6.0))


def _stopping(rng: np.random.Generator, way_m: float) -> Ride:
    del way_m
    return halting(rng, 8.0, 22.0, (3.5, 5.0), (4.0, 6.0))


def _fast(rng: np.random.Generator, way_m: float) -> Ride:
    return cruise(rng, 14.0, way_m)


def _slowly(rng: np.random.Generator, way_m: float) -> Ride:
    return cruise(rng, 6.0, way_m)


def _lively(rng: np.random.Generator, way_m: float) -> Ride:
    return lively(rng, _CRUISE_MPS, way_m)


def _parking(rng: np.random.Generator, way_m: float) -> Ride:
    return cruise(rng, 3.5, min(way_m, 80.0))


def _long(rng: np.random.Generator, way_m: float) -> Ride:
    return cruise(rng, way_m / 69.0, way_m)


def _clock(offset_s: float) -> Errors:
    return lambda _: Faults(clock_s=offset_s)


def _scan_clock(offset_s: float) -> Errors:
    return lambda _: Faults(scan_clock_s=offset_s)


def _clock_drift(rng: np.random.Generator) -> Faults:
    sign = float(rng.choice((-1.0, 1.0)))
    return Faults(clock_s=sign * 0.01, clock_drift=sign * 0.002)


def _either(size: float, axis: int) -> Errors:
    """A mount turned by `size` about an axis of the vehicle, to either side."""

    def of(rng: np.random.Generator) -> Faults:
        off = [0.0, 0.0, 0.0]
        off[axis] = size * float(rng.choice((-1.0, 1.0)))
        return Faults(mount_rad=(off[0], off[1], off[2]))

    return of


def _wheels(rng: np.random.Generator) -> Faults:
    return Faults(wheel_scale=0.03 * float(rng.choice((-1.0, 1.0))), slips_per_min=15.0)


_CLOCKS_MS: Final = (-50, -20, -10, 10, 20, 50)

CASES: Final[Mapping[str, HardCase]] = {
    "street": HardCase("nothing special: a street with a few edits, parked and oncoming cars"),
    "platoon_van": HardCase("a van 12 to 15 m ahead at the same speed, from the first scan on", company=_platoon),
    "platoon_field": HardCase("the same van in the open field", place="field", company=_van_alone),
    "ghost_map": HardCase(
        "behind a van, on a map whose own vehicle drove behind one that was not taken out",
        place="followed",
        company=_platoon,
    ),
    "lorries": HardCase("lorries before, behind and beside, at the same speed", company=_lorries),
    "traffic_jam": HardCase("queues in both lanes creep and stand", ride=_creeping, company=_jam),
    "stop_and_go": HardCase("up to 8 m/s and to a halt, again and again", ride=_stopping, company=_queue),
    **{
        f"clock_{'m' if ms < 0 else 'p'}{abs(ms)}": HardCase(
            f"stamps of wheels and gyro {abs(ms)} ms too {'early' if ms < 0 else 'late'} against the scans",
            ride=_lively,
            faults=_clock(ms * 1e-3),
        )
        for ms in _CLOCKS_MS
    },
    "clock_drift": HardCase(
        "the clocks begin 10 ms apart and drift by 2 ms a second", ride=_lively, faults=_clock_drift
    ),
    **{
        f"scan_clock_{'m' if ms < 0 else 'p'}{abs(ms)}": HardCase(
            f"stamps of the scans {abs(ms)} ms too {'early' if ms < 0 else 'late'} against all else and the truth",
            ride=_lively,
            faults=_scan_clock(ms * 1e-3),
        )
        for ms in (-50, 50)
    },
    "open_field": HardCase(
        "ground, delineators, eight trees, four pieces of hedge and a barn", place="field", company=_nobody
    ),
    "tunnel": HardCase(
        "213 m of smooth walls and roof, no satellites inside",
        place="tunnel",
        ride=_fast,
        company=_nobody,
        faults=lambda _: Faults(no_gnss_s=(3.0, 18.0)),
        length_m=320.0,
    ),
    "hill": HardCase("8 % up, a crest, 6 % down", place="hill"),
    "roundabout": HardCase("three quarters around a ring of 13 m", place="roundabout", ride=_slowly, company=_nobody),
    "car_park": HardCase(
        "most parked cars are others than in the map", place="car_park", ride=_parking, company=_nobody
    ),
    "avenue": HardCase("crowns and hedges that let rays through, grown since", place="avenue"),
    "mount_yaw": HardCase("the header's mount is turned by 1° about the vertical", faults=_either(radians(1.0), 2)),
    "mount_pitch": HardCase("the header's mount is pitched by 1°", faults=_either(radians(1.0), 1)),
    "wheels": HardCase("wheels tell 3 % too much or too little, and slip or lock now and then", faults=_wheels),
    "gnss_jumps": HardCase(
        "the position jumps by 30 m for some seconds, again and again",
        faults=lambda _: Faults(gnss_jump_m=30.0, gnss_jumps_per_min=12.0),
    ),
    "gnss_outage": HardCase(
        "no position for 60 s", ride=_long, faults=lambda _: Faults(no_gnss_s=(5.0, 65.0)), length_m=320.0
    ),
    "kidnap_near": HardCase("a trusted start that is 4 to 10 m off", kidnap=Kidnap(4.0, 10.0)),
    "kidnap_far": HardCase("a trusted start that is 30 to 60 m off", kidnap=Kidnap(30.0, 60.0)),
    "missing_scans": HardCase("a fifth of the scans never arrives", faults=lambda _: Faults(missing_share=0.2)),
    "blocked_sector": HardCase(
        "dirt on 60° of the window: returns at 0.3 m and none at all",
        faults=lambda _: Faults(blocked_rad=radians(60.0)),
    ),
    "rebuilt": HardCase("a third of the street was torn down and built anew", place="rebuilt"),
}
"""The cases by their names in options and results."""
