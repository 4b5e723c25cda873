"""How the masses of single voxels evolve over the scans of one drive (GND, Eq. 11): m(S), m(C), m(Ω)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.truth import Truth
from gnd.gnd_map.arrays import I32, I64
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.detect.evidence import TileEvidence
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.segment.segmenter import SegmentedScan
from studies.simulation.base_map import BaseMap

WATCHED: Final = (ChangeClass.NORMAL, ChangeClass.NEW, ChangeClass.MODIFIED, ChangeClass.DELETED)
_CANDIDATES: Final = 6


@dataclass(frozen=True, slots=True)
class VoxelWatch:
    """Voxels of one tile whose evidence is written down scan by scan.

    Attributes:
        tile: the tile.
        voxel_id: ids, ascending.
        change_class: true class of each.
    """

    tile: TileId
    voxel_id: tuple[int, ...]
    change_class: tuple[int, ...]


def choose(truth: Truth) -> VoxelWatch | None:
    """Return the clearest voxels of each class in the tile where all four classes are best to be seen; None if there is
    no tile with all of them. Decided by the truth alone.
    """
    rows = np.flatnonzero(truth.mask("scored") & np.isin(truth.change_class, WATCHED))
    tiles = np.unique(truth.morton[rows])
    counts = [[np.sum((truth.morton[rows] == m) & (truth.change_class[rows] == c)) for c in WATCHED] for m in tiles]
    if not counts or max(min(c) for c in counts) == 0:
        return None
    tile = TileId(int(tiles[int(np.argmax([min(c) for c in counts]))]))
    inside = rows[truth.morton[rows] == tile.morton]
    chosen = [_clearest(truth, tile, inside[truth.change_class[inside] == c]) for c in WATCHED]
    at = np.sort(np.concatenate(chosen))
    return VoxelWatch(tile, tuple(truth.voxel_id[at].tolist()), tuple(truth.change_class[at].tolist()))


def _clearest(truth: Truth, tile: TileId, rows: I64) -> I64:
    """The rows with the largest Gaussians."""
    cells = [
        _cells_at(state.get(tile, Gaussians.empty()), truth.voxel_id[rows]) for state in (truth.before, truth.after)
    ]
    return rows[np.argsort(-np.maximum(*cells), kind="stable")[:_CANDIDATES]]


def _cells_at(gaussians: Gaussians, voxel_id: I32) -> I32:
    if not len(gaussians):
        return np.zeros(len(voxel_id), np.int32)
    at = np.minimum(np.searchsorted(gaussians.voxel_id, voxel_id), len(gaussians) - 1)
    return np.where(gaussians.voxel_id[at] == voxel_id, gaussians.cells[at], 0).astype(np.int32)


class Watcher:
    """A second detector that holds the watched tile only and is emptied after every scan; evidence adds over scans."""

    def __init__(self, watch: VoxelWatch, base: BaseMap, grid_frame: GridFrame, parameters: DetectParameters) -> None:
        self._watch = watch
        local_map = LocalMap(grid_frame)
        tile = base.tiles.get(watch.tile, Gaussians.empty())
        local_map.set_tile(Tile(watch.tile, 1, tile))
        self._detector = ChangeDetector(local_map, parameters)
        self._voxel_id = np.array(watch.voxel_id, np.int32)
        self._counters: list[NDArray[np.int32]] = []
        self._t_ns: list[int] = []

    def add_scan(self, segmented: SegmentedScan) -> None:
        """Count a scan's rays through the watched tile."""
        scan = segmented.scan
        pose = PoseUncertainty.of(scan.estimate)
        if not self._detector.add_scan(scan.points_map_m, scan.origins_map_m, segmented.moving, pose):
            return
        found = self._detector.finish([self._watch.tile])[self._watch.tile]
        self._counters.append(_counters_at(found, self._voxel_id))
        self._t_ns.append(scan.t_ns)

    def history(self) -> tuple[I64, I32]:
        """Times (S,) of the scans and counters (S, W, 4) n_BI, n_BO, n_BE, n_PI up to and with each."""
        shape = (-1, len(self._voxel_id), 4)
        counters = np.cumsum(np.array(self._counters, np.int64).reshape(shape), axis=0)
        return np.array(self._t_ns, np.int64), counters.astype(np.int32)


def _counters_at(found: TileEvidence, voxel_id: I32) -> I32:
    at = np.searchsorted(found.voxel_id, voxel_id)
    at[at == len(found)] = 0
    known = found.voxel_id[at] == voxel_id if len(found) else np.zeros(len(voxel_id), np.bool_)
    return np.where(known[:, None], found.counters[at], 0) if len(found) else np.zeros((len(voxel_id), 4), np.int32)


def most_telling(watch: VoxelWatch, counters: I32) -> Sequence[int]:
    """Return for each watched class the index of the voxel whose evidence shows its case best.

    Most BI for a normal one, BE for a new one, BO less BI for a modified one, PI for a deleted one; -1 for a class that
    no ray has met.
    """
    if not len(counters):
        return [-1] * len(WATCHED)
    n_bi, n_bo, n_be, n_pi = counters[-1].T.astype(np.int64)
    found = []
    for change_class, shown in zip(WATCHED, (n_bi, n_be, n_bo - n_bi, n_pi), strict=True):
        met = np.flatnonzero((np.array(watch.change_class) == change_class) & (counters[-1].sum(axis=1) > 0))
        found.append(int(met[np.argmax(shown[met])]) if len(met) else -1)
    return found
