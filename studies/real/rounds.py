"""One round: the recording on the grid in one way, once untouched and once with objects in either half.

The objects lie in seeded places on free, even ground beside the track. The truth rests on points and rays alone,
never on what a method makes of them. An object's voxel is *new* where the vehicle's beams met the object in 20 sub-
cells and all untouched scans together hold less than five there; it is *deleted* where the mapping beams did so, and
*measured* as such where three beams of the vehicle cross the vanished surface. Voxels that an object touches in any
other way, and those of the map that its shadow changed, count for nothing.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.insert import Inserter
from gnd.fleet_sim.shapes import Block, Post, Shape
from gnd.gnd_map.accumulate import N_MIN_CELLS, VoxelAccumulator
from gnd.gnd_map.classes import ChangeClass
from gnd.schemas.drive import Scan
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.segment.parameters import SegmentParameters
from gnd.vehicle_agent.segment.segmenter import SegmentedScan
from studies.real.drive import DriveFindings, FoundVoxels, Poses, Tiles, detect, local_map_of, refined_scans, segmented
from studies.real.scene import Cells, RecordedScans, RecordedScene, in_range, place

F64 = NDArray[np.float64]
Object = Block | Post

KINDS = ("box", "post", "wall", "car")
CELL_M = 0.5
NEAREST_M, FARTHEST_M = 2.5, 14.0
"""From the track to the middle of an object."""
CLEAR_M = 0.3
"""Room around an object that must be free of points."""
UNEVEN_M = 0.25
MIN_KNOWN = 0.6
"""Share of the ground under an object that must have been measured."""
MAX_POINTS_INSIDE = 3
TRIES = 3000
_NEAR_M, _CUBE_M = 25.0, 0.2


@dataclass(frozen=True, slots=True)
class Placed:
    """An object with what it stands for."""

    kind: str
    shape: Object
    radius_m: float


@dataclass(frozen=True, slots=True, eq=False)
class CellSurroundings:
    """Points (N, 3) near the track, one in each cube of 20 cm, and the lowest point in cells of the ground plane."""

    points_m: F64
    low_m: F64
    corner_m: F64

    @classmethod
    def of(cls, scene: RecordedScene) -> "CellSurroundings":
        """From every third point of every scan."""
        parts = []
        for scan in scene.scans:
            refined = scene.refined(scan)
            range_m = np.linalg.norm(refined.points_map_m - refined.origins_map_m, axis=1)
            parts.append(_one_a_cube(refined.points_map_m[(range_m > 2.0) & (range_m < _NEAR_M)][::3]))
        points = _one_a_cube(np.concatenate(parts))
        corner = points[:, :2].min(axis=0)
        at = ((points[:, :2] - corner) / CELL_M).astype(np.int64)
        low = np.full(at.max(axis=0) + 1, np.inf)
        np.minimum.at(low, (at[:, 0], at[:, 1]), points[:, 2])
        return cls(points, low, corner)

    def lowest(self, xy_m: F64) -> F64:
        """(K,) lowest point of the cells at (K, 2), inf where nothing was measured."""
        at = np.floor((xy_m - self.corner_m) / CELL_M).astype(np.int64)
        inside = ((at >= 0) & (at < self.low_m.shape)).all(axis=1)
        found = np.full(len(at), np.inf)
        found[inside] = self.low_m[at[inside, 0], at[inside, 1]]
        return found


def _one_a_cube(points_m: F64) -> F64:
    """One point in each cube of `_CUBE_M`, the lowest."""
    if not len(points_m):
        return points_m
    low_first = points_m[np.argsort(points_m[:, 2], kind="stable")]
    at = np.floor((low_first - low_first.min(axis=0)) / _CUBE_M).astype(np.int64)
    shape = at.max(axis=0) + 1
    return low_first[np.unique(np.ravel_multi_index(tuple(at.T), tuple(shape)), return_index=True)[1]]


def choose_places(scene: RecordedScene, around: CellSurroundings, n: int, rng: np.random.Generator) -> list[Placed]:
    """Up to `n` objects of all kinds, none in another's place or in the vehicle's way."""
    found: list[Placed] = []
    for tried in range(TRIES):
        if len(found) == n:
            break
        one = _candidate(scene, around, KINDS[(len(found) + tried // 200) % len(KINDS)], rng)
        if one is not None and _apart(one, found) and _off_the_track(one, scene.positions_m):
            found.append(one)
    return found


def _candidate(scene: RecordedScene, around: CellSurroundings, kind: str, rng: np.random.Generator) -> Placed | None:
    T = scene.poses.T_dst_vehicle[rng.integers(len(scene.poses))]
    aside = rng.uniform(NEAREST_M, FARTHEST_M) * rng.choice([-1.0, 1.0])
    xy = (T @ np.array([rng.uniform(-6.0, 6.0), aside, 0.0, 1.0]))[:2]
    half_x, half_y, height = _size(kind, rng)
    yaw = rng.uniform(0.0, np.pi)
    ground = around.lowest(xy + _footprint(half_x + CLEAR_M, half_y + CLEAR_M, yaw))
    known = np.isfinite(ground)
    if known.mean() < MIN_KNOWN or np.ptp(ground[known]) > UNEVEN_M:
        return None
    bottom = float(np.median(ground[known]))
    if _points_inside(around.points_m, xy, half_x, half_y, yaw, bottom, height) > MAX_POINTS_INSIDE:
        return None
    x, y, low, high = float(xy[0]), float(xy[1]), bottom - 0.1, bottom + height
    shape = Post(x, y, half_x, low, high) if kind == "post" else Block(x, y, half_x, half_y, low, high, yaw)
    return Placed(kind, shape, float(np.hypot(half_x, half_y)))


def _size(kind: str, rng: np.random.Generator) -> tuple[float, float, float]:
    """Half length, half width and height over the ground."""
    low, high = {
        "box": ((0.4, 0.4, 0.8), (0.9, 0.8, 2.0)),
        "post": ((0.1, 0.1, 2.0), (0.3, 0.1, 3.5)),
        "wall": ((1.0, 0.1, 1.0), (2.5, 0.15, 2.4)),
        "car": ((1.9, 0.8, 1.4), (2.4, 0.95, 1.8)),
    }[kind]
    half_x, half_y, height = rng.uniform(low, high)
    return float(half_x), float(half_x if kind == "post" else half_y), float(height)


def _footprint(half_x: float, half_y: float, yaw: float) -> F64:
    """(K, 2) points spread over a rectangle about the origin."""
    u, v = (np.linspace(-half, half, max(2, int(2 * half / CELL_M) + 1)) for half in (half_x, half_y))
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(grid @ np.array([[c, s], [-s, c]]))


def _points_inside(
    points: F64, xy: NDArray[np.floating], half_x: float, half_y: float, yaw: float, bottom: float, height: float
) -> int:
    """Points in the room that an object takes, with some room around it, the ground left out."""
    near = points[np.abs(points[:, :2] - xy).max(axis=1) < half_x + half_y + 1.0]
    c, s = np.cos(yaw), np.sin(yaw)
    along = (near[:, :2] - xy) @ np.array([[c, -s], [s, c]])
    z = near[:, 2] - bottom
    inside = (np.abs(along[:, 0]) < half_x + CLEAR_M) & (np.abs(along[:, 1]) < half_y + CLEAR_M)
    return int((inside & (z > 0.3) & (z < height + CLEAR_M)).sum())


def _apart(one: Placed, others: Sequence[Placed]) -> bool:
    gaps = [
        np.hypot(one.shape.x_m - o.shape.x_m, one.shape.y_m - o.shape.y_m) - one.radius_m - o.radius_m for o in others
    ]
    return min(gaps, default=np.inf) > 1.5


def _off_the_track(one: Placed, positions_m: F64) -> bool:
    distance = np.linalg.norm(positions_m[:, :2] - [one.shape.x_m, one.shape.y_m], axis=1)
    return bool(distance.min() > one.radius_m + 1.3)


RANGE_SIGMA_M = 0.02
MEASURED_M = 50.0
"""Farther points on an object make no truth: detection does not use them."""
FREE_CELLS = 5
MIN_BEAMS = 3
I64 = NDArray[np.int64]


class Painter:
    """Puts objects into scans and remembers the points that then lie on them."""

    def __init__(self, scene: RecordedScene, shapes: Sequence[Shape], seed: int) -> None:
        self._scene, self._rng = scene, np.random.default_rng([91, seed])
        self._inserter = Inserter(shapes) if shapes else None
        self.on_objects = VoxelAccumulator(scene.grid_frame)

    def paint(self, scans: Iterable[Scan]) -> Iterator[Scan]:
        """The scans with the objects in them."""
        for scan in scans:
            yield self._painted(scan)

    def _painted(self, scan: Scan) -> Scan:
        if self._inserter is None:
            return scan
        T_map_lidar = self._scene.T_map_lidar(scan)
        inserted = self._inserter.insert(scan.points_m, T_map_lidar, self._rng, RANGE_SIGMA_M)
        moved = inserted.points_lidar_m[inserted.hit].astype(np.float64)
        T = T_map_lidar if T_map_lidar.ndim == 2 else T_map_lidar[inserted.hit]
        near = np.linalg.norm(moved, axis=1) <= MEASURED_M
        on_object_m = np.einsum("...ij,...j->...i", T[..., :3, :3], moved) + T[..., :3, 3]
        self.on_objects.add(on_object_m[near])
        return replace(scan, points_m=inserted.points_lidar_m)


@dataclass(frozen=True, slots=True, eq=False)
class RoundTruth:
    """Keys of voxels, each sorted.

    new, deleted: as the module says; measured: the deleted ones that the vehicle's beams crossed; ignored: neither.
    """

    new: I64
    deleted: I64
    measured: I64
    ignored: I64


def truth_of(static: Cells, new: Painter, deleted: Painter, crossed: Painter, shadowed: I64) -> RoundTruth:
    """The truth of one round.

    Args:
        static: all untouched scans of both halves.
        new: what the vehicle's beams met.
        deleted: what the mapping beams met.
        crossed: what the vehicle's beams would have met of the vanished objects.
        shadowed: keys of the map's voxels that an object in front of them changed.
    """
    on_new, on_gone, beams = Cells.of(new.on_objects), Cells.of(deleted.on_objects), Cells.of(crossed.on_objects)
    pure_new, gone = _free(on_new.dense(N_MIN_CELLS), static), _free(on_gone.dense(N_MIN_CELLS), static)
    touched = np.unique(np.concatenate([on_new.keys, on_gone.keys, beams.keys, shadowed]))
    measured = gone[beams.count_at(gone) >= MIN_BEAMS]
    return RoundTruth(pure_new, gone, measured, np.setdiff1d(touched, np.concatenate([pure_new, gone])))


def _free(keys: I64, static: Cells) -> I64:
    return keys[static.cells_at(keys) < FREE_CELLS]


def changed_by_shadow(before: Cells, after: Cells) -> I64:
    """Keys of the map's voxels whose points an inserted object has changed."""
    keys: I64 = np.union1d(before.keys, after.keys)
    return np.asarray(keys[before.count_at(keys) != after.count_at(keys)])


