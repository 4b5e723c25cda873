"""What an update of a point cloud changes, voxel by voxel."""

import numpy as np

from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.geodesy import LocalFrame
from studies.pcd.points import PcdMap, gnd_of
from studies.pcd.report import PcdReport
from studies.pcd.shapes import changed_shapes, cloud_model

FRAME = LocalFrame(0.65, 2.2, 30.0)


def wall(x_m: float) -> np.ndarray:
    """Points every 10 cm on a wall of 3 m by 3 m."""
    y, z = np.meshgrid(np.arange(0.05, 3.0, 0.1), np.arange(0.05, 3.0, 0.1))
    return np.column_stack([np.full(y.size, x_m), y.ravel(), z.ravel()]).astype(np.float32)


def test_only_voxels_that_changed_are_given_with_the_points_between_them() -> None:
    base = PcdMap(np.concatenate([wall(0.3), wall(10.3)]), FRAME)
    index = np.flatnonzero((base.points_m[:, 0] < 1.0) & (base.points_m[:, 1] < 1.5)).astype(np.int32)
    came = base.points_m[index][::2] + np.float32([0.3, 0.0, 0.0])
    report = PcdReport(came, index, np.arange(0, dtype=np.int32), len(base))
    grid_frame = base.grid_frame
    found = changed_shapes(base, report, grid_frame)
    before = gnd_of(base, grid_frame)
    assert 0 < sum(len(one.was) for one in found.values()) < sum(map(len, before.values()))
    for tile, one in found.items():
        held: Gaussians = before[tile].select(one.was.voxel_id)
        assert held == one.was
        np.testing.assert_array_equal(one.stayed + one.went, one.was.count)
        np.testing.assert_array_equal(one.stayed + one.came, one.now.count)
    assert sum(int(one.went.sum()) for one in found.values()) <= len(index)


def test_the_model_of_the_baseline_can_be_read() -> None:
    assert len(cloud_model().forest.root) > 50
