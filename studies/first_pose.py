"""The first pose from a GNSS fix 2.5 m off and no idea of the heading, on an outdated map, sensor by sensor.

Drives through the tuning world after it changed, with traffic, up and down the street; on each, localisers are started
at random times with a GNSS error of their own, and run for some seconds. Right: the first pose that is not `lost` lies
within Ford's limits of a local street (0.44 m, 0.5 degrees). Called good while wrong: at any moment a pose beyond them
had the health `good`.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from time import process_time

import numpy as np

from gnd.fleet_sim.street import StreetOptions, street
from gnd.gnd_map.arrays import F64
from gnd.schemas.drive import MotionSample, Scan
from gnd.vehicle_agent.tiles_at_hand import localising_on
from studies.frame.measure import Figure
from studies.localisation_scenes import Localising
from studies.short_drives import MappedStreet, ShortDrive, gnss_offset_m, is_wrong

SEED, LENGTH_M = 101, 300.0
SENSORS = ("VLP-16", "HDL-64E", "Scala")
STARTS, WINDOW_S, FIX_NS = 6, 10.0, 100_000_000  # starts a drive, of which there are two a sensor


@dataclass(slots=True)
class Start:
    """One start: when, with which GNSS error, and what came of it."""

    first_ns: int
    last_ns: int
    offset_m: F64
    vehicle: Localising
    found_s: float = np.inf
    good_s: float = np.inf
    first_right: bool | None = None
    right: bool = False
    wrong_good: int = 0
    good: int = 0
    longest_s: float = 0.0
    next_fix_ns: int = 0
    seen_ns: int = field(default=-1)


def run() -> list[Figure]:
    """Measure every sensor."""
    place = MappedStreet(street(SEED, StreetOptions(length_m=LENGTH_M, site="wangsimni")))
    figures: list[Figure] = []
    for sensor in SENSORS:
        up, down = place.drive(sensor, "after", 1, 0), place.drive(sensor, "after", -1, 1)
        starts = _starts(up, 0) + _starts(down, 1)
        figures += _figures(sensor, starts)
    return figures


def _starts(drive: ShortDrive, seed: int) -> list[Start]:
    """The starts of one drive, all of them on one way through it."""
    rng = np.random.default_rng([SEED, seed])
    begin_ns, latest_s = int(drive.truth.t_ns[0]) + 500_000_000, drive.seconds - WINDOW_S - 1.0
    starts, held = [], drive.street.local_map()
    for _ in range(STARTS):
        first_ns = begin_ns + int(rng.uniform(0.0, latest_s) * 1e9)
        vehicle = localising_on(held, drive.simulation.header(), drive.true_fix(first_ns))
        starts.append(Start(first_ns, first_ns + int(WINDOW_S * 1e9), gnss_offset_m(rng), vehicle))
    for item in drive.items():
        for start in starts:
            if isinstance(item, (MotionSample, Scan)) and start.first_ns <= item.t_ns < start.last_ns:
                _feed(start, item, drive, rng)
    return starts


def _feed(start: Start, item: MotionSample | Scan, drive: ShortDrive, rng: np.random.Generator) -> None:
    begin_s = process_time()
    start.vehicle.push(item)
    start.longest_s = max(start.longest_s, process_time() - begin_s)
    if item.t_ns >= start.next_fix_ns:
        start.vehicle.push(drive.fix(item.t_ns, start.offset_m, rng))
        start.next_fix_ns = item.t_ns + FIX_NS
    _note(start, drive)


def _note(start: Start, drive: ShortDrive) -> None:
    """What the newest estimate is worth."""
    online = start.vehicle.localisation.online
    if online is None or online.t_ns <= start.seen_ns:
        return
    start.seen_ns = online.t_ns
    wrong, after_s = is_wrong(*drive.off(online.t_ns, online.T_map_vehicle)), (online.t_ns - start.first_ns) * 1e-9
    start.right = online.health != "lost" and not wrong
    if online.health != "lost" and start.first_right is None:
        start.first_right, start.found_s = not wrong, after_s
    if online.health == "good":
        start.good += 1
        start.wrong_good += wrong
        start.good_s = min(start.good_s, after_s)


def _figures(sensor: str, starts: list[Start]) -> Iterator[Figure]:
    n, good = len(starts), [s.good_s for s in starts if np.isfinite(s.good_s)]
    called = sum(s.wrong_good > 0 for s in starts)
    scans, wrong = sum(s.good for s in starts), sum(s.wrong_good for s in starts)
    right, later = sum(s.first_right is True for s in starts), sum(s.right for s in starts)
    found = sum(s.first_right is not None for s in starts)
    detail = f"{right} of {n} starts; found {found}; right {WINDOW_S:.0f} s after the start {later}"
    yield Figure(f"{sensor}: right", 100.0 * right / n, "%", detail)
    yield Figure(f"{sensor}: wrong, called good", float(called), "starts", f"{wrong} of {scans} good estimates")
    yield Figure(
        f"{sensor}: median time to good", float(np.median(good)) if good else np.nan, "s",
        f"{len(good)} of {n} became good; found after {np.median([s.found_s for s in starts]):.2f} s (median)",
    )  # fmt: skip
    longest = [s.longest_s for s in starts]
    yield Figure(f"{sensor}: longest step", float(np.median(longest)), "s", f"median start; worst {max(longest):.2f} s")
