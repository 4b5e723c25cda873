"""What a drive gives to the mapping of a feature layer, in the plane of a map frame (ENU), as columns."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64, check_array
from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas.drive import Detections, DriveItem, LaneLook, MotionTrack, track_of
from gnd.vehicle_agent.errors import NewLayerError

EDGE_NS: Final = 100_000_000


class PolarLook(Protocol):
    """One look at features, N found: `gnd.schemas.drive.Detections`, or any other value with these columns."""

    @property
    def t_ns(self) -> int:
        """When."""

    @property
    def kinds(self) -> Sequence[str]:
        """N kinds."""

    @property
    def range_m(self) -> NDArray[Any]:
        """(N,) horizontal distance from the vehicle's origin."""

    @property
    def bearing_rad(self) -> NDArray[Any]:
        """(N,) counter-clockwise from the vehicle's x axis."""

    @property
    def sigma_range_m(self) -> NDArray[Any]:
        """(N,) standard deviation of the range."""

    @property
    def sigma_bearing_rad(self) -> NDArray[Any]:
        """(N,) standard deviation of the bearing."""


@dataclass(frozen=True, slots=True, eq=False)
class GnssFixes:
    """Positions by GNSS in the map frame."""

    t_ns: I64
    """(G,)"""
    xy_m: F64
    """(G, 2)"""

    def __post_init__(self) -> None:
        check_array("t_ns of fixes", self.t_ns, np.int64, (None,))
        check_array("xy_m of fixes", self.xy_m, np.float64, (len(self.t_ns), 2))


@dataclass(frozen=True, slots=True, eq=False)
class KnownPoses:
    """Poses that another localiser gives, such as the LiDAR's; each is taken as independent of the others."""

    t_ns: I64
    """(P,)"""
    pose: F64
    """(P, 3): x, y [m], yaw [rad] in the map frame."""
    cov: F64
    """(P, 3, 3) in the map frame."""

    def __post_init__(self) -> None:
        check_array("t_ns of poses", self.t_ns, np.int64, (None,))
        check_array("pose", self.pose, np.float64, (len(self.t_ns), 3))
        check_array("cov", self.cov, np.float64, (len(self.t_ns), 3, 3))


NO_FIXES = GnssFixes(np.empty(0, np.int64), np.empty((0, 2)))
NO_POSES = KnownPoses(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))


@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """All measurements of features of a drive, look after look; M in all, of L looks."""

    look: I64
    """(M,) number of the look, 0 … L - 1."""
    t_ns: I64
    """(M,)"""
    range_m: F64
    """(M,)"""
    bearing_rad: F64
    """(M,)"""
    sigma_range_m: F64
    """(M,)"""
    sigma_bearing_rad: F64
    """(M,)"""
    height_m: F64
    """(M,) above the vehicle's origin, nan = unknown."""
    kind: I64
    """(M,) row of `kinds`."""
    kinds: tuple[str, ...]

    @classmethod
    def of(cls, looks: Sequence[PolarLook]) -> "Measurements":
        """The columns of `looks`, which are in order of time."""
        counts = [len(look.kinds) for look in looks]
        names = tuple(sorted({kind for look in looks for kind in look.kinds}))
        code = {name: n for n, name in enumerate(names)}
        kinds = [code[kind] for look in looks for kind in look.kinds]
        return cls(
            np.repeat(np.arange(len(looks)), counts).astype(np.int64),
            np.repeat(np.array([look.t_ns for look in looks], np.int64), counts),
            _column(looks, "range_m"),
            _column(looks, "bearing_rad"),
            _column(looks, "sigma_range_m"),
            _column(looks, "sigma_bearing_rad"),
            _heights(looks),
            np.array(kinds, np.int64),
            names,
        )

    def __len__(self) -> int:
        return len(self.look)


def _column(looks: Sequence[PolarLook], name: str) -> F64:
    values = [np.asarray(getattr(look, name), np.float64) for look in looks]
    column = np.concatenate(values) if values else np.empty(0)
    check_array(name, column, np.float64, (sum(len(look.kinds) for look in looks),))
    return column


