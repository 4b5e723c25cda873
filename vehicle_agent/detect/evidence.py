"""Evidence of the rays of one drive about the voxels of one tile."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import check_array
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty


@dataclass(frozen=True, slots=True, eq=False)
class TileEvidence:
    """The six counters of GND section 4.3 and the new points, for every voxel of a tile that a ray touched.

    All of it adds over scans. The map of the tile was the same for all of them.
    """

    base: Tile
    """The map that the rays were compared with; version 0 where the store has no such tile."""
    voxel_id: NDArray[np.int32]
    """(K,) strictly increasing."""
    map_row: NDArray[np.int64]
    """(K,) row in `base.gaussians`, -1 where the map has no Gaussian."""
    n_bi: NDArray[np.int32]
    """(K,) points blocked inside the map's Gaussian."""
    n_bo: NDArray[np.int32]
    """(K,) points blocked outside it."""
    n_pi: NDArray[np.int32]
    """(K,) rays passing inside it."""
    n_po: NDArray[np.int32]
    """(K,) rays passing outside it."""
    n_be: NDArray[np.int32]
    """(K,) points blocked in an empty voxel."""
    n_pe: NDArray[np.int32]
    """(K,) rays passing an empty voxel."""
    measured: Gaussians
    """(K,) the points that ended in each voxel as a Gaussian, however few they are; count 0 where none did."""
    pose: PoseUncertainty = field(default_factory=PoseUncertainty)
    """How well the poses of the scans were known that gave the evidence."""
    at_one_height: bool = False
    """Whether all rays came from a few level layers (`gnd.vehicle_agent.localise.level`): they meet a voxel at one
    height, however many they are."""

    def __post_init__(self) -> None:
        """The columns belong together."""
        n = len(self.voxel_id)
        check_array("voxel_id", self.voxel_id, np.int32, (n,))
        check_array("map_row", self.map_row, np.int64, (n,))
        for name in ("n_bi", "n_bo", "n_pi", "n_po", "n_be", "n_pe"):
            check_array(name, getattr(self, name), np.int32, (n,))
        check_array("measured.count", self.measured.count, np.int32, (n,))

    def __len__(self) -> int:
        return len(self.voxel_id)

    @property
    def in_map(self) -> NDArray[np.bool_]:
        """(K,) whether the map holds a Gaussian there."""
        return self.map_row >= 0

    @property
    def counters(self) -> NDArray[np.int32]:
        """(K, 4) n_BI, n_BO, n_BE, n_PI as reports carry them."""
        return np.stack([self.n_bi, self.n_bo, self.n_be, self.n_pi], axis=1)
