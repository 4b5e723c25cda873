"""The values of a recorded drive: what a vehicle measures, and where it truly was.

Frames: `lidar` (the sensor), `vehicle` (x forward, y left, z up), `map` (ENU at the drive's anchor). Time is int ns
UTC.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from operator import mul
from typing import Final, Literal, NamedTuple, TypeVar, get_args

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import F32, F64, I64, check_array
from gnd.gnd_map.geodesy import LocalFrame, check_geodetic
from gnd.schemas import limits
from gnd.schemas.errors import BadValue, NoPlace
from gnd.schemas.looks import LOOK_SENSORS as LOOK_SENSORS
from gnd.schemas.looks import Detections as Detections
from gnd.schemas.looks import LaneLook as LaneLook
from gnd.schemas.looks import LookSensor as LookSensor
from gnd.schemas.wire import (
    PRINTABLE_PATTERN,
    VEHICLE_PATTERN,
    check_length,
    check_text,
    check_unsigned,
    refusing,
)

U32 = npt.NDArray[np.uint32]
U16 = npt.NDArray[np.uint16]

Deskew = Literal["unsaid", "measured", "reconstructed", "compensated", "none"]
"""What is known of the times of points within a sweep.

unsaid: an older drive, or one of the simulator; its offsets count as measured. measured: the recording gives them.
reconstructed: found from the azimuths. compensated: the sweeps were freed of motion before they were recorded, offsets
are zero. none: nobody knows; offsets are zero and the vehicle's motion during a sweep is in the points.
"""
MountSource = Literal["unsaid", "given", "estimated", "assumed"]
"""Where the mount comes from: the recording gives it, it was estimated from the scans, or nothing is known."""

StandIn = Literal["gnss", "motion"]
"""What a drive may hold without having measured it."""

_RIGID_TOLERANCE: Final = 1e-6
_TIME_BITS: Final = 63


def check_rigid(name: str, T: F64) -> None:
    """`BadValue` unless `T` is a (4, 4) float64 rigid transform: right-handed rotation, last row 0 0 0 1."""
    with refusing(name):
        check_array(name, T, np.float64, (4, 4))
    x, y, z, last = T.tolist()  # in plain numbers: numpy takes 0.1 ms for one pose
    rows = [[min(max(value, -2.0), 2.0) for value in row[:3]] for row in (x, y, z)]  # products of huge numbers overflow
    products = [sum(map(mul, a, b)) - (i == j) for i, a in enumerate(rows) for j, b in enumerate(rows)]
    off = max(*map(abs, products), *(abs(a - b) for a, b in zip(last, (0.0, 0.0, 0.0, 1.0), strict=True)))
    (a, b, c), (d, e, f), (g, h, i) = rows
    if off > _RIGID_TOLERANCE or a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0.0:
        raise BadValue(f"{name} is not a rigid transform: off by {off:.3g}, tolerance {_RIGID_TOLERANCE}")


def _check_known(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise BadValue(f"{name} {value!r} is not known; known are {', '.join(known)}")


class MountSigma(NamedTuple):
    """One sigma of an estimated mount; infinite where the scans did not tell (the value is then 0)."""

    height_m: float
    roll_rad: float
    pitch_rad: float
    yaw_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class DriveHeader:
    """Whose drive it is, how the sensor is mounted, where the map frame is anchored."""

    drive_id: str
    """Name of the recording. [1-64 of A-Z a-z 0-9 . _ -]"""
    vehicle: str
    """Pseudonym of the vehicle, the same letters."""
    sensor_model: str
    """Such as "VLP-16"."""
    anchor: LocalFrame
    """The frame `map` of the reference poses: ENU here."""
    T_vehicle_lidar: F64
    """(4, 4) mount: p_vehicle = T_vehicle_lidar @ p_lidar."""
    source: str = ""
    """Where the recording comes from, and its licence."""
    deskew: Deskew = "unsaid"
    """Whether the points' times are known; see `Deskew`."""
    sweep_ns: int = 0
    """How long a sweep lasts; 0 where the drive does not say."""
    mount: MountSource = "unsaid"
    """Where `T_vehicle_lidar` comes from; see `MountSource`."""
    mount_sigma: MountSigma | None = None
    """How far the mount is known, where it was estimated."""
    nowhere: bool = False
    """The place on the Earth is not known: `anchor` stands for no place, and no shared map may take the drive."""
    stand_ins: tuple[StandIn, ...] = ()
    """What was not measured but computed from the poses: errors against them say nothing about these."""

    def __post_init__(self) -> None:
        check_text("drive id", self.drive_id, VEHICLE_PATTERN)
        check_text("vehicle", self.vehicle, VEHICLE_PATTERN)
        check_text("sensor model", self.sensor_model, PRINTABLE_PATTERN)
        check_rigid("T_vehicle_lidar", self.T_vehicle_lidar)
        _check_known("deskew", self.deskew, get_args(Deskew))
        _check_known("mount", self.mount, get_args(MountSource))
        for stand_in in self.stand_ins:
            _check_known("stand-in", stand_in, get_args(StandIn))
        check_unsigned("sweep time", self.sweep_ns, bits=_TIME_BITS)
        if (self.mount_sigma is not None) != (self.mount == "estimated"):
            raise BadValue(f"mount {self.mount!r} with sigma {self.mount_sigma}: an estimated mount has one, no other")
        if self.mount_sigma is not None and not all(sigma >= 0 for sigma in self.mount_sigma):
            raise BadValue(f"sigma of the mount {self.mount_sigma}: all at least 0 are needed")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, DriveHeader) and self._scalars == other._scalars and self._same_mount(other)

    __hash__ = None  # type: ignore[assignment]

    @property
    def _scalars(self) -> tuple[object, ...]:
        told = self.drive_id, self.vehicle, self.sensor_model, self.anchor, self.source
        return (*told, self.deskew, self.sweep_ns, self.mount, self.mount_sigma, self.nowhere, self.stand_ins)

    def check_placed(self) -> None:
        """`NoPlace` where the drive does not tell where on the Earth it was recorded."""
        if self.nowhere:
            raise NoPlace(
                f"drive {self.drive_id} was imported with --nowhere: its place on the Earth is not known, so no shared"
                " map may take it; import it again with --anchor LAT,LON,HEIGHT or with --poses that tell the place"
            )

    def _same_mount(self, other: "DriveHeader") -> bool:
        return np.array_equal(self.T_vehicle_lidar, other.T_vehicle_lidar)


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One sweep of the LiDAR, in firing order, as measured: not deskewed."""

    t_ns: int
    """Start of the sweep."""
    points_m: F32
    """(N, 3) in the frame `lidar`, C-contiguous."""
    t_offset_ns: U32
    """(N,) time of each point after `t_ns`."""
    ring: U16 | None = None
    """(N,) laser of each point, where the recording tells."""

    def __post_init__(self) -> None:
        check_unsigned("scan time", self.t_ns, bits=_TIME_BITS)
        with refusing(f"scan at {self.t_ns} ns"):
            check_array("points_m", self.points_m, np.float32, (None, 3))
            check_array("t_offset_ns", self.t_offset_ns, np.uint32, (len(self.points_m),))
            if self.ring is not None:
                check_array("ring", self.ring, np.uint16, (len(self.points_m),))
        check_length(f"scan at {self.t_ns} ns", len(self.points_m), limits.MAX_POINTS_OF_SCAN, "points")

    def __len__(self) -> int:
        return len(self.points_m)


@dataclass(frozen=True, slots=True)
class MotionSample:
    """Wheel speed and yaw rate."""

    t_ns: int
    speed_mps: float
    """Along the vehicle's x axis, forward positive."""
    yaw_rate_radps: float
    """About the vehicle's z axis, counter-clockwise positive."""

    def __post_init__(self) -> None:
        check_unsigned("motion time", self.t_ns, bits=_TIME_BITS)
        if not (math.isfinite(self.speed_mps) and math.isfinite(self.yaw_rate_radps)):
            raise BadValue(f"motion at {self.t_ns} ns: {self.speed_mps} m/s, {self.yaw_rate_radps} rad/s")


