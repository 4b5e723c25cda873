"""What the vehicle's model of its sensors does not know: faults put into a simulated drive after it was made."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from gnd.fleet_sim.roads.drive import RoadDrive
from gnd.gnd_map.arrays import F64
from gnd.schemas.drive import Detections

SIGN_RANGE: Final = 0.05
SIGN_BEARING_RAD: Final = np.radians(1.0)
"""Standard deviations of errors that stay with each sign: of its range as a share, and of its bearing."""
CAMERA_RAD: Final = np.radians(0.5)
JUMP_EVERY_S: Final = 120.0
JUMP_S: Final = (20.0, 60.0)
JUMP_M: Final = (8.0, 20.0)
"""Reflections: how long after each other they begin, how long they last, how far off they are, in any direction."""


def with_faults(drive: RoadDrive, faults: Collection[str], seed: int) -> RoadDrive:
    """Return a drive with faults of `FAULTS`, drawn from the seed; their order does not matter."""
    for name in sorted(faults):
        number = sorted(FAULTS).index(name)
        drive = FAULTS[name][1](drive, np.random.default_rng([seed, drive.seed, 91, number]))
    return drive


def _signs(drive: RoadDrive, rng: np.random.Generator) -> RoadDrive:
    """A detector errs in the same way whenever it sees the same sign."""
    ids = np.unique(np.concatenate([np.zeros(1, np.int64), *drive.truth.of_detection]))
    share, turn = SIGN_RANGE * rng.standard_normal(len(ids)), SIGN_BEARING_RAD * rng.standard_normal(len(ids))
    share[0] = turn[0] = 0.0  # false alarms
    looks = []
    for look, of in zip(drive.looks, drive.truth.of_detection, strict=True):
        rows = np.searchsorted(ids, of)
        looks.append(_moved(look, 1.0 + np.maximum(share[rows], -0.5), turn[rows]))
    return replace(drive, looks=tuple(looks))


def _camera(drive: RoadDrive, _: np.random.Generator) -> RoadDrive:
    return replace(
        drive,
        looks=tuple(
            _moved(look, np.ones(len(look.kinds)), np.full(len(look.kinds), CAMERA_RAD)) for look in drive.looks
        ),
    )


def _moved(look: Detections, scale: F64, turn_rad: F64) -> Detections:
    range_m = (look.range_m * scale).astype(look.range_m.dtype)
    return replace(look, range_m=range_m, bearing_rad=(look.bearing_rad + turn_rad).astype(look.bearing_rad.dtype))


def _gnss(drive: RoadDrive, rng: np.random.Generator) -> RoadDrive:
    xy_m, t_s = drive.gnss.xy_m.copy(), (drive.gnss.t_ns - drive.gnss.t_ns[0]) * 1e-9
    begin_s = float(rng.exponential(JUMP_EVERY_S))
    while begin_s < t_s[-1]:
        until_s = begin_s + rng.uniform(*JUMP_S)
        angle, off_m = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*JUMP_M)
        xy_m[(t_s >= begin_s) & (t_s < until_s)] += off_m * np.array([np.cos(angle), np.sin(angle)])
        begin_s = until_s + float(rng.exponential(JUMP_EVERY_S))
    return replace(drive, gnss=replace(drive.gnss, xy_m=xy_m))


Fault = Callable[[RoadDrive, np.random.Generator], RoadDrive]
FAULTS: Final[Mapping[str, tuple[str, Fault]]] = {
    "camera": ("the camera is mounted 0.5° off", _camera),
    "gnss": ("reflections of 8 to 20 m, 20 to 60 s long, every two minutes", _gnss),
    "signs": ("5 % of range and 1° of bearing that stay with each sign", _signs),
}
