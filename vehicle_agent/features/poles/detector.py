"""Poles, trunks, lamp posts and sign posts in LiDAR scans: geometry alone, nothing learned.

A pole is thin, upright, free on all sides, and stands on the ground. Each row of rays that meets it sees a *slice*:
some neighbouring returns at one range with farther ones, or none, on both sides. Slices one above the other make a
*column*; columns that are straight and long enough, seen by most of the layers between their ends, with nothing in the
ring around them, whose foot is on the ground or hidden, are poles. Only the front half is seen: the axis lies behind it
by π/4 of the radius on average, and the radius follows from the angle that a slice spans.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from gnd.schemas.drive import Detections
from gnd.schemas.limits import MAX_DETECTIONS_OF_LOOK
from gnd.vehicle_agent.features.poles.columns import POLE_GAP_M, POLE_LAYERS_APART, PoleColumns, columns_of, stacked
from gnd.vehicle_agent.features.poles.errors import PoleInputError
from gnd.vehicle_agent.features.poles.kinds import PoleSurroundings, bottoms, is_free, kinds_of, look_around, tops
from gnd.vehicle_agent.features.poles.place_kernels import rays_below
from gnd.vehicle_agent.features.poles.slices import (
    EXACT,
    POLE_DIAMETER_MAX_M,
    POLE_RANGE_MAX_M,
    GroundHeights,
    PoseSigma,
    SeenSlice,
    check_rays,
    ground_around,
    joined,
    slices_of,
)

_MIN_TOP_M: Final = 1.9
"""Height over the ground that it reaches."""
_LEAN_MAX: Final = 0.12
"""Horizontal metres a metre upwards."""
_SCATTER_MAX_M: Final = 0.08
"""Standard deviation of the slices about the axis, beside what the sensor's noise and its rays' distance make."""
_HIDDEN_SHARE_MAX: Final = 0.65
"""Share of its slices beside which something nearer stands: all of them are beside an edge, not on a thin thing."""
_SEEN_SHARE_MIN: Final = 0.4
"""Share of the sensor's layers between bottom and top that meet it."""
_FOOT_M: Final = 0.5
"""A pole begins no higher over the ground, but for the next lower layer, unless its foot is hidden."""
_BODY_DIAMETER_M: Final = 0.3
"""What is thicker than this …"""
_BODY_TOP_M: Final = 2.2
"""… and lower than this is somebody who stands there."""
_SIGMA_TILT_RAD: Final = 0.02
"""Of a vehicle that does not know how it and the road are tilted: of single looks in its own frame."""

Mask = NDArray[np.bool_]

LAYER = "poles"
RAY_HALF_M = 0.1
"""Rays that pass so near to an axis are counted for it."""


@dataclass(frozen=True, slots=True, eq=False)
class Pole:
    """A pole, in the frame of the points that it was found in.

    Attributes:
        xy_m: (2,) its axis at the mean height of its slices, middle_m over the ground.
        cov_m2: (2, 2) covariance of the axis, beside that of the vehicle's pose.
        diameter_m: of the thin part.
        sigma_diameter_m: its standard deviation.
        foot_z_m: height of the ground there.
        middle_m: mean height of its slices over the ground.
        bottom_m: lowest part that is seen, over the ground.
        top_m: highest part that is seen, over the ground.
        lean: (2,) metres a metre upwards.
        kind: "pole", "streetlight", "traffic_sign" or "trunk".
        points: of the thin part.
        scans: in which it was seen.
        hidden: share of its slices that something nearer stands beside.
    """

    xy_m: F64
    cov_m2: F64
    diameter_m: float
    sigma_diameter_m: float
    foot_z_m: float
    middle_m: float
    bottom_m: float
    top_m: float
    lean: F64
    kind: str
    points: int
    scans: int
    hidden: float


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """A scan: ends points_m (N, 3) and starts origins_m (N, 3) or (3,) of its rays, z up, sweep motion removed.

    sigma: how well its place is known against the other scans of a window.
    """

    points_m: F64
    origins_m: F64
    sigma: PoseSigma = EXACT