@dataclass(frozen=True, slots=True)
class GnssFix:
    """A position from satellites."""

    t_ns: int
    lat_rad: float
    lon_rad: float
    height_m: float
    """Above the ellipsoid."""
    sigma_m: float
    """Standard deviation along each axis."""

    def __post_init__(self) -> None:
        check_unsigned("GNSS time", self.t_ns, bits=_TIME_BITS)
        with refusing(f"GNSS fix at {self.t_ns} ns"):
            check_geodetic(self.lat_rad, self.lon_rad)
        if not (math.isfinite(self.height_m) and 0 <= self.sigma_m < math.inf):
            raise BadValue(f"GNSS fix at {self.t_ns} ns: height {self.height_m} m, sigma {self.sigma_m} m")


@dataclass(frozen=True, slots=True, eq=False)
class ReferencePose:
    """Where the vehicle truly was: ground truth, or the best known."""

    t_ns: int
    T_map_vehicle: F64
    """(4, 4) pose of the vehicle in the map frame, ENU at the header's anchor."""

    def __post_init__(self) -> None:
        check_unsigned("reference time", self.t_ns, bits=_TIME_BITS)
        check_rigid(f"reference pose at {self.t_ns} ns", self.T_map_vehicle)


DriveItem = Scan | MotionSample | GnssFix | ReferencePose | Detections | LaneLook


