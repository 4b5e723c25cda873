"""What a sensor on the road could see at its looks: fields of view, and what other vehicles hide, exactly.

Shapes: L looks, N features, B boxes, A azimuths of an occluder profile.
"""

from dataclasses import dataclass
from math import pi, radians
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import RoadError
from gnd.fleet_sim.roads.curve import FloatArray
from gnd.fleet_sim.roads.route import Route
from gnd.fleet_sim.roads.traffic import NEAR_M, Boxes
from gnd.schemas.drive import LookSensor

BoolArray = NDArray[np.bool_]

TALL_M: Final = 2.0
"""Only what is higher than this is in an occluder profile: a car hides no sign from a camera behind a windscreen."""


@dataclass(frozen=True, slots=True)
class CameraView:
    """Field of view of a sensor at the vehicle's origin, looking ahead.

    Attributes:
        sensor: "camera" or "lidar".
        width_rad: horizontal angle of view, all around from 2 pi on.
        range_m: reach.
        rate_hz: looks a second.
        eye_m: height over the road.
        step_rad: an occluder profile has an azimuth every so much.
    """

    sensor: LookSensor
    width_rad: float
    range_m: float
    rate_hz: int
    eye_m: float
    step_rad: float

    def __post_init__(self) -> None:
        numbers = (self.width_rad, self.range_m, self.rate_hz, self.eye_m, self.step_rad)
        if min(numbers) <= 0 or self.width_rad > 2 * pi + 1e-9 or self.range_m > 100.0:
            raise RoadError(f"impossible field of view: {self}")

    def azimuths_rad(self) -> FloatArray:
        """Return the azimuths of an occluder profile from right to left, float64 (A,): middles of equal sectors."""
        count = round(self.width_rad / self.step_rad)
        return np.asarray((np.arange(count) + 0.5) * self.width_rad / count - self.width_rad / 2)

    def holds(self, range_m: FloatArray, bearing_rad: FloatArray) -> BoolArray:
        """Return which places lie in the field of view."""
        return np.asarray((range_m <= self.range_m) & (np.abs(bearing_rad) <= self.width_rad / 2 + 1e-12))


CAMERA: Final = CameraView("camera", radians(40.0), 80.0, 15, 1.3, radians(0.5))
"""Jo et al. 2018, section 6.1: 15 looks a second, 40° wide, 80 m far."""
LIDAR: Final = CameraView("lidar", 2 * pi, 50.0, 10, 1.9, radians(1.0))
"""A VLP-16 on the roof as in Kim et al. 2018, section 6.1: 10 looks a second, all around."""


def polar(poses: FloatArray, xy_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return range [m] and bearing [rad, -pi … pi], float64 (L, N), of places (N, 2) from poses (L, 3)."""
    step = xy_m[None, :, :] - poses[:, None, :2]
    angle = np.arctan2(step[..., 1], step[..., 0]) - poses[:, 2:3]
    return np.linalg.norm(step, axis=2), (angle + pi) % (2 * pi) - pi


@dataclass(frozen=True, slots=True, eq=False)
class PlacedBoxes:
    """Boxes where they are at one look after another: only those that are near.

    Attributes:
        look: int64 (P,), the look.
        box: int64 (P,), the box.
        xy_m, heading_rad: float64 (P, 2), (P,), its middle and direction in the route's frame.
        half_m: float64 (P, 2), half length and width.
        height_m: float64 (P,).
    """

    look: NDArray[np.int64]
    box: NDArray[np.int64]
    xy_m: FloatArray
    heading_rad: FloatArray
    half_m: FloatArray
    height_m: FloatArray


def placed_boxes(route: Route, boxes: Boxes, t_s: FloatArray, poses: FloatArray) -> PlacedBoxes:
    """Return the boxes within NEAR_M of poses (L, 3) at times (L,)."""
    way = boxes.way_m[None, :] + boxes.speed_mps[None, :] * t_s[:, None]
    left = np.array(route.lane_left_m)[boxes.lane]
    xy = route.line.offset(way, np.broadcast_to(left, way.shape))
    near = np.linalg.norm(xy - poses[:, None, :2], axis=2) < NEAR_M
    look, box = np.nonzero(near)
    _, heading = route.line.at(way[look, box])
    return PlacedBoxes(look, box, xy[look, box], heading, boxes.size_m[box, :2] / 2, boxes.size_m[box, 2])


def entry_share(
    start: FloatArray, end: FloatArray, middle: FloatArray, heading_rad: FloatArray, half_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return where segments enter and leave upright boxes in the plane, as shares of their length, float64 (...) each.

    Entry is inf where a segment misses its box. Points are (..., 2), headings (...), half sizes (..., 2).
    """
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    turn = np.stack([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)], axis=-2)
    origin = np.einsum("...ij,...j->...i", turn, start - middle)
    way = np.einsum("...ij,...j->...i", turn, end - start)
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (-half_m - origin) / way, (half_m - origin) / way
    enter = np.nanmax(np.minimum(first, second), axis=-1)
    leave = np.nanmin(np.maximum(first, second), axis=-1)
    hit = (enter <= leave) & (leave > 0.0) & (enter < 1.0)
    return np.where(hit, np.maximum(enter, 0.0), np.inf), np.where(hit, np.minimum(leave, 1.0), np.inf)


def hidden(
    poses: FloatArray, xy_m: FloatArray, height_m: FloatArray, in_view: BoolArray, placed: PlacedBoxes, eye_m: float
) -> BoolArray:
    """Return which features in view, bool (L, N), a box hides: the line of sight runs through it below its top."""
    found = np.zeros(in_view.shape, dtype=np.bool_)
    candidates = in_view[placed.look]
    pair, feature = np.nonzero(candidates)
    look = placed.look[pair]
    enter, leave = entry_share(
        poses[look, :2], xy_m[feature], placed.xy_m[pair], placed.heading_rad[pair], placed.half_m[pair]
    )
    met = np.isfinite(enter)
    pair, feature, look, enter, leave = pair[met], feature[met], look[met], enter[met], leave[met]
    rise = height_m[feature] - eye_m
    lowest = eye_m + rise * np.where(rise >= 0.0, enter, leave)
    blocked = lowest < placed.height_m[pair]
    found[look[blocked], feature[blocked]] = True
    return found


def occluder_ranges(view: CameraView, poses: FloatArray, placed: PlacedBoxes) -> NDArray[np.float32]:
    """Return the distance of the nearest tall box at each azimuth of each look, float32 (L, A), inf where none is."""
    found = np.full((len(poses), len(view.azimuths_rad())), np.inf, dtype=np.float32)
    tall = np.flatnonzero(placed.height_m > TALL_M)
    look = placed.look[tall]
    angle = poses[look, 2][:, None] + view.azimuths_rad()
    start = np.broadcast_to(poses[look, None, :2], (*angle.shape, 2))
    end = start + view.range_m * np.stack([np.cos(angle), np.sin(angle)], axis=2)
    half = np.broadcast_to(placed.half_m[tall, None, :], start.shape)
    middle = np.broadcast_to(placed.xy_m[tall, None, :], start.shape)
    enter, _ = entry_share(start, end, middle, np.broadcast_to(placed.heading_rad[tall, None], angle.shape), half)
    np.minimum.at(found, look, (enter * view.range_m).astype(np.float32))
    return found