class PoleDetector:
    """Finds poles in single scans, or in some scans together; keeps nothing between calls."""

    def look(self, points_vehicle_m: F64, origins_vehicle_m: F64, t_ns: int = 0) -> Detections:
        """What one scan shows, as a look of the layer "poles".

        Args:
            points_vehicle_m: (N, 3) vehicle frame: x forward, y left, z up, origin on the road.
            origins_vehicle_m: (3,) place of the sensor, or (N, 3), as each ray began elsewhere.
            t_ns: time of the look.

        Raises:
            PoleInputError: other shapes.
        """
        return detections_of(self.poles(points_vehicle_m, origins_vehicle_m), np.eye(4), t_ns)

    def poles(self, points_vehicle_m: F64, origins_vehicle_m: F64) -> tuple[Pole, ...]:
        """As `look`, with all that is known of each pole; the nearest first.

        What is upright leans in the frame of a tilted vehicle: its foot lies off the axis by the unknown tilt times the
        height at which the axis is seen.
        """
        found = self.window([Rays(points_vehicle_m, origins_vehicle_m)], np.zeros(3))
        tilt = _SIGMA_TILT_RAD
        return tuple(replace(pole, cov_m2=pole.cov_m2 + (tilt * pole.middle_m) ** 2 * np.eye(2)) for pole in found)

    def window(self, scans: Sequence[Rays], place_m: F64) -> tuple[Pole, ...]:
        """Poles in some scans with known poses, all in one frame whose z points up.

        Args:
            scans: their rays, in that frame.
            place_m: (3,) the vehicle's origin there, on the road: poles within range of it are given.

        Returns:
            The poles, the nearest to the place first.

        Raises:
            PoleInputError: other shapes, or a place that is not finite.
        """
        place = np.asarray(place_m, np.float64)
        if place.shape != (3,) or not np.isfinite(place).all():
            raise PoleInputError(f"the vehicle's place must be 3 finite numbers, got {place_m!r}")
        rays = [check_rays(scan.points_m, scan.origins_m) for scan in scans]
        # Coordinates of a map frame may be large: sums of squares are taken about the vehicle.
        near = [(points - place, origins - place) for points, origins in rays]
        if not sum(len(points) for points, _ in near):
            return ()
        ground = ground_around(_together([points for points, _ in near]), np.zeros(3))
        sigmas = [scan.sigma for scan in scans]
        seen = [slices_of(*one, ground, k, sigma) for k, (one, sigma) in enumerate(zip(near, sigmas, strict=True))]
        layer_tan = float(np.median([one.layer_tan for one in seen]))
        slices, label = stacked(joined([one.slices for one in seen]), layer_tan)
        columns = columns_of(slices, label)
        return _judged(columns, seen, near, ground, layer_tan, place)


def detections_of(poles: Sequence[Pole], T_map_vehicle: F64, t_ns: int) -> Detections:
    """Poles as a look from a pose.

    Args:
        poles: in the frame "map"; of more than MAX_DETECTIONS_OF_LOOK the nearest are given.
        T_map_vehicle: (4, 4) the vehicle's pose there.
        t_ns: time of the look.
    """
    T = np.asarray(T_map_vehicle, np.float64)
    if not poles:
        none = np.empty(0, np.float32)
        return Detections(t_ns, "lidar", LAYER, (), none, none, none, none, none)
    off = np.array([[*pole.xy_m, pole.foot_z_m] for pole in poles]) - T[:3, 3]
    local = off @ T[:3, :3]
    distance = np.hypot(local[:, 0], local[:, 1])
    order = np.argsort(distance, kind="stable")[:MAX_DETECTIONS_OF_LOOK]
    cov = np.stack([T[:2, :2].T @ pole.cov_m2 @ T[:2, :2] for pole in poles])
    toward = local[:, :2] / np.maximum(distance, 1e-6)[:, None]
    aside = np.column_stack([-toward[:, 1], toward[:, 0]])
    along, across = (np.sqrt(np.einsum("ni,nij,nj->n", u, cov, u)) for u in (toward, aside))
    bearing = np.arctan2(local[:, 1], local[:, 0])
    columns = (distance, bearing, local[:, 2], along, across / np.maximum(distance, 1e-6))
    kinds = tuple(poles[k].kind for k in order)
    ordered = [column[order].astype(np.float32) for column in columns]
    return Detections(t_ns, "lidar", LAYER, kinds, ordered[0], ordered[1], ordered[2], ordered[3], ordered[4])


