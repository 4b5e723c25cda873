"""What a drive gives to the mapping of a feature layer, in the plane of a map frame (ENU), as columns."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, I64, check_array
from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas.drive import Detections, DriveItem, LaneLook, MotionTrack, track_of
from gnd.vehicle_agent.errors import NewLayerError

EDGE_NS: Final = 100_000_000


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
    def of(cls, looks: Sequence[Detections]) -> "Measurements":
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
            np.concatenate([np.empty(0), *(np.asarray(look.height_m, np.float64) for look in looks)]),
            np.array(kinds, np.int64),
            names,
        )

    def __len__(self) -> int:
        return len(self.look)


def _column(looks: Sequence[Detections], name: str) -> F64:
    values = [np.asarray(getattr(look, name), np.float64) for look in looks]
    column = np.concatenate(values) if values else np.empty(0)
    check_array(name, column, np.float64, (sum(len(look.kinds) for look in looks),))
    return column


@dataclass(frozen=True, slots=True, eq=False)
class FeatureDrive:
    """A drive as the mapping of a feature layer sees it; everything in order of time, the map frame in the plane.

    motion: wheel speed and yaw rate, at least two samples.
    fixes: positions by GNSS, at least one.
    looks: at features of the layer, those that found nothing too. lanes: looks at lane markings.
    """

    motion: MotionTrack
    fixes: GnssFixes
    looks: tuple[Detections, ...] = ()
    lanes: tuple[LaneLook, ...] = ()

    def __post_init__(self) -> None:
        t_ns = self.motion.t_ns
        check_array("motion.t_ns", t_ns, np.int64, (None,))
        check_array("motion.speed_mps", self.motion.speed_mps, np.float64, (len(t_ns),))
        check_array("motion.yaw_rate_radps", self.motion.yaw_rate_radps, np.float64, (len(t_ns),))
        if len(t_ns) < 2 or np.any(np.diff(t_ns) <= 0):
            raise NewLayerError(f"{len(t_ns)} motion samples, expected at least 2, each later than the one before")
        if len(self.fixes.t_ns) == 0:
            raise NewLayerError("a drive without GNSS fixes cannot be placed in a map")
        for name, times in self._times():
            self._check_times(name, times)

    def within_motion(self) -> "FeatureDrive":
        """The same without fixes and looks from before or after the motion: where they belong is not known.

        Raises:
            NewLayerError: no fix is left.
        """
        first, last = self.motion.t_ns[0] - EDGE_NS, self.motion.t_ns[-1] + EDGE_NS
        fix = (self.fixes.t_ns >= first) & (self.fixes.t_ns <= last)
        return replace(
            self,
            fixes=GnssFixes(self.fixes.t_ns[fix], self.fixes.xy_m[fix]),
            looks=tuple(look for look in self.looks if first <= look.t_ns <= last),
            lanes=tuple(look for look in self.lanes if first <= look.t_ns <= last),
        )

    def _times(self) -> list[tuple[str, I64]]:
        looks = np.array([look.t_ns for look in self.looks], np.int64)
        lanes = np.array([look.t_ns for look in self.lanes], np.int64)
        return [("fixes", self.fixes.t_ns), ("looks", looks), ("lane looks", lanes)]

    def _check_times(self, name: str, t_ns: I64) -> None:
        if np.any(np.diff(t_ns) < 0):
            raise NewLayerError(f"{name} are not in order of time: row {int(np.argmin(np.diff(t_ns))) + 1} is earlier")

    @classmethod
    def of_items(cls, items: Iterable[DriveItem], frame: LocalFrame, layer: str) -> "FeatureDrive":
        """A recorded drive in the plane of `frame`.

        Args:
            items: of the recording, in order of time.
            frame: the map frame.
            layer: whose looks are taken, such as "streetlights".
        """
        kept = list(items)
        track = track_of(kept)
        g = track.gnss
        xy_m = np.asarray(frame.enu_from_geodetic(g.lat_rad, g.lon_rad, g.height_m))[:, :2]
        return cls(
            track.motion,
            GnssFixes(g.t_ns, np.ascontiguousarray(xy_m)),
            tuple(i for i in kept if isinstance(i, Detections) and i.layer == layer),
            tuple(i for i in kept if isinstance(i, LaneLook)),
        )
