"""The same recorded drive with an error added: the stream of measurements and the header are changed on their way."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from math import radians
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import exp_so3
from gnd.schemas.drive import DriveHeader, DriveItem, GnssFix, MotionSample, Scan

MOUNT_M: Final = 0.01
MOUNT_RAD: Final = radians(0.05)
WHEEL_SCALE: Final = 1.02
OUTAGE_NS: Final = 30_000_000_000
OUTLIER_SHARE: Final = 0.05
ELSEWHERE_NS: Final = 5_000_000_000
_KEEP_EVERY_NS: Final = 1_000_000_000


class Variant:
    """The drive as recorded; made anew for every run, all that is random from its seed.

    Attributes:
        posed: told by who drives: the vehicle has had a pose.
    """

    def __init__(self, seed: int) -> None:
        self.posed = False
        self._rng = np.random.default_rng([seed, 0x5EED])

    def header(self, header: DriveHeader) -> DriveHeader:
        """Return what the vehicle is told about its sensor."""
        return header

    def items(self, item: DriveItem) -> Iterator[DriveItem]:
        """Give what becomes of a measurement."""
        yield item


class MountError(Variant):
    """The header's mount is off by 1 cm and 0.05 deg in a random direction, on top of the drive's own error."""

    def header(self, header: DriveHeader) -> DriveHeader:
        """Give the header with a wrong mount."""
        off = np.eye(4)
        off[:3, :3] = exp_so3(MOUNT_RAD * _direction(self._rng))
        off[:3, 3] = MOUNT_M * _direction(self._rng)
        return replace(header, T_vehicle_lidar=header.T_vehicle_lidar @ off)


class WheelScale(Variant):
    """The wheel speed is 2 % too high, on top of the drive's own error."""

    def items(self, item: DriveItem) -> Iterator[DriveItem]:
        """Give every measurement, speeds scaled."""
        yield replace(item, speed_mps=item.speed_mps * WHEEL_SCALE) if isinstance(item, MotionSample) else item


class GnssOutage(Variant):
    """No GNSS for 30 s from the first pose on."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self._begun_ns: int | None = None

    def items(self, item: DriveItem) -> Iterator[DriveItem]:
        """Give every measurement but the fixes of the outage."""
        if self.posed and self._begun_ns is None:
            self._begun_ns = item.t_ns
        out = self._begun_ns is not None and item.t_ns - self._begun_ns < OUTAGE_NS
        if not (out and isinstance(item, GnssFix)):
            yield item


class OutlierScans(Variant):
    """One scan in twenty is another: one taken at least 5 s before, or its own with the ranges of its points mixed."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self._kept: list[Scan] = []

    def items(self, item: DriveItem) -> Iterator[DriveItem]:
        """Give every measurement, some scans replaced."""
        if not isinstance(item, Scan) or len(item) == 0:
            yield item
            return
        if not self._kept or item.t_ns - self._kept[-1].t_ns >= _KEEP_EVERY_NS:
            self._kept.append(item)
        yield self._other(item) if self._rng.random() < OUTLIER_SHARE else item

    def _other(self, scan: Scan) -> Scan:
        elsewhere = [kept for kept in self._kept if scan.t_ns - kept.t_ns >= ELSEWHERE_NS]
        if elsewhere and self._rng.random() < 0.5:
            return replace(elsewhere[self._rng.integers(len(elsewhere))], t_ns=scan.t_ns)
        return self._mixed(scan)

    def _mixed(self, scan: Scan) -> Scan:
        range_m = np.maximum(np.linalg.norm(scan.points_m, axis=1), 1e-6)
        factor = self._rng.permutation(range_m) / range_m
        return replace(scan, points_m=np.ascontiguousarray(scan.points_m * factor[:, None], dtype=np.float32))


class NoDeskew(Variant):
    """Every point is taken as measured in the middle of its sweep: what motion distortion costs if it is left in."""

    def items(self, item: DriveItem) -> Iterator[DriveItem]:
        """Give every measurement, scans without their points' times."""
        if isinstance(item, Scan) and len(item):
            middle_ns = int(item.t_offset_ns.max()) // 2
            item = replace(item, t_ns=item.t_ns + middle_ns, t_offset_ns=np.zeros_like(item.t_offset_ns))
        yield item


WITHOUT: Final = "without_submap"
OUTDATED: Final = "outdated"
UPDATED: Final = "updated"
FRESH: Final = "fresh"
"""Runs without added errors: on the outdated map without and with submaps, and on the two newer maps."""
VARIANTS: Final[Mapping[str, type[Variant]]] = {
    "mount_error": MountError,
    "wheel_scale": WheelScale,
    "gnss_outage": GnssOutage,
    "outlier_scans": OutlierScans,
    "no_deskew": NoDeskew,
}
LABELS: Final[Mapping[str, str]] = {
    "mount_error": "mount off by 1 cm, 0.05°",
    "wheel_scale": "wheel scale off by 2 %",
    "gnss_outage": "30 s without GNSS",
    "outlier_scans": "5 % of scans are others",
    "no_deskew": "motion distortion left in",
}


def variant_of(name: str, seed: int) -> Variant:
    """Return a variant by its name, "" for the drive as it is."""
    return VARIANTS[name](seed) if name else Variant(seed)


def _direction(rng: np.random.Generator) -> F64:
    drawn = rng.normal(size=3)
    return np.asarray(drawn / np.linalg.norm(drawn))
