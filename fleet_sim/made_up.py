"""Made-up boxes beside the way of a recorded drive: a change to show with one recording alone.

Whoever has one recording of a street has nothing that changed. Boxes are put into its scans ray-accurately
(`gnd.fleet_sim.insert`), where the recording itself shows that the ground is bare: the drive is then that of a later
day, and which voxels the LiDAR measures on each box is exact truth.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import SimError
from gnd.fleet_sim.insert_drive import rewrite_drive
from gnd.fleet_sim.shapes import Block
from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.tile_id import TileId, covering_circle
from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import load_track, read_drive, read_header

F64 = NDArray[np.float64]
Voxels = dict[TileId, NDArray[np.int32]]

HALF_LENGTH_M, HALF_WIDTH_M, TALL_M = 0.9, 0.6, 2.0
SUNK_M: Final = 0.1
"""A box stands so deep in the ground: beams do not pass under it."""
NEAREST_M, FARTHEST_M = 2.8, 9.0
"""Between the middle of a box and the vehicle's way."""
APART_M: Final = 5.0
BORDER_M: Final = 10.0
"""Along the way: nearer to its ends a place is seen by too few scans."""
CELL_M: Final = 0.5
CLEAR_M: Final = 0.4
"""Around a box: as bare as the place itself."""
OVER_GROUND_M, UNEVEN_M = 0.35, 0.5
BARE_SHARE: Final = 0.05
"""Of the points of a cell that may lie over its ground: single ones do, and those of a vehicle that drove past."""
REACH_M: Final = 30.0
EVERY: Final = 2
"""Which scans are looked at for bare ground."""
TRIES: Final = 2000


@dataclass(frozen=True, slots=True)
class MadeUpBoxes:
    """Boxes on the Earth.

    Attributes:
        frame: ENU frame of the blocks.
        blocks: the boxes, upright in that frame.
    """

    frame: LocalFrame
    blocks: tuple[Block, ...]

    def in_frame(self, frame: LocalFrame) -> tuple[Block, ...]:
        """The boxes in another ENU frame, upright there."""
        T = frame.T_self_other(self.frame)
        turn_rad = float(np.arctan2(T[1, 0], T[0, 0]))
        centres = np.array([(b.x_m, b.y_m, b.bottom_m) for b in self.blocks]).reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
        return tuple(
            replace(
                b, x_m=float(x), y_m=float(y), bottom_m=float(z), top_m=float(z) + b.top_m - b.bottom_m,
                yaw_rad=b.yaw_rad + turn_rad,
            )
            for b, (x, y, z) in zip(self.blocks, centres, strict=True)
        )  # fmt: skip


def bare_places(drive: Path, n: int, seed: int = 0) -> MadeUpBoxes:
    """Up to n boxes beside the way of a drive, on bare and even ground that its scans have seen.

    Raises:
        DriveError: the drive cannot be read.
        SimError: it has no reference poses, or is too short.
    """
    header, reference = read_header(drive), load_track(drive)[2]
    way_m = np.r_[0.0, np.linalg.norm(np.diff(reference.T_map_vehicle[:, :3, 3], axis=0), axis=1).cumsum()]
    if len(reference.t_ns) < 2 or way_m[-1] <= 2 * BORDER_M:
        raise SimError(f"{drive}: {way_m[-1]:.0f} m with reference poses; made-up boxes need {2 * BORDER_M:.0f} m")
    ground = _Ground.seen(drive, Trajectory(reference.t_ns, reference.T_map_vehicle), header.T_vehicle_lidar)
    inner = reference.T_map_vehicle[(way_m > BORDER_M) & (way_m < way_m[-1] - BORDER_M)]
    rng, blocks = np.random.default_rng(seed), list[Block]()
    for _ in range(TRIES):
        if len(blocks) == n:
            break
        block = _candidate(inner[rng.integers(len(inner))], ground, reference.T_map_vehicle[:, :2, 3], rng)
        if block and all(np.hypot(block.x_m - b.x_m, block.y_m - b.y_m) >= APART_M for b in blocks):
            blocks.append(block)
    return MadeUpBoxes(header.anchor, tuple(blocks))


def _candidate(T_map_vehicle: F64, ground: "_Ground", way_m: F64, rng: np.random.Generator) -> Block | None:
    aside_m = rng.uniform(NEAREST_M, FARTHEST_M) * rng.choice([-1.0, 1.0])
    x, y = (T_map_vehicle @ np.array([0.0, aside_m, 0.0, 1.0]))[:2]
    if np.hypot(*(way_m - [x, y]).T).min() < NEAREST_M:
        return None
    yaw_rad = float(np.arctan2(T_map_vehicle[1, 0], T_map_vehicle[0, 0]))
    level_m = ground.level_of_bare(x, y, yaw_rad)
    if level_m is None:
        return None
    return Block(
        float(x), float(y), HALF_LENGTH_M, HALF_WIDTH_M, level_m - SUNK_M, level_m + TALL_M, yaw_rad
    )  # fmt: skip


