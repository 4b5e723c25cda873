"""Starts without any pose, somewhere in the drive: GNSS 2.5 m off, heading unknown."""

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory
from gnd.schemas.drive import DriveHeader, DriveItem, GnssFix, ReferencePose, Scan
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.sources.recording import first_fix
from studies.localisation_study.localising import LocalisingVehicle
from studies.localisation_study.series import PoseSeries
from studies.simulation.base_map import BaseMap

GNSS_M: Final = 2.5
WITHIN_S: Final = 15.0
"""A vehicle inside a place that was rebuilt waits, with a few layers, until it has left it: some 5 s at 9 m/s."""
WATCHED_S: Final = 2.0
"""After the first pose that is called good the vehicle drives on so long: is it still right?"""
_WHITE_M: Final = 0.2
_AXES: Final = (1.0, 1.0, 1.5)


@dataclass(frozen=True, slots=True)
class StartTrial:
    """One start.

    Attributes:
        begin_ns: its time.
        good_after_s: until a pose was called good, None if none was within `WITHIN_S`.
        right: whether that pose was within the paper's maxima (0.44 m, 0.5 deg).
        wrong_called_good: scans whose pose was called good while it was not.
        scans: that were driven.
    """

    begin_ns: int
    good_after_s: float | None
    right: bool
    wrong_called_good: int
    scans: int


def begin_times(items: Sequence[DriveItem], n: int, seed: int) -> list[int]:
    """Return the times of n starts, evenly at random where `WITHIN_S` is left (a shorter drive: half of it)."""
    first, last = items[0].t_ns, items[-1].t_ns
    room_ns = max(last - first - int(WITHIN_S * 1e9), (last - first) // 2)
    rng = np.random.default_rng([seed, 0x7217])
    return sorted((first + rng.integers(room_ns, size=n)).tolist())


def run_trial(
    header: DriveHeader,
    items: Sequence[DriveItem],
    begin_ns: int,
    base: BaseMap,
    parameters: LocaliserParameters,
    seed: int,
) -> StartTrial:
    """Start a fresh localiser at a time of the drive.

    Args:
        header: of the drive.
        items: the whole drive, in time order.
        begin_ns: nothing before is seen.
        base: the map.
        parameters: of the localiser.
        seed: of the error of the GNSS.
    """
    end_ns = begin_ns + int(WITHIN_S * 1e9)
    part = items[bisect_left(items, begin_ns, key=_t_ns) : bisect_left(items, end_ns, key=_t_ns)]
    poses = [item for item in part if isinstance(item, ReferencePose)]
    rest = [item for item in part if not isinstance(item, ReferencePose)]
    fix, stream = first_fix(_other_fixes(rest, header, poses, np.random.default_rng([seed, begin_ns])), header.drive_id)
    vehicle = LocalisingVehicle(header, fix, base, parameters)
    scans = _drive(vehicle, stream)
    return judged(PoseSeries.of(vehicle.online, vehicle.reference(poses)), begin_ns, scans)


def _drive(vehicle: LocalisingVehicle, items: Iterator[DriveItem]) -> int:
    """Drive until a while after the first good pose; the number of scans."""
    good_ns: int | None = None
    for item in items:
        if good_ns is not None and item.t_ns - good_ns > WATCHED_S * 1e9:
            break
        vehicle.scans += isinstance(item, Scan)
        vehicle.push(item)
        if good_ns is None and vehicle.online and vehicle.online[-1].health == "good":
            good_ns = item.t_ns
    return vehicle.scans


def judged(online: PoseSeries, begin_ns: int, scans: int) -> StartTrial:
    """Return what the online poses of a start are worth: the first that is called good decides."""
    good = np.flatnonzero(online.good)
    wrong = int(np.count_nonzero(online.good & online.wrong))
    if not len(good):
        return StartTrial(begin_ns, None, right=False, wrong_called_good=wrong, scans=scans)
    first = good[0]
    return StartTrial(begin_ns, (int(online.t_ns[first]) - begin_ns) * 1e-9, not online.wrong[first], wrong, scans)


def _other_fixes(
    items: Sequence[DriveItem], header: DriveHeader, poses: Sequence[ReferencePose], rng: np.random.Generator
) -> Iterator[DriveItem]:
    """The measurements with fixes drawn anew: a constant error of `GNSS_M` and some noise."""
    true = Trajectory(np.array([p.t_ns for p in poses], np.int64), np.stack([p.T_map_vehicle for p in poses]))
    axes_m = GNSS_M / np.sqrt(2.0) * np.array(_AXES)
    offset_m = axes_m * rng.standard_normal(3)
    for item in items:
        if not isinstance(item, GnssFix):
            yield item
            continue
        p_m: F64 = true.at(item.t_ns)[:3, 3] + offset_m + _WHITE_M * rng.standard_normal(3)
        lat, lon, height = header.anchor.geodetic_from_enu(p_m[None])
        yield GnssFix(item.t_ns, float(lat[0]), float(lon[0]), float(height[0]), GNSS_M)


def _t_ns(item: DriveItem) -> int:
    return item.t_ns


def trials_row(trials: Sequence[StartTrial]) -> dict[str, Any]:
    """Return what came of all starts."""
    after_s = [t.good_after_s for t in trials if t.good_after_s is not None]
    right = sum(t.right for t in trials)
    return {
        "trials": len(trials),
        "right": right,
        "right_share": right / len(trials) if trials else None,
        "never_good": len(trials) - len(after_s),
        "wrong_called_good": sum(t.wrong_called_good > 0 for t in trials),
        "good_after_s": {"p50": _quantile(after_s, 0.5), "p95": _quantile(after_s, 0.95)},
    }


def _quantile(values: Sequence[float], q: float) -> float | None:
    return float(np.quantile(values, q)) if values else None
