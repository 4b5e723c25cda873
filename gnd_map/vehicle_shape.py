"""Which new Gaussians of a tile have the shape of a standing vehicle.

A parked car is no change of the map, whoever saw it and however many did within the hour. Its shape says so before time
does: it stands on the ground that the map knows, is between a low bonnet and the roof of a van high, wider than a wall
and not longer than a row of cars of its height. Only Gaussians are used, so a vehicle and the cloud judge alike, and
nothing is sent for it.
"""

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.beside import groups_of
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.jit import kernel

Mask = NDArray[np.bool_]
Shape = Literal["none", "side", "vehicle"]

GROUND_REACH_M: Final = 2.5
GROUND_BELOW_M: Final = 3.5
FLAT_SIGMA_M: Final = 0.12
"""A Gaussian no thicker than this from bottom to top is a piece of ground, where it lies below what stands."""
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
WIDTH_M: Final = (1.3, 4.5)
LENGTH_M: Final = (2.5, 9.0)
SHORT_M: Final = (3.4, 1.8)
"""What is shorter than this and higher than that is no part of a car: a van that is seen so high is seen longer."""
GAP_M: Final = 0.1
"""Cars that stand in a row have gaps between them."""
ROW_RUN_M: Final = (1.7, 11.0)
"""The longest stretch without a gap of a row that is longer than one car."""
MOST_CONTACT: Final = 0.5
"""What touches a higher thing with more of its voxels is a part of that."""
SIDE_M: Final = (0.55, 2.2)
"""Least width and length of what was seen of a car from one side."""
BELOW_GROUND_M: Final = -0.3
RAISED_M: Final = 0.05
"""The side of a car begins above the ground: below its sills the road is seen."""

