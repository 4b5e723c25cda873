"""A camera's lane detector on a simulated street: points on the paint ahead, with errors as real ones have them.

A part of the error stays for the whole drive (its mount), a part for each border of each look, a part is each point's
own. Borders are missed the more the farther they are, and their type and colour are confused at times.
"""

from dataclasses import dataclass
from math import radians
from typing import Final

import numpy as np

from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.markings import FloatArray, Paint
from gnd.fleet_sim.world import State
from gnd.gnd_map.se3 import T_inverse

_STREAM: Final = 1609


@dataclass(frozen=True, slots=True)
class LaneCamera:
    """A camera and its detector of borders.

    Attributes:
        mount_m, mount_deg: standard deviation of what stays with a drive: to the left, and turned.
        look_m, look_deg: of what stays with a border in one look.
        point_m: of each point.
        miss_near, miss_far: share of borders missed at the vehicle and at the end of the view; it grows with range.
        confused: share of borders whose type is taken for the other; a quarter of it takes the colour for the other.
        ahead_m: nearest and farthest point.
        rate_hz: looks a second.
    """

    mount_m: float = 0.08
    mount_deg: float = 0.2
    look_m: float = 0.05
    look_deg: float = 0.3
    point_m: float = 0.02
    miss_near: float = 0.1
    miss_far: float = 0.5
    confused: float = 0.1
    ahead_m: tuple[float, float] = (4.0, 20.0)
    rate_hz: int = 5

    def __post_init__(self) -> None:
        if not (0.0 <= self.miss_near <= self.miss_far < 1.0 and 0.0 <= self.confused < 1.0 and self.rate_hz >= 1):
            raise DriveSimError(f"impossible camera: {self}")


@dataclass(frozen=True, slots=True, eq=False)
class SeenBorders:
    """One look: points (N, 2) in the vehicle frame, the border of each (N,), of each border its type and colour."""

    t_s: float
    xy_m: FloatArray
    line: np.ndarray[tuple[int], np.dtype[np.int64]]
    markings: tuple[str, ...]
    colours: tuple[str, ...]


def border_looks(
    camera: LaneCamera, paint: Paint, state: State, t_s: FloatArray, T_map_vehicle: FloatArray, seed: int
) -> list[SeenBorders]:
    """What the camera sees on a drive.

    Args:
        camera: see there.
        paint: of the street.
        state: which of its states.
        t_s: (L,) times of the looks.
        T_map_vehicle: (L, 4, 4) true poses.
        seed: of the drive.
    """
    rng = np.random.default_rng([seed, paint.world.seed, _STREAM])
    off_m, turn = camera.mount_m * rng.standard_normal(), radians(camera.mount_deg) * rng.standard_normal()
    lines = [(one, paint.line_map_m(one, 1.0)) for one in paint.borders(state)]
    looks = []
    for t, T in zip(t_s.tolist(), T_inverse(T_map_vehicle), strict=True):
        rows = [_seen(camera, line @ T[:3, :3].T + T[:3, 3], off_m, turn, rng) for _, line in lines]
        some = [(one, xy) for (one, _), xy in zip(lines, rows, strict=True) if len(xy) >= 2]
        kinds = [_told(camera, one.marking, one.colour, rng) for one, _ in some]
        xy = np.concatenate([np.zeros((0, 2)), *(xy for _, xy in some)])
        line = np.repeat(np.arange(len(some)), [len(xy) for _, xy in some])
        looks.append(SeenBorders(t, xy, line, tuple(a for a, _ in kinds), tuple(b for _, b in kinds)))
    return looks


def _seen(camera: LaneCamera, line_m: FloatArray, off_m: float, turn: float, rng: np.random.Generator) -> FloatArray:
    """(N, 2) the points of a border that a look gives, none where it misses it."""
    near, far = camera.ahead_m
    inside = (line_m[:, 0] > near) & (line_m[:, 0] < far) & (np.abs(line_m[:, 1]) < 8.0)
    draws = rng.standard_normal(2), rng.random(len(line_m)), rng.random(), rng.standard_normal(len(line_m))
    share = (line_m[:, 0] - near) / (far - near)
    reach = draws[1].min(initial=1.0)  # one draw a border: detectors lose the far end of a border, not single points
    kept = inside & (draws[2] > camera.miss_near) & (share < np.maximum(1.0 - camera.miss_far * reach * 2.0, 0.3))
    x, y = line_m[kept, 0], line_m[kept, 1]
    look_m, look_deg = draws[0] * (camera.look_m, camera.look_deg)
    y = y + off_m + look_m + x * (turn + radians(look_deg)) + camera.point_m * draws[3][kept]
    return np.column_stack([x, y])


def _told(camera: LaneCamera, marking: str, colour: str, rng: np.random.Generator) -> tuple[str, str]:
    wrong, stained = rng.random(2)
    if wrong < camera.confused:
        marking = "dashed" if marking == "solid" else "solid"
    if stained < 0.25 * camera.confused:
        colour = "white" if colour == "yellow" else "yellow"
    return marking, colour
