"""The mount of a recording: estimated where none is given, checked where one is.

The ground around is enough to level the LiDAR for odometry. The odometry's track tells the course, and with it the
vehicle's lane, whose ground is not crowned: from that come the final height, roll and pitch.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse, exp_so3
from gnd.schemas.drive import MountSigma
from gnd.vehicle_agent.importers.cleaning import cleaned
from gnd.vehicle_agent.importers.mount import (
    CROWN_RAD,
    FLOOR_RAD,
    GroundSeen,
    MountRefused,
    YawSeen,
    ground_of,
    ground_of_scans,
    upright,
    yaw_of_track,
)
from gnd.vehicle_agent.importers.recording import Recording

F64 = NDArray[np.float64]

LOOKED_AT: Final = 20
"""Scans over the drive whose ground is looked at."""
WARN_M: Final = 0.05
WARN_RAD: Final = np.radians(0.5)
"""A given mount that is off by less, or by less than three sigmas, is not worth a word."""


def levelled(recording: Recording) -> Recording:
    """A recording that gives no mount with its LiDAR set upright above the ground, yaw as it is.

    Where the ground is not seen it stays as it is, and the notes say so.
    """
    if recording.mount != "assumed":
        return recording
    ground = _ground(recording, None)
    if isinstance(ground, MountRefused):
        note = f"mount not given and not found ({ground.reason}): the LiDAR is taken to sit at the vehicle's origin"
        return replace(recording, notes=(*recording.notes, note))
    sigma = MountSigma(ground.height_sigma_m, ground.roll_sigma_rad, ground.pitch_sigma_rad, float("inf"))
    return _mounted(recording, ground, sigma)


def with_mount(recording: Recording, track: Trajectory) -> tuple[Recording, Trajectory]:
    """The recording and its track once the way is known: yaw, and the ground of the lane; or a mount that was checked.

    Args:
        recording: as `levelled` left it.
        track: T_dst_vehicle of the scans, whatever dst is. Poses of the LiDAR in dst stay as they are.
    """
    if recording.mount == "given":
        return replace(recording, notes=(*recording.notes, *_doubts(recording, track))), track
    if recording.mount != "estimated" or recording.mount_sigma is None:
        return recording, track
    yaw = yaw_of_track(_lidar_poses(track, recording.T_vehicle_lidar))
    if isinstance(yaw, MountRefused):
        note = f"{_said(recording)}; yaw is not known ({yaw.reason}): the LiDAR's x is taken as forward"
        return replace(recording, notes=(*recording.notes, note)), track
    found = _turned(recording, yaw)
    lane = _ground(found, 0.0)
    if isinstance(lane, GroundSeen):
        sigma = MountSigma(lane.height_sigma_m, lane.roll_sigma_rad, lane.pitch_sigma_rad, yaw.sigma_rad)
        found = _mounted(found, lane, sigma)
    found = replace(found, notes=(*found.notes, f"{_said(found)} over {yaw.way_m:.0f} m driven straight"))
    return found, moved(track, recording.T_vehicle_lidar, found.T_vehicle_lidar)


def moved(track: Trajectory, T_before: F64, T_after: F64) -> Trajectory:
    """The track of the vehicle whose LiDAR has another mount than was thought, the LiDAR's poses being the same."""
    return Trajectory(track.t_ns, track.T_dst_vehicle @ T_before @ T_inverse(T_after))


def _mounted(recording: Recording, ground: GroundSeen, sigma: MountSigma) -> Recording:
    """The mount turned upright and set above the ground that was seen with it; an own track follows."""
    T = recording.T_vehicle_lidar.copy()
    T[:3, :3] = upright(ground) @ T[:3, :3]
    T[2, 3] = ground.height_m
    track = recording.track and moved(recording.track, recording.T_vehicle_lidar, T)
    return replace(recording, T_vehicle_lidar=T, mount="estimated", mount_sigma=sigma, track=track)


def _turned(recording: Recording, yaw: YawSeen) -> Recording:
    T = recording.T_vehicle_lidar.copy()
    T[:3, :3] = exp_so3([0.0, 0.0, yaw.yaw_rad]) @ T[:3, :3]
    sigma = recording.mount_sigma and recording.mount_sigma._replace(yaw_rad=yaw.sigma_rad)
    return replace(recording, T_vehicle_lidar=T, mount_sigma=sigma)