class _Ground:
    """Cells of 0.5 m: how low the ground is there, and whether something stands on it."""

    def __init__(self, points_m: F64, level_m: F64) -> None:
        """Points (N, 3) in the map frame, and the height (N,) of the road of the pose that they were seen from."""
        low = np.abs(points_m[:, 2] - level_m) < TALL_M + 1.0
        points_m = points_m[low]
        cells = np.floor(points_m[:, :2] / CELL_M).astype(np.int64)
        self._first = cells.min(axis=0) if len(cells) else np.zeros(2, np.int64)
        shape = (cells - self._first).max(axis=0) + 1 if len(cells) else np.ones(2, np.int64)
        self._lowest_m = np.full(shape, np.inf)
        at = tuple((cells - self._first).T)
        np.minimum.at(self._lowest_m, at, points_m[:, 2])
        seen, over = np.zeros(shape), np.zeros(shape)
        np.add.at(seen, at, 1.0)
        np.add.at(over, at, points_m[:, 2] > self._lowest_m[at] + OVER_GROUND_M)
        self._is_bare = over <= BARE_SHARE * seen

    @classmethod
    def seen(cls, drive: Path, track: Trajectory, T_vehicle_lidar: F64) -> "_Ground":
        """What the scans of a drive show around its way."""
        points, levels = [np.empty((0, 3))], [np.empty(0)]
        scans = (item for item in read_drive(drive) if isinstance(item, Scan))
        for number, scan in enumerate(scans):
            last_ns = scan.t_ns + int(scan.t_offset_ns.max(initial=0))
            if number % EVERY or last_ns > track.t_ns[-1] or scan.t_ns < track.t_ns[0]:
                continue
            near = np.linalg.norm(scan.points_m, axis=1) < REACH_M
            offset_ns = scan.t_offset_ns[near]
            in_vehicle = deskew(scan.points_m[near], offset_ns, scan.t_ns, track, T_vehicle_lidar, scan.t_ns)
            T_map_vehicle = track.at(scan.t_ns)
            points.append(in_vehicle @ T_map_vehicle[:3, :3].T + T_map_vehicle[:3, 3])
            levels.append(np.full(len(in_vehicle), T_map_vehicle[2, 3]))
        return cls(np.concatenate(points), np.concatenate(levels))

    def level_of_bare(self, x_m: float, y_m: float, yaw_rad: float) -> float | None:
        """The height of the ground where a box may stand; None where it is not known, not even or not bare."""
        u, v = (np.arange(-half, half + CELL_M, CELL_M) for half in (HALF_LENGTH_M + CLEAR_M, HALF_WIDTH_M + CLEAR_M))
        along, across = (grid.ravel() for grid in np.meshgrid(u, v))
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        places_m = np.stack([x_m + c * along - s * across, y_m + s * along + c * across], axis=1)
        at = np.floor(places_m / CELL_M).astype(np.int64) - self._first
        if (at < 0).any() or (at >= self._lowest_m.shape).any():
            return None
        lowest_m = self._lowest_m[tuple(at.T)]
        if not np.isfinite(lowest_m).all() or np.ptp(lowest_m) > UNEVEN_M:
            return None
        return float(np.median(lowest_m)) if self._is_bare[tuple(at.T)].all() else None


def write_with_boxes(source: Path, target: Path, boxes: MadeUpBoxes) -> list[Voxels]:
    """Write a drive with the boxes in its scans.

    Returns:
        Of each box the voxels that the LiDAR measured on it as the map does (20 sub-cells), where the drive's
        reference poses put them.

    Raises:
        DriveError: the source is damaged, or the target cannot be written.
    """
    frame = read_header(source).anchor
    blocks = boxes.in_frame(frame)
    points_m = rewrite_drive(source, target, blocks).on_object_m
    return [_voxels_of(block, points_m, frame) for block in blocks]


def _voxels_of(block: Block, points_m: F64, frame: LocalFrame) -> Voxels:
    reach_m = float(np.hypot(block.half_x_m, block.half_y_m)) + CELL_M
    own = points_m[np.hypot(points_m[:, 0] - block.x_m, points_m[:, 1] - block.y_m) < reach_m]
    if not len(own):
        return {}
    lat_rad, lon_rad, _ = frame.geodetic_from_enu(own[:1])
    accumulator = VoxelAccumulator(GridFrame.around(frame, covering_circle(float(lat_rad[0]), float(lon_rad[0]), 20.0)))
    accumulator.add(own)
    return {tile: gaussians.voxel_id for tile, gaussians in accumulator.finish().items()}


def together(one: Sequence[Voxels], other: Sequence[Voxels]) -> list[Voxels]:
    """Box by box, the voxels that either of two drives has measured."""
    empty = np.empty(0, np.int32)
    return [
        {tile: np.union1d(a.get(tile, empty), b.get(tile, empty)).astype(np.int32) for tile in a | b}
        for a, b in zip(one, other, strict=True)
    ]
