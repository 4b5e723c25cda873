"""What every reader of recordings gives, whatever the files look like."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnd_map.geodesy import LocalFrame
from gnd_map.motion import Trajectory
from gnd_map.se3 import exp_so3
from schemas.drive import GnssFix, MotionSample, Scan
from vehicle_agent.errors import ImportDriveError

F64 = NDArray[np.float64]

GNSS_SIGMA_M = 2.5


@dataclass(frozen=True, slots=True)
class Anchor:
    """Where on the Earth the first pose of a recording is put."""

    lat_deg: float
    lon_deg: float
    height_m: float

    @property
    def frame(self) -> LocalFrame:
        """ENU at that place."""
        return LocalFrame(np.radians(self.lat_deg), np.radians(self.lon_deg), self.height_m)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A folder of scans, read one by one.

    t_ns: (N,) sweep starts. read: scan i. anchor: origin of the map frame. track: where the recording itself says that
    the vehicle was at the scans, in the map frame and consistent with the LiDAR; None: LiDAR odometry tells. gnss:
    empty where the track must give the fixes. motion: empty where it must give speed and yaw rate.
    """

    name: str
    sensor_model: str
    source: str
    T_vehicle_lidar: F64
    t_ns: NDArray[np.int64]
    read: Callable[[int], Scan]
    anchor: Anchor
    track: Trajectory | None = None
    gnss: tuple[GnssFix, ...] = ()
    motion: tuple[MotionSample, ...] = ()

    def __post_init__(self) -> None:
        if len(self.t_ns) < 2:
            raise ImportDriveError(f"{self.name}: {len(self.t_ns)} scans; a drive needs at least 2")
        late = np.flatnonzero(np.diff(self.t_ns) <= 0)
        if len(late):
            raise ImportDriveError(f"{self.name}: scan {late[0] + 1} is not later than the scan before it")

    def __len__(self) -> int:
        return len(self.t_ns)


def files_of(folder: Path, *patterns: str) -> list[Path]:
    """Files in `folder` that match the first pattern that matches any, sorted by name."""
    for pattern in patterns:
        found = sorted(folder.glob(pattern))
        if found:
            return found
    return []


def check_folder(folder: Path) -> None:
    """ImportDriveError unless `folder` is a folder."""
    if not folder.exists():
        raise ImportDriveError(f"{folder}: no such folder")
    if not folder.is_dir():
        raise ImportDriveError(f"{folder}: is a file; give the folder of the recording")


def mount(yaw_deg: float, height_m: float, pitch_deg: float = 0.0) -> F64:
    """(4, 4) T_vehicle_lidar of a LiDAR `height_m` above the ground, turned about the vertical, then nose down."""
    T = np.eye(4)
    T[:3, :3] = exp_so3([0.0, np.radians(pitch_deg), 0.0]) @ exp_so3([0.0, 0.0, np.radians(yaw_deg)])
    T[2, 3] = height_m
    return T
