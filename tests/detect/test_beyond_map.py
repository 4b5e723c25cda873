"""What lies beyond the map extends it: it does not count towards what is implausible."""

import numpy as np
from scipy.ndimage import binary_dilation
from vehicle_scene import FIGURE_2

from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile
from gnd.vehicle_agent.detect.classify import Classification
from gnd.vehicle_agent.detect.detector import tile_evidence
from gnd.vehicle_agent.detect.doubts import beyond_map, changed_share_of

TILE = FIGURE_2[0]
GRID = VoxelGrid.of(TILE)


def ids(*columns: tuple[int, int, int]) -> np.ndarray:
    return np.unique([int(GRID.voxel_id([x], [y], [z])[0]) for x, y, z in columns]).astype(np.int32)


def balls(voxel_id: np.ndarray) -> Gaussians:
    n = len(voxel_id)
    return Gaussians(
        voxel_id,
        np.full(n, 200, np.int32),
        np.full(n, 60, np.int32),
        np.zeros((n, 3), np.float32),
        np.tile(np.float32([0.01, 0, 0, 0.01, 0, 0.01]), (n, 1)),
    )


def classified(ground: np.ndarray, new: np.ndarray) -> Classification:
    """A tile of which the ground is as it was, and the rest new."""
    measured = balls(np.union1d(ground, new).astype(np.int32))
    nothing = (np.empty(0, np.int32), np.empty(0, np.int32))
    evidence = tile_evidence(
        Tile(TILE, int(len(ground) > 0), balls(ground)), np.zeros((len(ground), 4), np.int32), nothing,
        measured.voxel_id, measured,
    )  # fmt: skip
    change_class = np.where(np.isin(evidence.voxel_id, ground), ChangeClass.NORMAL, ChangeClass.NEW).astype(np.uint8)
    return Classification(evidence, change_class)


ROAD = ids(*((x, y, 40) for x in range(12) for y in range(12)))


def test_new_voxels_over_beside_and_under_what_the_map_holds_are_changes() -> None:
    new = ids((3, 3, 41), (3, 3, 45), (12, 5, 40), (5, 5, 38))
    assert not beyond_map(classified(ROAD, new)).any()


def test_new_voxels_two_columns_off_extend_the_map() -> None:
    new, changed = ids((13, 5, 40), (20, 20, 44)), ids((5, 5, 41))
    found = classified(ROAD, np.union1d(new, changed))
    assert found.evidence.voxel_id[beyond_map(found)].tolist() == new.tolist()


def test_a_tile_that_is_mostly_new_ground_is_no_implausible_change_and_a_tile_of_new_walls_is() -> None:
    behind = ids(*((x, y, 40) for x in range(16, 31) for y in range(16, 36)))
    assert changed_share_of(classified(ROAD, behind)) == 0.0
    walls = ids(*((x, 5, z) for x in range(12) for z in range(41, 71)))
    assert changed_share_of(classified(ROAD, walls)) > 0.7
    assert changed_share_of(classified(ids(), behind)) == 1.0, "without a map there is nothing that it could extend"


def test_beside_is_scipys_dilation_up_to_the_edges_of_the_tile() -> None:
    rng = np.random.default_rng(3)
    known = rng.random((GRID.nx, GRID.ny)) < 0.03
    known[0, 0] = known[-1, -1] = True
    ground = ids(*((int(x), int(y), 40) for x, y in np.argwhere(known)))
    new = ids(*((x, y, 43) for x in range(GRID.nx) for y in range(GRID.ny)))
    found = classified(ground, new)
    x, y, _ = GRID.unravel(found.evidence.voxel_id[beyond_map(found)])
    beyond = np.zeros_like(known)
    beyond[x, y] = True
    np.testing.assert_array_equal(beyond, ~binary_dilation(known, np.ones((3, 3))))
    assert 20 < beyond.sum() < known.size - 20
