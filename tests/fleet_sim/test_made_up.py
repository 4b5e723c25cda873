"""Made-up boxes stand on bare ground beside the way, and their voxels are those that the LiDAR measured on them."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from gnd.fleet_sim.errors import SimError
from gnd.fleet_sim.lidar import Lidar
from gnd.fleet_sim.made_up import NEAREST_M, MadeUpBoxes, bare_places, together, write_with_boxes
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.sensors import VLP16
from gnd.fleet_sim.shapes import Block, Shape
from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas.drive import DriveHeader, ReferencePose, Scan
from gnd.schemas.drive_mcap import DriveWriter, read_drive

ANCHOR = LocalFrame(np.radians(49.0), np.radians(8.4), 100.0)
STEP_NS, SPEED_MPS, SCANS, HEIGHT_M = 100_000_000, 8.0, 60, 1.8
GROUND = Block(20.0, 0.0, 80.0, 40.0, -2.0, 0.0)
LEFT_WALL, RIGHT_WALL = Block(20.0, 2.4, 60.0, 0.2, 0.0, 5.0), Block(20.0, -2.4, 60.0, 0.2, 0.0, 5.0)
CAR = Block(20.0, -5.0, 2.2, 0.9, 0.0, 1.5)


def pose(x_m: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x_m
    return T


def drive(path: Path, shapes: list[Shape], scans: int = SCANS) -> Path:
    """A VLP-16 that moves along x at 8 m/s, 48 m; noise-free."""
    lidar, scene = Lidar(VLP16), Scene.build(shapes)
    T_vehicle_lidar = np.eye(4)
    T_vehicle_lidar[2, 3] = HEIGHT_M
    share = np.arange(VLP16.columns + 1) / VLP16.columns
    with DriveWriter(path, DriveHeader("d", "v", "VLP-16", ANCHOR, T_vehicle_lidar)) as writer:
        for k in range(scans):
            t_ns = (k + 1) * STEP_NS
            writer.add(ReferencePose(t_ns, pose(SPEED_MPS * k * 0.1)))
            poses = np.stack([pose(SPEED_MPS * (k + s) * 0.1) @ T_vehicle_lidar for s in share])
            hits = lidar.hits(scene, poses)
            seen = hits.primitive >= 0
            points = (VLP16.directions()[seen] * hits.range_m[seen][:, None]).astype(np.float32)
            column = np.broadcast_to(np.arange(seen.shape[0])[:, None], seen.shape)[seen]
            writer.add(Scan(t_ns, points, (share[column] * STEP_NS).astype(np.uint32)))
        writer.add(ReferencePose((scans + 1) * STEP_NS, pose(SPEED_MPS * scans * 0.1)))
    return path


def test_boxes_stand_where_nothing_stands(tmp_path: Path) -> None:
    """A wall on the left, a parked car on the right: all boxes are on the right, clear of the car and of each other."""
    boxes = bare_places(drive(tmp_path / "a.mcap", [GROUND, LEFT_WALL, CAR]), 6)
    assert len(boxes.blocks) >= 4
    for block in boxes.blocks:
        assert block.y_m <= -NEAREST_M
        assert 8.0 < block.x_m < 40.0
        assert block.bottom_m == pytest.approx(-0.1, abs=0.03)
        apart = abs(block.x_m - CAR.x_m) > 3.1 or abs(block.y_m - CAR.y_m) > 1.5  # half lengths and half widths
        assert apart
    x_m = sorted((block.x_m, block.y_m) for block in boxes.blocks)
    assert min(np.hypot(*np.subtract(a, b)) for a, b in pairwise(x_m)) >= 5.0


def test_between_walls_there_is_no_place(tmp_path: Path) -> None:
    assert bare_places(drive(tmp_path / "a.mcap", [GROUND, LEFT_WALL, RIGHT_WALL]), 4).blocks == ()


def test_a_drive_that_is_too_short_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SimError, match="16 m with reference poses; made-up boxes need 20 m"):
        bare_places(drive(tmp_path / "a.mcap", [GROUND], scans=20), 4)


def test_the_voxels_of_a_box_are_where_it_stands_and_the_rest_stays(tmp_path: Path) -> None:
    source = drive(tmp_path / "a.mcap", [GROUND])
    boxes = bare_places(source, 2)
    voxels = write_with_boxes(source, tmp_path / "b.mcap", boxes)
    assert all(sum(map(len, box.values())) >= 4 for box in voxels)
    for before, after in zip(read_drive(source), read_drive(tmp_path / "b.mcap"), strict=True):
        if isinstance(before, Scan) and isinstance(after, Scan):
            nearer = np.linalg.norm(after.points_m, axis=1) < np.linalg.norm(before.points_m, axis=1) - 1e-3
            same = (after.points_m == before.points_m).all(axis=1)
            assert (nearer | same).mean() > 0.999  # at a box's foot the noise may put a point behind the ground
    nowhere = MadeUpBoxes(ANCHOR, tuple(replace(block, x_m=block.x_m + 500.0) for block in boxes.blocks))
    assert write_with_boxes(source, tmp_path / "c.mcap", nowhere) == [{}, {}]
    assert [sum(map(len, box.values())) for box in together(voxels, [{}, {}])] == [
        sum(map(len, box.values())) for box in voxels
    ]


def test_another_drive_with_another_anchor_meets_the_same_boxes() -> None:
    boxes = MadeUpBoxes(ANCHOR, (Block(10.0, 5.0, 0.9, 0.6, -0.1, 2.0, 0.4),))
    other = LocalFrame(np.radians(49.0005), np.radians(8.4004), 98.0)
    (block,) = boxes.in_frame(other)
    there = other.ecef_from_enu([block.x_m, block.y_m, block.bottom_m])
    assert np.allclose(there, ANCHOR.ecef_from_enu([10.0, 5.0, -0.1]), atol=1e-6)
    assert block.top_m - block.bottom_m == pytest.approx(2.1)
    assert block.yaw_rad == pytest.approx(0.4, abs=1e-4)
