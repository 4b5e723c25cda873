"""Rows of real recordings: objects inserted ray-accurately beside surfaces that are there, so that voxels are modified.

The truth compares sub-cells, as that of the worlds does (`gnd.fleet_sim.truth`): what the beams met of an object, and
what all untouched scans together hold. A voxel is modified when a quarter of its sub-cells came or went farther than
one sub-cell from every surface of the other state. Everything that no object touches is as it was.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gnd.fleet_sim.shapes import Block, Shape
from gnd.fleet_sim.truth import LEVELS, TruthRules
from gnd.gnd_map.accumulate import CELLS_A_SIDE, VoxelAccumulator
from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.grid import GridFrame
from gnd.vehicle_agent.detect.classify import shape_candidates
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.detect.evidence import TileEvidence
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty
from gnd.vehicle_agent.importer import AUTO, no_progress, open_recording
from gnd.vehicle_agent.importers.detect_format import format_of
from gnd.vehicle_agent.importers.recording import NOMINAL
from studies.modified_study.rows import Mask, ShapeRows, joined, numbered
from studies.real.drive import local_map_of, segmented
from studies.real.rounds import CellSurroundings, Method, Painter, choose_places, map_of
from studies.real.scene import Cells, RecordedScans, RecordedScene, keys_of, load, place
from studies.real.study import RealOptions, Split

FREE = 8
"""Objects on free ground in a round, half of them in either half of the recording: the ground at their feet changes."""
BESIDE = 40
"""Objects beside something that is there."""
_GAP_M = (0.05, 0.45)
_SIZES_M = ((0.15, 0.15, 0.4), (0.8, 0.5, 1.8))
"""Half depth, half width and height of an object beside a surface, least and largest."""
_NEAREST_M, _FARTHEST_M = 3.0, 18.0
_MIN_ABOVE_M = 0.3
_MOST_INSIDE = 3
_TRIES = 2000
_CLEAR_OF_THE_TRACK_M = 1.5
_RULES = TruthRules()


@dataclass(frozen=True, slots=True)
class RecordingSpec:
    """Part of a recording, driven several times with other objects.

    Attributes:
        folder: of the recording, by its name.
        split: how it is divided into what makes the map and what is driven.
        rounds: ways to lay it on the grid.
        at_most: its first scans only.
    """

    folder: str
    split: Split
    rounds: int
    at_most: int = 60
    seed: int = 5

    @property
    def name(self) -> str:
        """Such as "radiate_fog, halves"."""
        return f"{self.folder}, {self.split}"


def rows_of_recording(spec: RecordingSpec, options: RealOptions) -> ShapeRows:
    """Return the rows of all rounds.

    Args:
        spec: what is done.
        options: where the recording lies, and how the vehicle works.

    Raises:
        RealDataError, ImportDriveError: the recording cannot be read or divided.
    """
    kind = format_of(options.scans) if options.kind == AUTO else options.kind
    recording = open_recording(kind, options.scans, NOMINAL if kind == "pcd" else None, options.topic)
    recorded = load(recording, spec.at_most, no_progress)
    halves = options.halves(len(recorded.scans))
    return joined(rows_of_round(recorded, halves, number, spec.seed, options.method()) for number in range(spec.rounds))


def rows_of_round(
    recorded: RecordedScans, halves: tuple[I64, I64], number: int, seed: int, method: Method
) -> ShapeRows:
    """Return the rows of one way on the grid.

    Args:
        recorded: scans and track.
        halves: numbers of the mapping and the driven scans.
        number: of the round.
        seed: of the places of objects.
        method: how the vehicle works.
    """
    scene = place(recorded, number, seed)
    mapping, driving = ([scene.scans[i] for i in half] for half in halves)
    around, rng = CellSurroundings.of(scene), np.random.default_rng([seed, number, 0xBE51])
    free = [one.shape for one in choose_places(scene, around, FREE, rng)]
    shapes = [*free, *places_beside(scene, around, BESIDE, rng)]
    into_map, into_drive = (Painter(scene, shapes[i::2], 2 * number + i) for i in range(2))
    tiles = map_of(scene, into_map.paint(mapping), method).finish()
    detector = ChangeDetector(local_map_of(scene, tiles), method.detect)
    for one in segmented(map(scene.refined, into_drive.paint(driving)), method.segment):
        pose = PoseUncertainty.of(one.scan.estimate)
        detector.add_scan(one.scan.points_map_m, one.scan.origins_map_m, one.moving, pose)
    evidence = detector.finish(detector.touched_tiles()).values()
    static = scene.accumulated(map(scene.refined, [*mapping, *driving]))
    truth = SubCellTruth.of(static, into_map.on_objects, into_drive.on_objects)
    return joined([_rows_of_tile(scene, truth, e) for e in evidence])


def places_beside(scene: RecordedScene, around: CellSurroundings, n: int, rng: np.random.Generator) -> list[Shape]:
    """Up to `n` boxes, each on the near side of something that stands there, with little room between."""
    points = around.points_m
    high = points[:, 2] - around.lowest(points[:, :2]) > _MIN_ABOVE_M
    chosen, found = np.flatnonzero(high), list[Shape]()
    track = cKDTree(scene.positions_m[:, :2])
    for _ in range(_TRIES if len(chosen) else 0):
        if len(found) == n:
            break
        one = _beside(points[rng.choice(chosen)], scene.positions_m, track, rng)
        if one is not None and _fits(one, points, track, found):
            found.append(one)
    return found


def _beside(at_m: F64, positions_m: F64, track: cKDTree, rng: np.random.Generator) -> Block | None:
    """A box between a point and the track; None where the track is too near or too far."""
    distance_m, nearest = track.query(at_m[:2])
    if not _NEAREST_M < distance_m < _FARTHEST_M:
        return None
    to_track = (positions_m[nearest, :2] - at_m[:2]) / distance_m
    half_x, half_y, height = rng.uniform(*_SIZES_M)
    x, y = (at_m[:2] + to_track * (half_x + rng.uniform(*_GAP_M))).tolist()
    low = float(at_m[2] - rng.uniform(0.0, height))
    yaw = float(np.arctan2(to_track[1], to_track[0]))
    return Block(x, y, float(half_x), float(half_y), low, low + float(height), yaw)


def _fits(one: Block, points: F64, track: cKDTree, others: Sequence[Shape]) -> bool:
    """Whether hardly anything stands in a box, and nothing else drives or stands there."""
    reach = float(np.hypot(one.half_x_m, one.half_y_m))
    if track.query([one.x_m, one.y_m])[0] < reach + _CLEAR_OF_THE_TRACK_M:
        return False
    if any(np.hypot(o.x_m - one.x_m, o.y_m - one.y_m) < 2.0 for o in others):
        return False
    c, s = np.cos(one.yaw_rad), np.sin(one.yaw_rad)
    along = (points[:, :2] - [one.x_m, one.y_m]) @ np.array([[c, -s], [s, c]])
    inside = (np.abs(along[:, 0]) < one.half_x_m) & (np.abs(along[:, 1]) < one.half_y_m)
    inside &= (points[:, 2] > one.bottom_m) & (points[:, 2] < one.top_m)
    return int(inside.sum()) <= _MOST_INSIDE


@dataclass(frozen=True, slots=True, eq=False)
class SubCellTruth:
    """What changed, sub-cell by sub-cell.

    Attributes:
        grid_frame: of the voxels.
        static: sub-cells that all untouched scans hold.
        keys: int64 (M,), increasing: the voxels that an object touches.
        share: float64 (M,), the larger share of sub-cells there that came or that went.
        before, after: int64 (M,), occupied sub-cells of both states.
    """

    grid_frame: GridFrame
    static: Cells
    keys: I64
    share: F64
    before: I64
    after: I64

    @classmethod
    def of(cls, static: VoxelAccumulator, gone: VoxelAccumulator, new: VoxelAccumulator) -> "SubCellTruth":
        """Compare what stands untouched with what the beams met of the objects of either state."""
        frame = static.grid_frame
        touched = np.unique(np.concatenate([keys_of(frame, a.occupied()[0]) for a in (gone, new)]))
        near = np.unique(np.concatenate([_around(frame, a) for a in (gone, new)]))
        stands, went, came = (sub_cells(a, near) for a in (static, gone, new))
        before, after = (np.unique(np.concatenate([stands, part]), axis=0) for part in (went, came))
        n_before, n_after = (_count(frame, cells, touched) for cells in (before, after))
        lost, won = (
            _count(frame, part[_far_from(part, other)], touched) for part, other in ((went, after), (came, before))
        )
        share = np.maximum(lost / np.maximum(n_before, 1), won / np.maximum(n_after, 1))
        return cls(frame, Cells.of(static), touched, share, n_before, n_after)

    def at(self, keys: I64) -> tuple[F64, I64, I64]:
        """(K,) share, and sub-cells before and after, of voxels by their keys."""
        cells = self.static.cells_at(keys)
        if not len(self.keys):
            return np.zeros(len(keys)), cells, cells
        row = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        met = self.keys[row] == keys
        share = np.where(met, self.share[row], 0.0)
        return share, np.where(met, self.before[row], cells), np.where(met, self.after[row], cells)


def _around(frame: GridFrame, accumulator: VoxelAccumulator) -> I64:
    """Keys of the voxels with points and of those beside them."""
    g = accumulator.occupied()[0].astype(np.int64)
    steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(np.unique(keys_of(frame, (g[:, None] + steps).reshape(-1, 3))))


def sub_cells(accumulator: VoxelAccumulator, near: I64) -> I64:
    """(K, 3) coordinates of the occupied sub-cells in the voxels of these keys, ten to a voxel's side."""
    g, bits = accumulator.occupied()
    chosen = np.isin(keys_of(accumulator.grid_frame, g), near)
    g, bits = g[chosen].astype(np.int64), np.ascontiguousarray(bits[chosen])
    flags = np.unpackbits(bits.view(np.uint8).reshape(len(g), 8 * bits.shape[1]), axis=1, bitorder="little")
    row, cell = np.nonzero(flags)
    z, rest = np.divmod(cell, CELLS_A_SIDE**2)
    y, x = np.divmod(rest, CELLS_A_SIDE)
    return np.asarray(g[row] * CELLS_A_SIDE + np.stack([x, y, z], axis=1))


