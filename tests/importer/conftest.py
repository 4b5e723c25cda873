"""Folders of recordings of a room."""

from pathlib import Path

import numpy as np
import pytest
from recording_testing import scan_of, true_pose, write_bin


@pytest.fixture
def kitti_folder(tmp_path: Path) -> Path:
    """Eight scans at 10 Hz as the odometry benchmark lays them out, ground truth in the camera's axes."""
    folder = tmp_path / "sequence"
    (folder / "velodyne").mkdir(parents=True)
    for k in range(8):
        write_bin(folder / "velodyne" / f"{k:06d}.bin", scan_of(k))
    np.savetxt(folder / "times.txt", 0.1 * np.arange(8))
    Tr = np.array([[0, -1, 0, 0.0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])
    poses = [(Tr @ true_pose(k) @ np.linalg.inv(Tr))[:3].ravel() for k in range(8)]
    np.savetxt(folder / "poses.txt", poses)
    (folder / "calib.txt").write_text("P0: 1 0\nTr: " + " ".join(map(str, Tr[:3].ravel())) + "\n")
    return folder
