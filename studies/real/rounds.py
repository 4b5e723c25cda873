"""One round: the recording on the grid in one way, once untouched and once with objects in either half."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.schemas.drive import Scan
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.segment.parameters import SegmentParameters
from gnd.vehicle_agent.segment.segmenter import SegmentedScan
from studies.real.drive import Found, Poses, Tiles, detect, local_map_of, refined_scans, segmented
from studies.real.insertion import Painter, Truth, changed_by_shadow, truth_of
from studies.real.places import Placed, Surroundings, choose_places
from studies.real.scene import Recorded, Scene, in_range, place
from studies.real.voxels import Cells

I64 = NDArray[np.int64]
SAMPLED = 7


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

    found: Found
    tiles: Tiles
    seen: I64
    """Keys of the voxels that a ray of the map's half crossed or ended in: of the others the map cannot know."""
    mapped: Cells
    driven: Cells
    moving: Cells
    """Points of the driven half that were marked as moving."""
    sample_m: NDArray[np.float32]
    """(N, 3) every `SAMPLED`th point of the driven half, for pictures."""
    sample_moving: NDArray[np.bool_]
    """(N,) which of them were marked."""


@dataclass(frozen=True, slots=True, eq=False)
class Inserted:
    """The same with objects: those of the map's half are gone, those of the vehicle's half are new."""

    found: Found
    tiles: Tiles
    truth: Truth
    new: tuple[Placed, ...]
    gone: tuple[Placed, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Round:
    """All of one round."""

    scene: Scene
    untouched: Untouched
    inserted: Inserted


def run_round(
    recorded: Recorded, halves: tuple[I64, I64], number: int, objects: int, seed: int, method: Method
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
    placed = choose_places(scene, Surroundings.of(scene), objects, rng) if objects else []
    return Round(scene, untouched, _inserted(scene, mapping, driving, placed, untouched, method, number))


def _map_of(scene: Scene, scans: Iterable[Scan], method: Method) -> VoxelAccumulator:
    accumulator = VoxelAccumulator(scene.grid_frame)
    parameters = method.segment if method.segment_map else SegmentParameters(enabled=False)
    for one in segmented(map(scene.refined, scans), parameters):
        accumulator.add(one.scan.points_map_m[in_range(one.scan) & ~one.moving])
    return accumulator


def _untouched(scene: Scene, mapping: list[Scan], driving: list[Scan], method: Method) -> Untouched:
    points = _map_of(scene, mapping, method)
    tiles = points.finish()
    local_map = local_map_of(scene, tiles)
    notes = _Notes(scene)
    scans = segmented(refined_scans(scene, local_map, driving, method.poses), method.segment)
    found = detect(scene, local_map, notes.noted(scans), method.detect)
    seen = detect(scene, local_map, segmented(map(scene.refined, mapping), method.segment), method.detect).keys
    driven, moving = Cells.of(notes.driven), Cells.of(notes.moving)
    return Untouched(found, tiles, seen, Cells.of(points), driven, moving, *notes.sample())


class _Notes:
    """What the driven half consists of, noted while it passes."""

    def __init__(self, scene: Scene) -> None:
        self.driven, self.moving = VoxelAccumulator(scene.grid_frame), VoxelAccumulator(scene.grid_frame)
        self._points: list[NDArray[np.float32]] = [np.empty((0, 3), np.float32)]
        self._marks: list[NDArray[np.bool_]] = [np.empty(0, np.bool_)]

    def noted(self, scans: Iterable[SegmentedScan]) -> Iterator[SegmentedScan]:
        for one in scans:
            near, points = in_range(one.scan), one.scan.points_map_m
            self.driven.add(points[near])
            self.moving.add(points[near & one.moving])
            self._points.append(points[near][::SAMPLED].astype(np.float32))
            self._marks.append(one.moving[near][::SAMPLED])
            yield one

    def sample(self) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        return np.concatenate(self._points), np.concatenate(self._marks)


def _inserted(
    scene: Scene, mapping: list[Scan], driving: list[Scan], placed: list[Placed], untouched: Untouched, method: Method,
    number: int,
) -> Inserted:  # fmt: skip
    new, gone = tuple(placed[::2]), tuple(placed[1::2])
    into_map = Painter(scene, [one.shape for one in gone], 2 * number)
    into_drive = Painter(scene, [one.shape for one in new], 2 * number + 1)
    crossed = Painter(scene, [one.shape for one in gone], 2 * number)
    points = _map_of(scene, into_map.paint(mapping), method)
    tiles = points.finish()
    local_map = local_map_of(scene, tiles)
    scans = refined_scans(scene, local_map, into_drive.paint(driving), method.poses)
    found = detect(scene, local_map, segmented(scans, method.segment), method.detect)
    for _ in crossed.paint(driving):
        pass
    static = Cells.of(scene.accumulated(map(scene.refined, [*mapping, *driving])))
    shadowed = changed_by_shadow(untouched.mapped, Cells.of(points))
    return Inserted(found, tiles, truth_of(static, into_drive, into_map, crossed, shadowed), new, gone)