class MotionTrack(NamedTuple):
    """All motion samples of a drive as arrays (N,)."""

    t_ns: I64
    speed_mps: F64
    yaw_rate_radps: F64


class GnssTrack(NamedTuple):
    """All GNSS fixes of a drive as arrays (N,)."""

    t_ns: I64
    lat_rad: F64
    lon_rad: F64
    height_m: F64
    sigma_m: F64


class ReferenceTrack(NamedTuple):
    """All reference poses of a drive."""

    t_ns: I64
    """(N,)"""
    T_map_vehicle: F64
    """(N, 4, 4)"""


class DriveTrack(NamedTuple):
    """Everything in a drive but the scans."""

    motion: MotionTrack
    gnss: GnssTrack
    reference: ReferenceTrack


_ItemT = TypeVar("_ItemT", MotionSample, GnssFix, ReferencePose)


def track_of(items: Iterable[DriveItem]) -> DriveTrack:
    """Everything among `items` but the scans, as arrays in the given order."""
    kept = list(items)
    return DriveTrack(_motion_track(kept), _gnss_track(kept), _reference_track(kept))


def _motion_track(items: list[DriveItem]) -> MotionTrack:
    found = _of_kind(items, MotionSample)
    return MotionTrack(
        np.array([m.t_ns for m in found], np.int64),
        np.array([m.speed_mps for m in found], np.float64),
        np.array([m.yaw_rate_radps for m in found], np.float64),
    )


def _gnss_track(items: list[DriveItem]) -> GnssTrack:
    found = _of_kind(items, GnssFix)
    return GnssTrack(
        np.array([g.t_ns for g in found], np.int64),
        *(np.array(column, np.float64).reshape(len(found)) for column in _gnss_columns(found)),
    )


def _gnss_columns(found: list[GnssFix]) -> Iterator[list[float]]:
    yield [g.lat_rad for g in found]
    yield [g.lon_rad for g in found]
    yield [g.height_m for g in found]
    yield [g.sigma_m for g in found]


def _reference_track(items: list[DriveItem]) -> ReferenceTrack:
    found = _of_kind(items, ReferencePose)
    poses = np.stack([r.T_map_vehicle for r in found]) if found else np.empty((0, 4, 4))
    return ReferenceTrack(np.array([r.t_ns for r in found], np.int64), poses)


def _of_kind(items: list[DriveItem], kind: type[_ItemT]) -> list[_ItemT]:
    return [item for item in items if isinstance(item, kind)]
