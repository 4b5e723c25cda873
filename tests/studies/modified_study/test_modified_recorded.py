"""Truth of inserted objects, sub-cell by sub-cell."""

import numpy as np
import pytest

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile_id import TileId
from studies.modified_study.recorded import SubCellTruth, sub_cells
from studies.real.scene import keys_of

LAT, LON = np.radians([49.0, 8.4])


@pytest.fixture(scope="module")
def grid_frame() -> GridFrame:
    return GridFrame.around(LocalFrame(float(LAT), float(LON), 100.0), [TileId.from_geodetic(float(LAT), float(LON))])


def points(grid_frame: GridFrame, cells: np.ndarray) -> VoxelAccumulator:
    """A point in the middle of each of the sub-cells (K, 3), ten to a voxel's side, from a voxel at the origin."""
    g = np.floor(grid_frame.grid_of(np.zeros((1, 3)))) + (cells + 0.5) / 10.0
    taken = VoxelAccumulator(grid_frame)
    taken.add(grid_frame.map_of_grid(g))
    return taken


def layer(z: int, x: tuple[int, int] = (0, 10), y: tuple[int, int] = (0, 10)) -> np.ndarray:
    """Sub-cells of a horizontal surface."""
    return np.array([(i, j, z) for i in range(*x) for j in range(*y)])


NOTHING = np.empty((0, 3), np.int64)


def truth_at_origin(grid_frame: GridFrame, static: np.ndarray, gone: np.ndarray, new: np.ndarray):
    truth = SubCellTruth.of(*(points(grid_frame, cells) for cells in (static, gone, new)))
    return [
        column.tolist()[0] for column in truth.at(keys_of(grid_frame, np.floor(grid_frame.grid_of(np.zeros((1, 3))))))
    ]


def test_sub_cells_are_those_that_were_filled(grid_frame: GridFrame) -> None:
    cells = np.array([[0, 0, 0], [9, 3, 1], [10, 0, 0], [-1, 5, 9]])
    taken = points(grid_frame, cells)
    found = sub_cells(taken, keys_of(grid_frame, taken.occupied()[0]))
    low = np.floor(grid_frame.grid_of(np.zeros((1, 3))))[0].astype(np.int64) * 10
    assert sorted(map(tuple, (found - low).tolist())) == sorted(map(tuple, cells.tolist()))


@pytest.mark.parametrize(
    ("gone", "new", "share", "before", "after"),
    [
        (NOTHING, layer(5, x=(0, 5)), 50 / 150, 100, 150),
        (layer(5, x=(0, 5)), NOTHING, 50 / 150, 150, 100),
        (NOTHING, layer(1), 0.0, 100, 200),
        (layer(5), layer(6), 0.0, 200, 200),
        (layer(5), layer(8), 0.5, 200, 200),
    ],
    ids=["came", "went", "one sub-cell off", "moved by one", "moved by three"],
)
def test_share_of_what_came_or_went(
    grid_frame: GridFrame, gone: np.ndarray, new: np.ndarray, share: float, before: int, after: int
) -> None:
    found = truth_at_origin(grid_frame, layer(0), gone, new)
    assert found == [pytest.approx(share), before, after]


def test_a_surface_across_the_face_of_a_voxel_explains_what_lies_beside_it(grid_frame: GridFrame) -> None:
    """What lies in the lowest sub-cells is one sub-cell from a surface at the top of the voxel below."""
    assert truth_at_origin(grid_frame, layer(-1), NOTHING, layer(0))[0] == 0.0
    assert truth_at_origin(grid_frame, layer(-2), NOTHING, layer(0))[0] == 1.0


def test_a_voxel_that_no_object_touches_is_as_it_was(grid_frame: GridFrame) -> None:
    far = layer(5) + np.array([50, 0, 0])
    assert truth_at_origin(grid_frame, layer(0), NOTHING, far) == [0.0, 100, 100]