BOUNDS: Final[dict[str, float]] = {
    "ground_reach_m": GROUND_REACH_M,
    "ground_below_m": GROUND_BELOW_M,
    "flat_sigma_m": FLAT_SIGMA_M,
    "edge_sigmas": EDGE_SIGMAS,
    "bottom_m": BOTTOM_M,
    "top_least_m": TOP_M[0],
    "top_most_m": TOP_M[1],
    "van_top_m": VAN_TOP_M,
    "several": SEVERAL,
    "least_height_m": LEAST_HEIGHT_M,
    "width_least_m": WIDTH_M[0],
    "width_most_m": WIDTH_M[1],
    "length_least_m": LENGTH_M[0],
    "length_most_m": LENGTH_M[1],
    "short_length_m": SHORT_M[0],
    "short_top_m": SHORT_M[1],
    "gap_m": GAP_M,
    "row_run_least_m": ROW_RUN_M[0],
    "row_run_most_m": ROW_RUN_M[1],
    "most_contact": MOST_CONTACT,
    "side_width_m": SIDE_M[0],
    "side_length_m": SIDE_M[1],
    "below_ground_m": BELOW_GROUND_M,
    "raised_m": RAISED_M,
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
    flat = _flat_places_m(grid, before)
    if not len(flat):
        return found
    place = _places_m(grid, new)
    ground = _ground_m(place, flat, GROUND_REACH_M, GROUND_BELOW_M)
    spread = EDGE_SIGMAS * np.sqrt(np.maximum(new.cov_m2[:, 5].astype(np.float64), 0.0))
    low, top = place[:, 2] - spread - ground, place[:, 2] + spread - ground
    index = np.stack(grid.unravel(new.voxel_id), axis=1)
    cov = new.cov_m2.astype(np.float64)
    for mine in groups_of(index, np.arange(len(new))):
        if _shape(low[mine], top[mine], place[mine, :2], cov[mine]) != "none":
            found[mine] = True
            continue
        is_low = _is_low_column(index[mine], top[mine])
        for part in groups_of(index, mine[is_low]):  # a car beside a higher thing
            is_one = _shape(low[part], top[part], place[part, :2], cov[part]) == "vehicle"
            found[part] = is_one and _touching(index[part], index[mine[~is_low]]) <= MOST_CONTACT * len(part)
    return found


def _is_low_column(index: I64, top: F64) -> Mask:
    """Which voxels lie in columns in which nothing reaches higher than the roof of a car."""
    _, column = np.unique(index[:, :2], axis=0, return_inverse=True)
    highest = np.full(int(column.max()) + 1, -np.inf)
    np.fmax.at(highest, column, top)
    return np.asarray(highest[column] <= TOP_M[1])


def _shape(low: F64, top: F64, at: F64, cov: F64) -> Shape:
    """The shape of a group: its lower and upper ends over the ground (K,), places (K, 2), covariances (K, 6)."""
    if np.isnan(low).mean() > 0.5:
        return "none"
    bottom, roof = float(np.nanmin(low)), float(np.nanmax(top))
    if not BELOW_GROUND_M < bottom < BOTTOM_M or roof < TOP_M[0]:
        return "none"
    width, length, run = _footprint_m(at, cov)
    if roof > TOP_M[1]:
        is_van = roof <= VAN_TOP_M and 1.5 <= width <= 2.9 and 3.5 <= length <= 7.5
        return "vehicle" if is_van else "none"
    if len(at) >= SEVERAL and roof - bottom < LEAST_HEIGHT_M:
        return "none"
    if length < SHORT_M[0] and roof > SHORT_M[1]:
        return "none"
    is_one = LENGTH_M[0] <= length <= LENGTH_M[1]
    is_row = length > LENGTH_M[1] and ROW_RUN_M[0] <= run <= ROW_RUN_M[1]
    if WIDTH_M[0] <= width <= WIDTH_M[1] and (is_one or is_row):
        return "vehicle"
    is_side = bottom > RAISED_M and SIDE_M[0] <= width <= WIDTH_M[1] and SIDE_M[1] <= length <= LENGTH_M[1]
    return "side" if is_side else "none"


def _footprint_m(at: F64, cov: F64) -> tuple[float, float, float]:
    """Width and length of the smallest upright box around a group, and the longest stretch of it without a gap."""
    angle = np.arange(32) * (np.pi / 32)
    along = np.stack([np.cos(angle), np.sin(angle)])
    middle = at @ along
    xx, xy, yy = (cov[:, k][:, None] for k in (0, 1, 3))
    u, v = along
    edge = EDGE_SIGMAS * np.sqrt(np.maximum(xx * u**2 + 2 * xy * u * v + yy * v**2, 0.0))
    side = (middle + edge).max(axis=0) - (middle - edge).min(axis=0)
    across = np.roll(side, -16)  # that of the direction 90 degrees on
    best = int(np.argmin(side * across))
    if side[best] < across[best]:
        best = (best + 16) % 32
    begin, end = middle[:, best] - edge[:, best], middle[:, best] + edge[:, best]
    order = np.argsort(begin)
    reached = np.maximum.accumulate(end[order])
    breaks = np.flatnonzero(begin[order][1:] > reached[:-1] + GAP_M)
    first = begin[order][np.append(0, breaks + 1)]
    last = reached[np.append(breaks, len(order) - 1)]
    return float(min(side[best], across[best])), float(side[best]), float((last - first).max())


def _places_m(grid: VoxelGrid, gaussians: Gaussians) -> F64:
    """(N, 3) means, east, north, up, against one corner of the tile at sea level."""
    ix, iy, floor = grid.unravel(gaussians.voxel_id)
    middle = np.stack([(ix + 0.5) * grid.dx_m, -(iy + 0.5) * grid.dy_m, (floor + 0.5) * grid.dz_m], axis=1)
    return np.asarray(middle + gaussians.mean_m)


def _flat_places_m(grid: VoxelGrid, gaussians: Gaussians) -> F64:
    return _places_m(grid, gaussians.take(np.flatnonzero(gaussians.cov_m2[:, 5] < FLAT_SIGMA_M**2)))


@kernel
def _ground_m(place: F64, flat: F64, reach_m: float, below_m: float) -> F64:
    """(N,) height of the ground under each place: the median of what is flat near and below; NaN where nothing is."""
    ground = np.full(len(place), np.nan)
    near = np.empty(len(flat))
    for k in range(len(place)):
        n = 0
        x, y, z = place[k]
        for j in range(len(flat)):
            if z - below_m < flat[j, 2] < z and (flat[j, 0] - x) ** 2 + (flat[j, 1] - y) ** 2 <= reach_m**2:
                near[n] = flat[j, 2]
                n += 1
        if n:
            ground[k] = np.median(near[:n])
    return ground


@kernel
def _touching(index: I64, others: I64) -> int:
    """How many voxels lie beside one of the others."""
    n = 0
    for i in range(len(index)):
        for j in range(len(others)):
            if (
                abs(index[i, 0] - others[j, 0]) <= 1
                and abs(index[i, 1] - others[j, 1]) <= 1
                and abs(index[i, 2] - others[j, 2]) <= 1
            ):
                n += 1
                break
    return n


def warm_up() -> None:
    """Compile or load the kernels."""
    index, place = np.zeros((1, 3), np.int64), np.zeros((1, 3))
    groups_of(index, np.zeros(1, np.int64))
    _ground_m(place, place, 1.0, 1.0)
    _touching(index, index)