def _ground(recording: Recording, course_rad: float | None) -> GroundSeen | MountRefused:
    """The ground as the LiDAR sees it in the vehicle's axes: tilts are what the mount lacks to stand upright."""
    numbers = np.unique(np.linspace(0, len(recording) - 1, LOOKED_AT).astype(int))
    scans = [scan for i in numbers if (scan := cleaned(recording.read(int(i))).scan) is not None]
    R = recording.T_vehicle_lidar[:3, :3]
    seen = [ground_of(scan.points_m @ R.T, course_rad) for scan in scans]
    return ground_of_scans(seen, CROWN_RAD if course_rad is None else FLOOR_RAD)


def ground_seen(recording: Recording) -> GroundSeen | None:
    """The ground as the LiDAR sees it in the vehicle's axes, its height below the LiDAR; None where it is not seen."""
    ground = _ground(recording, None)
    return ground if isinstance(ground, GroundSeen) else None


def _lidar_poses(track: Trajectory, T_vehicle_lidar: F64) -> F64:
    """(N, 4, 4) where the LiDAR was, in the vehicle's axes."""
    lever = np.eye(4)
    lever[:3, 3] = T_vehicle_lidar[:3, 3]
    return np.asarray(track.T_dst_vehicle @ lever)


@dataclass(frozen=True, slots=True)
class _Off:
    """One figure of a given mount: by how much the scans differ, one sigma, and what is worth a word."""

    name: str
    given: float
    off: float
    sigma: float
    least: float
    per: float
    unit: str

    @property
    def doubt(self) -> str | None:
        if abs(self.off) <= max(self.least, 3.0 * self.sigma):
            return None
        given, found, sigma = self.given * self.per, (self.given + self.off) * self.per, self.sigma * self.per
        return f"{self.name} {given:.2f}{self.unit} given, {found:.2f} ± {sigma:.2f}{self.unit} seen"


def _doubts(recording: Recording, track: Trajectory) -> tuple[str, ...]:
    """Warnings about a given mount that the scans contradict."""
    ground, yaw = _ground(recording, 0.0), yaw_of_track(_lidar_poses(track, recording.T_vehicle_lidar))
    roll, pitch, heading = angles_of(recording.T_vehicle_lidar[:3, :3])
    height, off = recording.T_vehicle_lidar[2, 3], list[_Off]()
    deg = np.degrees(1.0)
    if isinstance(ground, GroundSeen):
        off.append(_Off("height", height, ground.height_m - height, ground.height_sigma_m, WARN_M, 1.0, " m"))
        off.append(_Off("roll", roll, ground.roll_rad, ground.roll_sigma_rad, WARN_RAD, deg, "°"))
        off.append(_Off("pitch", pitch, ground.pitch_rad, ground.pitch_sigma_rad, WARN_RAD, deg, "°"))
    if isinstance(yaw, YawSeen):
        off.append(_Off("yaw", heading, yaw.yaw_rad, yaw.sigma_rad, WARN_RAD, deg, "°"))
    doubts = [doubt for one in off if (doubt := one.doubt)]
    return (f"warning: the given mount does not fit the scans: {'; '.join(doubts)}",) if doubts else ()


def angles_of(R: F64) -> tuple[float, float, float]:
    """Roll, pitch and yaw of a mount R_y(pitch) R_x(roll) R_z(yaw): tilts about the vehicle's axes."""
    up = R[:, 2]
    roll = float(-np.arcsin(np.clip(up[1], -1.0, 1.0)))
    pitch = float(np.arctan2(up[0], up[2]))
    flat = (exp_so3([0.0, pitch, 0.0]) @ exp_so3([roll, 0.0, 0.0])).T @ R
    return roll, pitch, float(np.arctan2(flat[1, 0], flat[0, 0]))


def _said(recording: Recording) -> str:
    sigma, T = recording.mount_sigma, recording.T_vehicle_lidar
    assert sigma is not None
    angles = zip(("roll", "pitch", "yaw"), angles_of(T[:3, :3]), sigma[1:], strict=True)
    known = [f"{name} {np.degrees(a):.2f} ± {np.degrees(s):.2f}°" for name, a, s in angles if np.isfinite(s)]
    return (
        f"mount estimated from the scans: LiDAR {T[2, 3]:.3f} ± {sigma.height_m:.3f} m above ground, {', '.join(known)}"
    )