def _far_from(cells: I64, others: I64) -> Mask:
    """(K,) which sub-cells have none of the others within one sub-cell."""
    if not len(others) or not len(cells):
        return np.ones(len(cells), np.bool_)
    return np.asarray(cKDTree(others).query(cells, p=np.inf)[0] > 1.0)


def _count(frame: GridFrame, cells: I64, keys: I64) -> I64:
    """(M,) how many of the sub-cells lie in each voxel."""
    found, count = np.unique(keys_of(frame, cells // CELLS_A_SIDE), return_counts=True)
    if not len(found):
        return np.zeros(len(keys), np.int64)
    at = np.minimum(np.searchsorted(found, keys), len(found) - 1)
    return np.where(found[at] == keys, count[at], 0)


def _rows_of_tile(scene: RecordedScene, truth: SubCellTruth, e: TileEvidence) -> ShapeRows:
    rows = shape_candidates(e, DetectParameters())
    keys = keys_of(scene.grid_frame, scene.grid_frame.grid_of_voxel(e.base.tile_id, e.voxel_id[rows]))
    share, before, after = truth.at(keys)
    held = (before >= _RULES.n_min_cells) & (after >= _RULES.n_min_cells)
    now = numbered([e.measured.take(rows)])
    low, high = _RULES.marginal_share
    hair = (share >= low) & (share < high)
    for cells in (before, after):
        hair |= (cells >= _RULES.marginal_cells[0]) & (cells < _RULES.marginal_cells[1])
    observable = now.cells >= _RULES.seen_cells
    return ShapeRows(
        was=numbered([e.base.gaussians.take(e.map_row[rows])]),
        now=now,
        rays=np.stack([e.n_bi, e.n_bo, e.n_pi, e.n_po], axis=1)[rows],
        modified=held & (share >= _RULES.modified_share),
        held=held,
        observable=observable,
        scored=observable & ~hair,
        missed=np.zeros(len(LEVELS), np.int64),
    )
