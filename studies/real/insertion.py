"""Objects into the scans of one half, and which voxels that makes truly new or deleted.

The truth rests on points and rays alone, never on what a method makes of them. An object's voxel is *new* where the
vehicle's beams met the object in 20 sub-cells and all untouched scans together hold less than five there; it is
*deleted* where the mapping beams did so, and *measured* as such where three beams of the vehicle cross the vanished
surface. Voxels that an object touches in any other way, and those of the map that its shadow changed, count for
nothing.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.insert import Inserter
from gnd.fleet_sim.shapes import Shape
from gnd.gnd_map.accumulate import N_MIN_CELLS, VoxelAccumulator
from gnd.schemas.drive import Scan
from studies.real.scene import Scene
from studies.real.voxels import Cells

RANGE_SIGMA_M = 0.02
MEASURED_M = 50.0
"""Farther points on an object make no truth: detection does not use them."""
FREE_CELLS = 5
MIN_BEAMS = 3
I64 = NDArray[np.int64]


class Painter:
    """Puts objects into scans and remembers the points that then lie on them."""

    def __init__(self, scene: Scene, shapes: Sequence[Shape], seed: int) -> None:
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
class Truth:
    """Keys of voxels, each sorted.

    new, deleted: as the module says; measured: the deleted ones that the vehicle's beams crossed; ignored: neither.
    """

    new: I64
    deleted: I64
    measured: I64
    ignored: I64


def truth_of(static: Cells, new: Painter, deleted: Painter, crossed: Painter, shadowed: I64) -> Truth:
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
    return Truth(pure_new, gone, measured, np.setdiff1d(touched, np.concatenate([pure_new, gone])))


def _free(keys: I64, static: Cells) -> I64:
    return keys[static.cells_at(keys) < FREE_CELLS]


def changed_by_shadow(before: Cells, after: Cells) -> I64:
    """Keys of the map's voxels whose points an inserted object has changed."""
    keys: I64 = np.union1d(before.keys, after.keys)
    return np.asarray(keys[before.count_at(keys) != after.count_at(keys)])
