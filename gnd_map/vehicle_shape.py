"""Which new Gaussians of a tile have the shape of a standing vehicle.

A parked car is no change of the map, whoever saw it and however many did within the hour. Its shape says so before time
does: it stands on the ground that the map knows, is between a low bonnet and the roof of a van high, wider than a wall
and not longer than a row of cars of its height. Only Gaussians are used, so a vehicle and the cloud judge alike, and
nothing is sent for it.
"""

from functools import partial
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.beside import count_beside, groups_of
from gnd.gnd_map.by_content import ByContent
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.over_ground import FLAT_SIGMA_M, flat_places_m, ground_m, places_m
from gnd.gnd_map.over_ground import warm_up as warm_up_ground

Mask = NDArray[np.bool_]
Shape = Literal["none", "side", "vehicle"]

GROUND_REACH_M: Final = 2.5
GROUND_BELOW_M: Final = 3.5
EDGE_SIGMAS: Final = 1.7
"""A surface that fills a voxel evenly ends at √3 of its standard deviations."""
BOTTOM_M: Final = 1.2
"""What begins higher over the ground than a car's belt line does not stand on wheels."""
TOP_M: Final = (0.9, 2.3)
"""Roofs, over the ground; of what is as long and wide as a van up to `VAN_TOP_M`."""
SEVERAL: Final = 4
LEAST_HEIGHT_M: Final = 0.35
"""Several voxels that hold less than this from bottom to top are a plate."""
VAN_TOP_M: Final = 2.9
VAN_WIDTH_M: Final = (1.5, 2.7)
VAN_LENGTH_M: Final = (3.3, 7.5)
"""What is higher than a car and wider than this is a container."""
WIDTH_M: Final = (1.2, 2.9)
LENGTH_M: Final = (1.9, 6.3)
"""Of one car. What hides its other end may show only a part of it."""
ABREAST_M: Final = (3.3, 5.6)
"""So wide is a row of cars that stand side by side."""
ROW_M: Final = 40.0
"""No row of cars without gaps is longer; in one without gaps bonnets are lower than roofs, ..."""
BONNET_M: Final = (0.5, 1.15)
"""... so high over the ground, ..."""
LOW_AND_HIGH: Final = (0.15, 0.25)
"""... with such shares of all that is seen: no wall is so, nor a hedge."""
SHORT_M: Final = (3.4, 1.8)
"""What is shorter than this and higher than that is no part of a car: a van that is seen so high is seen longer."""
GAP_M: Final = 0.1
"""What is farther apart than this are two things, which are judged each by itself."""
MOST_CONTACT: Final = 0.5
"""What touches a higher thing with more of its voxels is a part of that."""
SIDE_M: Final = (1.0, 2.2)
"""Least width and length of what was seen of a car from one side."""
BELOW_GROUND_M: Final = -0.3
RAISED_M: Final = 0.05
"""The side of a car begins above the ground: below its sills the road is seen."""
PAVING_M: Final = 0.4
"""What is flat and lies no higher over the ground is paving: a car that stands on it is no part of it."""

BOUNDS: Final[dict[str, float]] = {
    "ground_reach_m": GROUND_REACH_M,
    "ground_below_m": GROUND_BELOW_M,
    "flat_sigma_m": FLAT_SIGMA_M,
    "edge_sigmas": EDGE_SIGMAS,
    "bottom_m": BOTTOM_M,
    "top_least_m": TOP_M[0],
    "top_most_m": TOP_M[1],
    "van_top_m": VAN_TOP_M,
    "van_width_least_m": VAN_WIDTH_M[0],
    "van_width_most_m": VAN_WIDTH_M[1],
    "van_length_least_m": VAN_LENGTH_M[0],
    "van_length_most_m": VAN_LENGTH_M[1],
    "several": SEVERAL,
    "least_height_m": LEAST_HEIGHT_M,
    "width_least_m": WIDTH_M[0],
    "width_most_m": WIDTH_M[1],
    "length_least_m": LENGTH_M[0],
    "length_most_m": LENGTH_M[1],
    "abreast_least_m": ABREAST_M[0],
    "abreast_most_m": ABREAST_M[1],
    "row_most_m": ROW_M,
    "bonnet_least_m": BONNET_M[0],
    "bonnet_most_m": BONNET_M[1],
    "least_low": LOW_AND_HIGH[0],
    "least_high": LOW_AND_HIGH[1],
    "short_length_m": SHORT_M[0],
    "short_top_m": SHORT_M[1],
    "gap_m": GAP_M,
    "most_contact": MOST_CONTACT,
    "side_width_m": SIDE_M[0],
    "side_length_m": SIDE_M[1],
    "below_ground_m": BELOW_GROUND_M,
    "raised_m": RAISED_M,
    "paving_m": PAVING_M,
}
"""By name: a map depends on all of them."""


