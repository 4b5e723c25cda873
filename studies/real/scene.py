"""A recording with its track, laid on the grid in one of many ways: which way it lies there is chance, not quality."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import exp_so3
from gnd.gnd_map.tile_id import covering_corridor
from gnd.schemas.drive import DriveHeader, GnssFix, MotionSample, Scan
from gnd.vehicle_agent.importer import fixes_of, map_track, motion_of
from gnd.vehicle_agent.importers.cleaning import cleaned
from gnd.vehicle_agent.importers.lidar_odometry import Progress, reference_ns
from gnd.vehicle_agent.importers.recording import Recording
from gnd.vehicle_agent.localise.estimates import PoseEstimate, RefinedScan
from gnd.vehicle_agent.packed_rays import PlacedRays
from studies.frame.errors import RealDataError
from studies.frame.scans import rays

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

AROUND_M = 130.0
MIN_RANGE_M, MAP_RANGE_M = 2.0, 80.0
"""What `gnd map build` takes."""
_STEP_NS = 1_000_000


@dataclass(frozen=True, slots=True, eq=False)
class RecordedScene:
    """Scans in time order, the vehicle's poses at them, and the grid."""

    name: str
    scans: tuple[Scan, ...]
    poses: Trajectory
    T_vehicle_lidar: F64
    grid_frame: GridFrame
    motion: tuple[MotionSample, ...]
    gnss: tuple[GnssFix, ...]

    def __len__(self) -> int:
        return len(self.scans)

    @property
    def header(self) -> DriveHeader:
        """Of a drive in this scene, its mount taken as given."""
        return DriveHeader("scene", "vehicle", "LiDAR", self.grid_frame.frame, self.T_vehicle_lidar)

    @property
    def positions_m(self) -> F64:
        """(P, 3) where the vehicle was."""
        return self.poses.T_dst_vehicle[:, :3, 3]

    def T_map_lidar(self, scan: Scan) -> F64:
        """(N, 4, 4) pose of the LiDAR at each point, or (4, 4) where the scan is freed of motion distortion."""
        if not scan.t_offset_ns.any():
            return np.asarray(self.poses.at(scan.t_ns) @ self.T_vehicle_lidar)
        step, at = np.unique(scan.t_offset_ns // _STEP_NS, return_inverse=True)
        return np.asarray((self.poses.at(scan.t_ns + step.astype(np.int64) * _STEP_NS) @ self.T_vehicle_lidar)[at])

    def refined(self, scan: Scan) -> RefinedScan:
        """A scan at its reference pose, as a localiser without error would give it."""
        t_ns = reference_ns(scan)
        estimate = PoseEstimate(t_ns, self.poses.at(t_ns), 0.0, 0.0, 1.0, "good")
        return RefinedScan(t_ns, PlacedRays(*rays(scan, self.poses, self.T_vehicle_lidar, t_ns)), estimate)

    def accumulated(self, scans: Sequence[RefinedScan] | Iterator[RefinedScan]) -> VoxelAccumulator:
        """The points of scans as a map build takes them."""
        accumulator = VoxelAccumulator(self.grid_frame)
        for scan in scans:
            accumulator.add(scan.points_map_m[in_range(scan)])
        return accumulator


def in_range(scan: RefinedScan, farthest_m: float = MAP_RANGE_M) -> NDArray[np.bool_]:
    """(N,) bool, the points of a scan that are neither the vehicle itself nor too far."""
    range_m = np.linalg.norm(scan.points_map_m - scan.origins_map_m, axis=1)
    return np.asarray((range_m >= MIN_RANGE_M) & (range_m <= farthest_m))


@dataclass(frozen=True, slots=True, eq=False)
class RecordedScans:
    """The scans of a recording in memory, with the track over all of them; `left_out` tells what was not used."""

    name: str
    scans: tuple[Scan, ...]
    track: Trajectory
    recording: Recording
    left_out: tuple[str, ...]


def load(recording: Recording, at_most: int, progress: Progress, *, fewest: int = 4) -> RecordedScans:
    """Read a recording and find its track.

    Args:
        recording: of any format.
        at_most: its first scans only: all of them are held in memory.
        progress: as the importer's.
        fewest: so many usable scans at least.

    Raises:
        RealDataError: fewer usable scans.
        ImportDriveError: damaged files, scans that do not fit together.
    """
    whole, n = len(recording), min(len(recording), at_most)
    recording = replace(recording, t_ns=recording.t_ns[:n]) if n > 1 else recording
    track = map_track(recording, progress)
    found, empty = [], 0
    for i in range(n):
        scan = cleaned(recording.read(i)).scan
        empty += scan is None
        if scan is not None and track.t_ns[0] <= reference_ns(scan) <= track.t_ns[-1]:
            found.append(scan)
        progress("reading scans", i + 1, n)
    if len(found) < fewest:
        what = " for two halves" if fewest > 2 else ""
        raise RealDataError(f"{recording.name}: {len(found)} usable scans of {n}; at least {fewest} are needed{what}")
    left_out = list(recording.notes)
    left_out += [f"{empty} scans without a usable point: left out"] if empty else []
    left_out += [f"scans after the first {n} of {whole}: left out"] if n < whole else []
    return RecordedScans(recording.name, tuple(found), track, recording, tuple(left_out))


def place(recorded: RecordedScans, number: int, seed: int = 0) -> RecordedScene:
    """The recording turned about the vertical and shifted by less than a voxel, seeded; number 0 is as recorded."""
    rng, A = np.random.default_rng([77, seed, number]), np.eye(4)
    if number:
        A[:3, :3] = exp_so3([0.0, 0.0, rng.uniform(0.0, 2.0 * np.pi)])
        A[:3, 3] = rng.uniform(-0.5, 0.5, 3)
    poses = Trajectory(recorded.track.t_ns, A @ recorded.track.T_dst_vehicle)
    frame = recorded.recording.anchor.frame
    return RecordedScene(
        name=recorded.name,
        scans=recorded.scans,
        poses=poses,
        T_vehicle_lidar=recorded.recording.T_vehicle_lidar,
        grid_frame=_grid_frame(frame, poses),
        motion=recorded.recording.motion or tuple(motion_of(poses)),
        gnss=tuple(fixes_of(recorded.recording, poses)),
    )


def _grid_frame(frame: LocalFrame, poses: Trajectory) -> GridFrame:
    lat, lon, _ = frame.geodetic_from_enu(poses.T_dst_vehicle[:, :3, 3])
    return GridFrame.around(frame, covering_corridor(lat, lon, AROUND_M))


_BITS, _HALF = 21, 1 << 20


def origin_of(grid_frame: GridFrame) -> I64:
    """(3,) integer grid coordinates at the frame's origin: keys count from here."""
    return np.asarray(np.floor(grid_frame.grid_of(np.zeros((1, 3)))[0]), np.int64)


def keys_of(grid_frame: GridFrame, g: ArrayLike) -> I64:
    """(N,) one integer a voxel for integer grid coordinates (N, 3), within a million voxels of the origin."""
    offset = np.asarray(g, np.int64) - origin_of(grid_frame) + _HALF
    return np.asarray((offset[..., 0] << 2 * _BITS) | (offset[..., 1] << _BITS) | offset[..., 2])


def centres_m(grid_frame: GridFrame, keys: I64) -> F64:
    """(N, 3) map frame, the middles of voxels that are named by their keys (N,)."""
    mask = (1 << _BITS) - 1
    offset = np.stack([keys >> 2 * _BITS, (keys >> _BITS) & mask, keys & mask], axis=1)
    return np.asarray(grid_frame.centre_map_m(offset - _HALF + origin_of(grid_frame)))


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Voxels with points: keys (M,) int64 increasing, occupied sub-cells (M,) and points (M,)."""

    keys: I64
    cells: I64
    count: I64

    @classmethod
    def of(cls, accumulator: VoxelAccumulator) -> "Cells":
        """What an accumulator has taken."""
        g, moments = accumulator.moments()
        keys = keys_of(accumulator.grid_frame, g)
        order = np.argsort(keys)
        return cls(keys[order], moments.cells[order].astype(np.int64), moments.count[order])

    def cells_at(self, keys: I64) -> I64:
        """(K,) occupied sub-cells of voxels, 0 where there is no point."""
        return self._at(keys, self.cells)

    def count_at(self, keys: I64) -> I64:
        """(K,) points in voxels."""
        return self._at(keys, self.count)

    def dense(self, n_min_cells: int) -> I64:
        """Keys of the voxels with at least so many sub-cells."""
        return self.keys[self.cells >= n_min_cells]

    def _at(self, keys: I64, values: I64) -> I64:
        if not len(self.keys):
            return np.zeros(len(keys), np.int64)
        row = np.minimum(np.searchsorted(self.keys, keys), len(self.keys) - 1)
        return np.where(self.keys[row] == keys, values[row], 0)
