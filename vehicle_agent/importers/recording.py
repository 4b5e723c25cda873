"""What every reader of recordings gives, whatever the files look like."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import exp_so3
from gnd.schemas.drive import Deskew, GnssFix, MotionSample, MountSigma, MountSource, Scan
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.cleaning import RawScan
from gnd.vehicle_agent.importers.trajectories.pose_table import PoseTable

F64 = NDArray[np.float64]

GNSS_SIGMA_M = 2.5


@dataclass(frozen=True, slots=True)
class RecordingAnchor:
    """Where on the Earth the first pose of a recording (or the origin of its poses' local frame) is put.

    heading_deg: compass heading of the vehicle there (or of the local frame's x axis), clockwise from north; None: not
    given, and east is taken where nothing else tells.
    """

    lat_deg: float
    lon_deg: float
    height_m: float
    heading_deg: float | None = None

    @property
    def T_map_start(self) -> F64:
        """(4, 4) turn about the vertical by the heading; the identity looks east."""
        T = np.eye(4)
        T[:3, :3] = exp_so3([0.0, 0.0, np.radians(90.0 - (90.0 if self.heading_deg is None else self.heading_deg))])
        return T

    @property
    def frame(self) -> LocalFrame:
        """ENU at that place."""
        return LocalFrame(np.radians(self.lat_deg), np.radians(self.lon_deg), self.height_m)


NOMINAL = RecordingAnchor(49.0, 8.4, 160.0)
"""Stands for no place, where a recording and whoever imports it do not say where it was taken."""


@dataclass(frozen=True, slots=True)
class Entry:
    """Something that a recording holds: a topic, a kind of file, a trajectory.

    detail: frame, fields, units. used: what for; empty where it is not. why: the reason it is not used, or what to do.
    """

    name: str
    kind: str
    count: int
    detail: str = ""
    used: str = ""
    why: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Scans, read one by one.

    t_ns: (N,) sweep starts. read: scan i. anchor: origin of the map frame. track: where the recording itself says that
    the vehicle was at the scans, in the map frame and consistent with the LiDAR; None: LiDAR odometry tells. gnss:
    empty where the track must give the fixes. motion: empty where it must give speed and yaw rate. notes: what
    had to be left out or put right, one sentence each.

    deskew: what the recording says of the times of points; "none" lets the import find out. stamp: what `t_ns` means
    while the times of points are not known. sweep_ns: length of a sweep; 0: the time between scans. mount: whether the
    recording gives `T_vehicle_lidar`; "assumed" lets the import estimate it.

    placed: whether the recording or whoever imports it says where on the Earth it was taken; else `anchor` stands for
    no place. lever_m: of the GNSS antenna in the vehicle frame. posed: share of the
    scans as recorded that have a pose. timed: whether the
    recording itself tells when the scans were taken. poses_on: poses on a topic
    of it. entries: what the recording holds.
    """

    name: str
    sensor_model: str
    source: str
    T_vehicle_lidar: F64
    t_ns: NDArray[np.int64]
    read: Callable[[int], RawScan | Scan]
    anchor: RecordingAnchor
    track: Trajectory | None = None
    gnss: tuple[GnssFix, ...] = ()
    motion: tuple[MotionSample, ...] = ()
    notes: tuple[str, ...] = ()
    deskew: Deskew = "none"
    stamp: Literal["begin", "middle"] = "begin"
    sweep_ns: int = 0
    mount: MountSource = "given"
    mount_sigma: MountSigma | None = None
    placed: bool = True
    lever_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    posed: float = 1.0
    timed: bool = True
    poses_on: Callable[[str], PoseTable] | None = None
    entries: tuple[Entry, ...] = ()

    def __post_init__(self) -> None:
        if len(self.t_ns) < 2:
            raise ImportDriveError(f"{self.name}: {len(self.t_ns)} scans; a drive needs at least 2")
        late = np.flatnonzero(np.diff(self.t_ns) <= 0)
        if len(late):
            raise ImportDriveError(f"{self.name}: scan {late[0] + 1} is not later than the scan before it")

    def __len__(self) -> int:
        return len(self.t_ns)


def mount(yaw_deg: float, height_m: float, pitch_deg: float = 0.0) -> F64:
    """(4, 4) T_vehicle_lidar of a LiDAR `height_m` above the ground, turned about the vertical, then nose down."""
    T = np.eye(4)
    T[:3, :3] = exp_so3([0.0, np.radians(pitch_deg), 0.0]) @ exp_so3([0.0, 0.0, np.radians(yaw_deg)])
    T[2, 3] = height_m
    return T