def _heights(looks: Sequence[PolarLook]) -> F64:
    unknown = [np.asarray(getattr(look, "height_m", np.full(len(look.kinds), np.nan)), np.float64) for look in looks]
    return np.concatenate(unknown) if unknown else np.empty(0)


@dataclass(frozen=True, slots=True, eq=False)
class FeatureDrive:
    """A drive as the mapping of a feature layer sees it; everything in order of time, the map frame in the plane.

    motion: wheel speed and yaw rate, at least two samples.
    fixes: positions by GNSS. poses: of another localiser. One of both must be there.
    looks: at features of the layer, those that found nothing too. lanes: looks at lane markings.
    """

    motion: MotionTrack
    fixes: GnssFixes = NO_FIXES
    looks: tuple[PolarLook, ...] = ()
    lanes: tuple[LaneLook, ...] = ()
    poses: KnownPoses = field(default=NO_POSES)

    def __post_init__(self) -> None:
        t_ns = self.motion.t_ns
        check_array("motion.t_ns", t_ns, np.int64, (None,))
        check_array("motion.speed_mps", self.motion.speed_mps, np.float64, (len(t_ns),))
        check_array("motion.yaw_rate_radps", self.motion.yaw_rate_radps, np.float64, (len(t_ns),))
        if len(t_ns) < 2 or np.any(np.diff(t_ns) <= 0):
            raise NewLayerError(f"{len(t_ns)} motion samples, expected at least 2, each later than the one before")
        if len(self.fixes.t_ns) + len(self.poses.t_ns) == 0:
            raise NewLayerError("a drive without GNSS fixes and without poses cannot be placed in a map")
        for name, times in self._times():
            self._check_times(name, times)

    def within_motion(self) -> "FeatureDrive":
        """The same without fixes, poses and looks from before or after the motion: where they belong is not known.

        Raises:
            NewLayerError: no fix and no pose is left.
        """
        first, last = self.motion.t_ns[0] - EDGE_NS, self.motion.t_ns[-1] + EDGE_NS
        fix, pose = ((t >= first) & (t <= last) for t in (self.fixes.t_ns, self.poses.t_ns))
        return replace(
            self,
            fixes=GnssFixes(self.fixes.t_ns[fix], self.fixes.xy_m[fix]),
            poses=KnownPoses(self.poses.t_ns[pose], self.poses.pose[pose], self.poses.cov[pose]),
            looks=tuple(look for look in self.looks if first <= look.t_ns <= last),
            lanes=tuple(look for look in self.lanes if first <= look.t_ns <= last),
        )

    def _times(self) -> list[tuple[str, I64]]:
        looks = np.array([look.t_ns for look in self.looks], np.int64)
        lanes = np.array([look.t_ns for look in self.lanes], np.int64)
        return [("fixes", self.fixes.t_ns), ("poses", self.poses.t_ns), ("looks", looks), ("lane looks", lanes)]

    def _check_times(self, name: str, t_ns: I64) -> None:
        if np.any(np.diff(t_ns) < 0):
            raise NewLayerError(f"{name} are not in order of time: row {int(np.argmin(np.diff(t_ns))) + 1} is earlier")

    @classmethod
    def of_items(
        cls, items: Iterable[DriveItem], frame: LocalFrame, layer: str, sensor: str | None = None
    ) -> "FeatureDrive":
        """A recorded drive in the plane of `frame`.

        Args:
            items: of the recording, in order of time.
            frame: the map frame.
            layer: whose looks are taken, such as "streetlights".
            sensor: take only its looks, "camera" or "lidar"; None = of both.
        """
        kept = list(items)
        track = track_of(kept)
        g = track.gnss
        xy_m = np.asarray(frame.enu_from_geodetic(g.lat_rad, g.lon_rad, g.height_m))[:, :2]
        return cls(
            track.motion,
            GnssFixes(g.t_ns, np.ascontiguousarray(xy_m)),
            tuple(i for i in kept if isinstance(i, Detections) and i.layer == layer and sensor in (None, i.sensor)),
            tuple(i for i in kept if isinstance(i, LaneLook)),
        )