def _judged(
    columns: PoleColumns, seen: list[SeenSlice], rays: list[tuple[F64, F64]], ground: GroundHeights, layer_tan: float,
    place: F64,
) -> tuple[Pole, ...]:  # fmt: skip
    """The columns that are poles."""
    columns = _take(columns, np.flatnonzero(_straight(columns, layer_tan)))
    points, height = _together([one.points_m for one in seen]), np.concatenate([one.height_m for one in seen])
    near = look_around(columns, points, height, ground)
    gap = np.maximum(POLE_GAP_M, POLE_LAYERS_APART * layer_tan * columns.range_m)
    top, bottom, foot = tops(columns, near, gap), bottoms(columns, near, gap), ground.at(columns.xy_m)
    good = is_free(columns, near) & (top >= _MIN_TOP_M)
    good &= ~((columns.diameter_m > _BODY_DIAMETER_M) & (top < _BODY_TOP_M))
    good &= np.hypot(*columns.xy_m.T) <= POLE_RANGE_MAX_M
    good[good] = _stands(_take(columns, np.flatnonzero(good)), bottom[good], foot[good], gap[good], rays)
    kept = np.flatnonzero(good)
    kept = kept[np.argsort(np.hypot(*columns.xy_m[kept].T), kind="stable")]
    return _values(
        _take(columns, kept), PoleSurroundings._make(part[kept] for part in near), top[kept], foot[kept], place
    )


def _straight(columns: PoleColumns, layer_tan: float) -> Mask:
    """Whether columns (C,) are straight, upright, met by enough of the layers between their ends, and no edge."""
    expected = (columns.top_m - columns.bottom_m) / np.maximum(layer_tan * columns.range_m, 1e-3) + 1.0
    met = columns.slices / np.maximum(columns.scans, 1) >= _SEEN_SHARE_MIN * expected
    met &= (columns.diameter_m <= POLE_DIAMETER_MAX_M) & (columns.hidden <= _HIDDEN_SHARE_MAX)
    return np.asarray(met & (np.hypot(*columns.lean.T) <= _LEAN_MAX) & (columns.scatter_m <= _SCATTER_MAX_M))


def _stands(columns: PoleColumns, bottom_m: F64, foot_z: F64, gap_m: F64, rays: list[tuple[F64, F64]]) -> Mask:
    """Whether columns (C,) begin near the ground, or what is below them is hidden rather than free."""
    stands = bottom_m <= _FOOT_M + gap_m - POLE_GAP_M
    high = np.flatnonzero(~stands)
    places = np.column_stack([columns.xy_m, foot_z, foot_z + bottom_m])[high]
    below = np.sum([rays_below(points, origins, places, RAY_HALF_M) for points, origins in rays], axis=0)
    stands[high] = below[:, 0] > below[:, 1]
    return np.asarray(stands)


def _values(columns: PoleColumns, near: PoleSurroundings, top: F64, foot: F64, place: F64) -> tuple[Pole, ...]:
    kinds = kinds_of(columns, near, top)
    return tuple(
        Pole(
            columns.xy_m[k] + place[:2],
            columns.cov_m2[k],
            float(columns.diameter_m[k]),
            float(columns.sigma_diameter_m[k]),
            float(foot[k] + place[2]),
            float(columns.height_m[k]),
            float(columns.bottom_m[k]),
            float(top[k]),
            columns.lean[k],
            kinds[k],
            int(columns.points[k]),
            int(columns.scans[k]),
            float(columns.hidden[k]),
        )
        for k in range(len(kinds))
    )


def _take(columns: PoleColumns, index: I64) -> PoleColumns:
    return PoleColumns._make(column[index] for column in columns)


def _together(parts: list[F64]) -> F64:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)