def has_vehicle_shape(grid: VoxelGrid, before: Gaussians, new: Gaussians) -> Mask:
    """Which of some Gaussians are of a group that has the shape of a standing vehicle.

    Args:
        grid: the tile's.
        before: (M,) Gaussians of the map, among which is the ground.
        new: (N,) Gaussians of voxels that the map holds nothing in.

    Returns:
        (N,) mask. Where the map has no ground nobody knows how high a thing stands: False.
    """
    found = np.zeros(len(new), bool)
    if not len(new):
        return found
    flat = flat_places_m(grid, before)
    if not len(flat):
        return found
    place = places_m(grid, new)
    ground = ground_m(place, flat, GROUND_REACH_M, GROUND_BELOW_M)
    spread = EDGE_SIGMAS * np.sqrt(np.maximum(new.cov_m2[:, 5].astype(np.float64), 0.0))
    low, top = place[:, 2] - spread - ground, place[:, 2] + spread - ground
    index = np.stack(grid.unravel(new.voxel_id), axis=1)
    cov = new.cov_m2.astype(np.float64)
    is_paving = (new.cov_m2[:, 5] < FLAT_SIGMA_M**2) & (top < PAVING_M)

    for mine in groups_of(index, np.flatnonzero(~is_paving)):
        group = index[mine], low[mine], top[mine], place[mine, :2], cov[mine]
        found[mine] = _JUDGED.of(group, partial(_judged, *group))
    return found


_JUDGED: Final[ByContent[Mask]] = ByContent(8192)
"""Most groups of a tile are the same in its next merge."""


def _judged(index: I64, low: F64, top: F64, at: F64, cov: F64) -> Mask:
    """(K,) which voxels of a group have the shape of a vehicle; arguments as of `_shape`."""
    found = np.zeros(len(index), np.bool_)
    if _shape(index, low, top, at, cov) != "none":
        found[:] = True
        return found
    is_low = _column_tops(index, top) <= TOP_M[1]
    for part in groups_of(index, np.flatnonzero(is_low)):  # a car beside a higher thing
        is_free = np.sum(count_beside(index[part], index[~is_low]) > 0) <= MOST_CONTACT * len(part)
        found[part] = is_free and _shape(index[part], low[part], top[part], at[part], cov[part]) == "vehicle"
    return found


def _column_tops(index: I64, top: F64) -> F64:
    """(N,) how high anything reaches in the column of each voxel."""
    _, column = np.unique(index[:, :2], axis=0, return_inverse=True)
    highest = np.full(int(column.max()) + 1, -np.inf)
    np.fmax.at(highest, column, top)
    return np.asarray(highest[column])