@dataclass(frozen=True, slots=True, eq=False)
class Method:
    """How the vehicle works: detection, segmentation of its own scans and of the map's, where poses come from."""

    detect: DetectParameters
    segment: SegmentParameters
    segment_map: bool
    poses: Poses


@dataclass(frozen=True, slots=True, eq=False)
class Untouched:
    """The two halves as they are: nothing changed but what moved by itself."""

    found: FoundVoxels
    tiles: Tiles
    mapping: FoundVoxels
    """What the map's half itself would say of these voxels."""
    seen: I64
    """Keys of the voxels that the map's half had looked at, see `looked_at`: of the others the map cannot know."""
    mapped: Cells
    driven: Cells
    moving: Cells
    """Points of the driven half that were marked as moving."""
    driven_from_m: F64
    """(S, 3) where the LiDAR was in the driven scans."""


@dataclass(frozen=True, slots=True, eq=False)
class Inserted:
    """The same with objects: those of the map's half are gone, those of the vehicle's half are new."""

    found: FoundVoxels
    tiles: Tiles
    seen: I64
    truth: RoundTruth
    new: tuple[Placed, ...]
    gone: tuple[Placed, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Round:
    """All of one round."""

    scene: RecordedScene
    untouched: Untouched
    inserted: Inserted


def run_round(
    recorded: RecordedScans, halves: tuple[I64, I64], number: int, objects: int, seed: int, method: Method
) -> Round:
    """Run one round.

    Args:
        recorded: scans and track.
        halves: numbers of the scans that make the map, and of those that are driven.
        number: of the round: which way the recording lies on the grid, and which places are chosen.
        objects: how many to insert, half of them into either half.
        seed: of both.
        method: how the vehicle works.
    """
    scene = place(recorded, number, seed)
    mapping, driving = ([scene.scans[i] for i in half] for half in halves)
    untouched = _untouched(scene, mapping, driving, method)
    rng = np.random.default_rng([seed, number])
    placed = choose_places(scene, CellSurroundings.of(scene), objects, rng) if objects else []
    return Round(scene, untouched, _inserted(scene, mapping, driving, placed, untouched, method, number))


def map_of(scene: RecordedScene, scans: Iterable[Scan], method: Method) -> VoxelAccumulator:
    """The points of scans as they make a map: in range, those on movers left out."""
    accumulator = VoxelAccumulator(scene.grid_frame)
    parameters = method.segment if method.segment_map else SegmentParameters(enabled=False)
    for one in segmented(map(scene.refined, scans), parameters):
        accumulator.add(one.scan.points_map_m[in_range(one.scan) & ~one.moving])
    return accumulator


def _untouched(scene: RecordedScene, mapping: list[Scan], driving: list[Scan], method: Method) -> Untouched:
    points = map_of(scene, mapping, method)
    tiles = points.finish()
    local_map = local_map_of(scene, tiles)
    notes = _Notes(scene)
    scans = segmented(refined_scans(scene, local_map, driving, method.poses), method.segment)
    drive = detect(scene, local_map, notes.noted(scans), method.detect)
    again = _again(scene, drive, mapping, method)
    driven, moving = Cells.of(notes.driven), Cells.of(notes.moving)
    from_m = np.array([scene.poses.at(scan.t_ns)[:3] @ scene.T_vehicle_lidar[:, 3] for scan in driving])
    return Untouched(drive.found, tiles, again, looked_at(again), Cells.of(points), driven, moving, from_m)


def _again(scene: RecordedScene, drive: DriveFindings, mapping: Iterable[Scan], method: Method) -> FoundVoxels:
    """What the mapping scans say of the map with what the drive found new in it."""
    scans = segmented(map(scene.refined, mapping), method.segment)
    return detect(scene, local_map_of(scene, drive.grown), scans, method.detect).found


def looked_at(mapping: FoundVoxels) -> I64:
    """Keys of the voxels that the map's half had looked at, by its rays alone.

    One that holds a Gaussian, of the map or found new by the drive: as many rays of the map's half ended in it or
    passed through this very surface as a Gaussian needs sub-cells; with fewer the map cannot hold it. Rays that only
    crossed another part of the voxel do not tell whether there was something: over a road, most pass above the ground.
    One that holds none: the map's half, too, calls it empty.

    Args:
        mapping: what the mapping scans say of the map with the drive's new voxels in it.
    """
    met = mapping.in_map & (mapping.hits + mapping.passes >= N_MIN_CELLS)
    return np.sort(mapping.keys[met | mapping.where(ChangeClass.EMPTY)])


class _Notes:
    """What the driven half consists of, noted while it passes."""

    def __init__(self, scene: RecordedScene) -> None:
        self.driven, self.moving = VoxelAccumulator(scene.grid_frame), VoxelAccumulator(scene.grid_frame)

    def noted(self, scans: Iterable[SegmentedScan]) -> Iterator[SegmentedScan]:
        for one in scans:
            near, points = in_range(one.scan), one.scan.points_map_m
            self.driven.add(points[near])
            self.moving.add(points[near & one.moving])
            yield one


def _inserted(
    scene: RecordedScene,
    mapping: list[Scan],
    driving: list[Scan],
    placed: list[Placed],
    untouched: Untouched,
    method: Method,
    number: int,
) -> Inserted:
    new, gone = tuple(placed[::2]), tuple(placed[1::2])
    into_map = Painter(scene, [one.shape for one in gone], 2 * number)
    into_drive = Painter(scene, [one.shape for one in new], 2 * number + 1)
    crossed = Painter(scene, [one.shape for one in gone], 2 * number)
    points = map_of(scene, into_map.paint(mapping), method)
    tiles = points.finish()
    local_map = local_map_of(scene, tiles)
    scans = refined_scans(scene, local_map, into_drive.paint(driving), method.poses)
    drive = detect(scene, local_map, segmented(scans, method.segment), method.detect)
    again = _again(scene, drive, Painter(scene, [one.shape for one in gone], 2 * number).paint(mapping), method)
    for _ in crossed.paint(driving):
        pass
    static = Cells.of(scene.accumulated(map(scene.refined, [*mapping, *driving])))
    shadowed = changed_by_shadow(untouched.mapped, Cells.of(points))
    truth = truth_of(static, into_drive, into_map, crossed, shadowed)
    return Inserted(drive.found, tiles, looked_at(again), truth, new, gone)
