"""A small program that takes part: what is occupied now and was not, and what rays pass through that was occupied.

    python example.py FOLDER submission.csv && python score.py FOLDER submission.csv

It takes the given poses, counts points and rays in each voxel, and compares the counts with fixed thresholds. The
merged map is what more than half of the vehicles that saw a voxel say. It needs numpy alone, and never says "modified".
"""

import json
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from score import VoxelFrame  # type: ignore[import-not-found]

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

RANGE_M, STEP_M, BEFORE_END_M = 30.0, 0.5, 1.0  # rays are followed at steps, up to so far before they end
NEW_POINTS, NEW_SCANS, GONE_PASSES, GONE_POINTS = 30, 10, 40, 3


def scans_of(drive: Path, poses: F64) -> Iterator[tuple[F64, F64]]:
    """The points and the place of the sensor of each scan, freed of the vehicle's motion, in the map frame."""
    T = np.array(json.loads((drive / "calibration.json").read_text())["T_vehicle_lidar"])
    for name, t_ns in np.loadtxt(drive / "scans.csv", delimiter=",", skiprows=1, usecols=(0, 1), dtype=np.int64):
        x = np.fromfile(drive / "scans" / f"{name:06d}.bin", "<f4").reshape(-1, 5).astype(float)
        t = t_ns - poses[0, 0] + x[:, 3] * 1e9
        place, q = (
            np.stack([np.interp(t, poses[:, 0] - poses[0, 0], poses[:, c]) for c in columns], axis=1)
            for columns in ((1, 2, 3), (4, 5, 6, 7))
        )
        q /= np.linalg.norm(q, axis=1, keepdims=True)
        yield turned(q, x[:, :3] @ T[:3, :3].T + T[:3, 3]) + place, turned(q, T[None, :3, 3]) + place


def turned(q: F64, v: F64) -> F64:
    """Vectors (N, 3) turned by quaternions x, y, z, w (N, 4)."""
    u = 2.0 * np.cross(q[:, :3], v)
    return np.asarray(v + q[:, 3:] * u + np.cross(q[:, :3], u))


def counts_of(drive: Path, frame: VoxelFrame) -> tuple[I32, I32, I32]:
    """For each voxel of the world, as an array of its size: points, scans with points, rays that passed."""
    points, scans, passes = (np.zeros(frame.size, np.int32) for _ in range(3))
    poses = np.loadtxt(drive / "poses.csv", delimiter=",", skiprows=1)
    for ends, starts in scans_of(drive, poses):
        ray = ends - starts
        length = np.linalg.norm(ray, axis=1)
        voxels = frame.voxels_of(ends[length < RANGE_M])
        where, number = np.unique(voxels[frame.inside(voxels)], axis=0, return_counts=True)
        points[tuple(where.T)] += number
        scans[tuple(where.T)] += 1
        for at in np.arange(2.0, RANGE_M, STEP_M):
            passing = (length > at + BEFORE_END_M)[::4]
            voxels = frame.voxels_of(starts[::4][passing] + ray[::4][passing] * (at / length[::4][passing])[:, None])
            where, number = np.unique(voxels[frame.inside(voxels)], axis=0, return_counts=True)
            passes[tuple(where.T)] += number
    return points, scans, passes


def main(folder: Path, submission: Path) -> None:
    """Write what changed in each world, by each vehicle alone and by all of them."""
    lines = ["world,vehicle,i,j,k,class"]
    for world in json.loads((folder / "benchmark.json").read_text())["worlds"]:
        home = folder / "worlds" / world["name"]
        votes: Counter[tuple[int, int, int, str]] = Counter()
        seen: Counter[tuple[int, int, int]] = Counter()
        frame = VoxelFrame.read(home / "frame.json")
        held = np.zeros(frame.size, bool)
        table = np.loadtxt(home / "map_before" / "gaussians.csv", delimiter=",", skiprows=1)
        held[tuple(table[:, :3].astype(int).T)] = True
        for vehicle in world["vehicles"]:
            points, scans, passes = counts_of(home / "drives" / vehicle, frame)
            new = ~held & (points >= NEW_POINTS) & (scans >= NEW_SCANS) & (points > passes)
            gone = held & (passes >= GONE_PASSES) & (points <= GONE_POINTS)
            for name, found in (("new", new), ("deleted", gone)):
                changed = [(i, j, k, name) for i, j, k in np.argwhere(found).tolist()]
                votes.update(changed)
                lines += [f"{world['name']},{vehicle}," + ",".join(map(str, one)) for one in changed]
            seen.update((i, j, k) for i, j, k in np.argwhere((points > GONE_POINTS) | (passes >= GONE_PASSES)).tolist())
        merged = [one for one, number in votes.items() if 2 * number > seen[one[0], one[1], one[2]]]
        lines += [f"{world['name']},merged," + ",".join(map(str, one)) for one in merged]
    submission.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