def _shape(index: I64, low: F64, top: F64, at: F64, cov: F64) -> Shape:
    """The shape of a group.

    Args:
        index: (K, 3) column, row and floor.
        low: (K,) lower ends over the ground, m.
        top: (K,) upper ends.
        at: (K, 2) places, m.
        cov: (K, 6) covariances, m².
    """
    if np.isnan(low).mean() > 0.5:
        return "none"
    bottom, roof = float(np.nanmin(low)), float(np.nanmax(top))
    if not BELOW_GROUND_M < bottom < BOTTOM_M or roof < TOP_M[0]:
        return "none"
    whole = _size_m(*_footprint_m(at, cov))
    fits_one = whole[0] <= WIDTH_M[1] and whole[1] <= LENGTH_M[1]  # a car of which only some parts were seen
    width, length = np.array([whole] if fits_one else _piece_sizes_m(at, cov)).T
    if roof > TOP_M[1]:
        is_van = (roof <= VAN_TOP_M) & _within(width, VAN_WIDTH_M) & _within(length, VAN_LENGTH_M)
        return "vehicle" if is_van.all() else "none"
    if len(at) >= SEVERAL and roof - bottom < LEAST_HEIGHT_M:
        return "none"
    if length.max() < SHORT_M[0] and roof > SHORT_M[1]:
        return "none"
    is_one = (width <= WIDTH_M[1]) & (length <= LENGTH_M[1])
    is_row = (
        (_within(width, WIDTH_M) | _within(width, ABREAST_M)) & (length <= ROW_M) & _is_wavy(_column_tops(index, top))
    )
    if not (is_one | is_row).all():
        return "none"
    if ((width >= WIDTH_M[0]) & (length >= LENGTH_M[0])).any():
        return "vehicle"
    return "side" if bottom > RAISED_M and ((width >= SIDE_M[0]) & (length >= SIDE_M[1])).any() else "none"


def _is_wavy(top: F64) -> bool:
    """Whether a group is as high as bonnets in some places and as high as roofs in others; (K,) tops of its columns."""
    low = np.mean((BONNET_M[0] <= top) & (top < BONNET_M[1]))
    high = np.mean((BONNET_M[1] <= top) & (top <= TOP_M[1]))
    return bool(low >= LOW_AND_HIGH[0] and high >= LOW_AND_HIGH[1])


def _within(values: F64, bounds: tuple[float, float]) -> Mask:
    return np.asarray((bounds[0] <= values) & (values <= bounds[1]))


def _piece_sizes_m(at: F64, cov: F64) -> list[tuple[float, float]]:
    """Width and length of the smallest upright box around each piece of a group; between pieces there are gaps."""
    sizes, waiting = [], [np.arange(len(at))]
    while waiting:
        mine = waiting.pop()
        lower, upper = _footprint_m(at[mine], cov[mine])
        piece = np.zeros(len(mine), np.int64)
        for begin, end in zip(lower, upper, strict=True):
            order = np.argsort(begin)
            reached = np.maximum.accumulate(end[order])
            is_next = begin[order][1:] > reached[:-1] + GAP_M
            number = np.empty(len(mine), np.int64)
            number[order] = np.concatenate([[0], np.cumsum(is_next)])
            piece = piece * len(mine) + number
        parts = [mine[piece == one] for one in np.unique(piece)]
        if len(parts) > 1:
            waiting += parts
            continue
        sizes.append(_size_m(lower, upper))
    return sizes


def _size_m(lower: F64, upper: F64) -> tuple[float, float]:
    """Width and length of a box from where each of its Gaussians begins and ends along its sides, (2, K)."""
    side = (upper.max(axis=1) - lower.min(axis=1)).tolist()
    return min(side), max(side)


def _footprint_m(at: F64, cov: F64) -> tuple[F64, F64]:
    """(2, K) where each Gaussian begins and ends along the two sides of the smallest upright box around all."""
    angle = np.arange(32) * (np.pi / 32)
    u, v = np.cos(angle), np.sin(angle)
    middle = at @ np.stack([u, v])
    xx, xy, yy = (cov[:, k][:, None] for k in (0, 1, 3))
    edge = EDGE_SIGMAS * np.sqrt(np.maximum(xx * u**2 + 2 * xy * u * v + yy * v**2, 0.0))
    lower, upper = middle - edge, middle + edge
    side = upper.max(axis=0) - lower.min(axis=0)
    best = int(np.argmin(side * np.roll(side, -16)))  # of the direction 90 degrees on
    both = [best, (best + 16) % 32]
    return lower[:, both].T, upper[:, both].T


def warm_up() -> None:
    """Compile or load the kernels."""
    index = np.zeros((1, 3), np.int64)
    groups_of(index, np.zeros(1, np.int64))
    warm_up_ground()
    count_beside(index, index)
