"""Recordings into drives: read a folder, find the track of all scans, put it on the Earth, write the chosen scans.

The track is found over *all* scans before any is left out, so that the halves of a recording share one frame: what one
half maps, the other half can drive on.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse, exp_so3, log_so3
from gnd.schemas.drive import DriveHeader, DriveItem, GnssFix, MotionSample, ReferencePose
from gnd.schemas.drive_mcap import DriveWriter
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.apollo import open_apollo
from gnd.vehicle_agent.importers.cleaning import MAX_RANGE_M, Cleaned, cleaned
from gnd.vehicle_agent.importers.deskewing import with_times
from gnd.vehicle_agent.importers.detect_format import format_of
from gnd.vehicle_agent.importers.kitti import open_kitti
from gnd.vehicle_agent.importers.lidar_odometry import Progress, lidar_odometry
from gnd.vehicle_agent.importers.mcap_clouds import open_mcap_clouds
from gnd.vehicle_agent.importers.mounting import levelled, with_mount
from gnd.vehicle_agent.importers.pcd import open_pcd
from gnd.vehicle_agent.importers.planes import open_planes
from gnd.vehicle_agent.importers.radiate import open_radiate
from gnd.vehicle_agent.importers.recording import GNSS_SIGMA_M, Recording, RecordingAnchor
from gnd.vehicle_agent.importers.splits import chosen_scans

F64 = NDArray[np.float64]

FORMATS: Final[dict[str, Callable[[Path, RecordingAnchor | None], Recording]]] = {
    "kitti": open_kitti,
    "radiate": open_radiate,
    "pcd": open_pcd,
    "mcap": open_mcap_clouds,
    "planes": open_planes,
    "apollo": open_apollo,
}
AUTO: Final = "auto"
AROUND_NS = 300_000_000  # motion and fixes kept before the first and after the last chosen scan


@dataclass(frozen=True, slots=True)
class Imported:
    """What became of a recording.

    scans: written. empty_scans: left out, because no point of them was left. points_not_finite, points_too_far: left
    out of scans that were written or empty. notes: what else had to be put right.
    """

    scans: int
    empty_scans: int
    points_not_finite: int
    points_too_far: int
    notes: tuple[str, ...] = ()

    @property
    def skipped(self) -> tuple[str, ...]:
        """One sentence for each thing that was left out or put right."""
        counts = (
            (self.empty_scans, "scans without a usable point: left out"),
            (self.points_not_finite, "points that are no numbers: left out"),
            (self.points_too_far, f"points beyond {MAX_RANGE_M:.0f} m: left out"),
        )
        return (*self.notes, *(f"{n} {what}" for n, what in counts if n))


def no_progress(_step: str, _done: int, _total: int) -> None:
    """For callers that show nothing."""


def import_recording(
    kind: str,
    folder: Path,
    out: Path,
    *,
    scans: str = "all",
    anchor: RecordingAnchor | None = None,
    vehicle: str = "recorded",
    topic: str | None = None,
    progress: Progress = no_progress,
) -> Imported:
    """Write the drive `out` (MCAP) from a recording; tell what was written and what was left out.

    Args:
        kind: "kitti", "radiate", "pcd", "mcap", "planes", "apollo", or "auto" to find out.
        folder: of the recording (or its file); see the readers for what it must hold.
        out: file to write.
        scans: which scans; see `chosen_scans`.
        anchor: place on the Earth; see the readers for what it means and whether it may be left out.
        vehicle: pseudonym written into the drive.
        topic: of the clouds in an MCAP file that has several.
        progress: called with a step's name, how much is done, and of how much.

    Raises:
        ImportDriveError: the folder is missing, holds no scans of that format, or is damaged.
        DriveError: the drive cannot be written.
    """
    recording = open_recording(kind, folder, anchor, topic)
    chosen_scans(scans, len(recording))  # a wrong rule is told before the long work
    recording, track = prepared(recording, progress)
    return write_drive(recording, track, out, scans, vehicle, progress)


def open_recording(
    kind: str, folder: Path, anchor: RecordingAnchor | None = None, topic: str | None = None
) -> Recording:
    """A recording of a known format, or of the one that it is found to be of; ImportDriveError when it is none."""
    if kind not in (*FORMATS, AUTO):
        raise ImportDriveError(f"format {kind!r} is not known; known are {', '.join(FORMATS)} and {AUTO}")
    found = format_of(folder) if kind == AUTO else kind
    if found == "mcap":
        return open_mcap_clouds(folder, anchor, topic)
    return FORMATS[found](folder, anchor)


def write_drive(
    recording: Recording,
    track: Trajectory,
    out: Path,
    scans: str = "all",
    vehicle: str = "recorded",
    progress: Progress = no_progress,
) -> Imported:
    """Write the chosen scans of a recording whose track (T_map_vehicle of all scans) is known."""
    chosen, read = chosen_scans(scans, len(recording)), list[Cleaned]()
    with DriveWriter(out, _header(recording, f"{recording.name}-{scans}".replace(":", "-"), vehicle)) as writer:
        for item in _items(recording, track, chosen, read):
            writer.add(item)
            progress("writing scans", len(read), len(chosen))
        return _imported(recording, read)  # inside: a drive without any scan is not written


def _imported(recording: Recording, read: list[Cleaned]) -> Imported:
    empty = sum(one.scan is None for one in read)
    if empty == len(read):
        raise ImportDriveError(f"{recording.name}: none of {len(read)} scans has a usable point")
    lost = sum(one.not_finite for one in read), sum(one.far for one in read)
    return Imported(len(read) - empty, empty, *lost, notes=recording.notes)


def _header(recording: Recording, drive_id: str, vehicle: str) -> DriveHeader:
    return DriveHeader(
        drive_id=drive_id,
        vehicle=vehicle,
        sensor_model=recording.sensor_model,
        anchor=recording.anchor.frame,
        T_vehicle_lidar=recording.T_vehicle_lidar,
        source=recording.source,
        deskew=recording.deskew,
        sweep_ns=recording.sweep_ns,
        mount=recording.mount,
        mount_sigma=recording.mount_sigma,
    )


def prepared(recording: Recording, progress: Progress = no_progress) -> tuple[Recording, Trajectory]:
    """A recording with times of points and a mount, found where it gives none, and T_map_vehicle of every scan.

    Raises:
        ImportDriveError: scans that do not fit each other.
    """
    recording = _with_times(levelled(recording))
    if recording.track is not None:
        recording, track = with_mount(recording, recording.track)
        return replace(recording, track=track), track
    recording, track = with_mount(recording, lidar_odometry(recording, progress))
    track = Trajectory(track.t_ns, T_inverse(track.T_dst_vehicle[0]) @ track.T_dst_vehicle)
    return recording, _over_the_fixes(recording, track)


def _with_times(recording: Recording) -> Recording:
    """Times of points where the recording gives none and they can be found; what was found joins the notes."""
    found, verdict = with_times(recording)
    return replace(found, notes=(*found.notes, verdict.note)) if verdict.note else found


def map_track(recording: Recording, progress: Progress = no_progress) -> Trajectory:
    """T_map_vehicle of every scan: the recording's own track, else LiDAR odometry laid over the fixes."""
    if recording.track is not None:
        return recording.track
    return _over_the_fixes(recording, lidar_odometry(recording, progress))


def _over_the_fixes(recording: Recording, track: Trajectory) -> Trajectory:
    return Trajectory(track.t_ns, _T_map_first(recording, track) @ track.T_dst_vehicle)


def _T_map_first(recording: Recording, track: Trajectory) -> F64:
    """Heading and position that lay the track over the fixes, least squares; the identity without fixes."""
    t_ns = np.array([fix.t_ns for fix in recording.gnss], np.int64)
    within = (t_ns >= track.t_ns[0]) & (t_ns <= track.t_ns[-1])
    if within.sum() < 2:
        return np.eye(4)
    fixes = [fix for fix, inside in zip(recording.gnss, within, strict=True) if inside]
    p_map = recording.anchor.frame.enu_from_geodetic(*np.array([(f.lat_rad, f.lon_rad, f.height_m) for f in fixes]).T)
    return fit_heading_and_position(track.at(t_ns[within])[:, :3, 3], p_map)


def fit_heading_and_position(p_src_m: F64, p_dst_m: F64) -> F64:
    """(4, 4) T_dst_src, turned about the vertical only, that brings points (N, 3) closest to points (N, 3)."""
    middle_src, middle_dst = p_src_m.mean(axis=0), p_dst_m.mean(axis=0)
    a, b = (p_src_m - middle_src)[:, :2], (p_dst_m - middle_dst)[:, :2]
    yaw = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    T = np.eye(4)
    T[:3, :3] = exp_so3([0.0, 0.0, yaw])
    T[:3, 3] = middle_dst - T[:3, :3] @ middle_src
    return T


def _items(
    recording: Recording, track: Trajectory, chosen: NDArray[np.int64], read: list[Cleaned]
) -> Iterator[DriveItem]:
    """Everything of the drive, the small things of its span first; what was read is noted in `read`."""
    first, last = int(recording.t_ns[chosen[0]]) - AROUND_NS, int(recording.t_ns[chosen[-1]]) + AROUND_NS
    small: list[MotionSample | GnssFix | ReferencePose] = [*(recording.motion or motion_of(track))]
    small += recording.gnss or fixes_of(recording, track)
    small += [ReferencePose(int(t), T) for t, T in zip(track.t_ns, track.T_dst_vehicle, strict=True)]
    within = [item for item in small if first <= item.t_ns <= last]
    items = deque(sorted(within, key=lambda item: item.t_ns))
    for number in chosen:
        read.append(cleaned(recording.read(int(number))))
        scan = read[-1].scan
        if scan is None:
            continue
        while items and items[0].t_ns <= scan.t_ns:
            yield items.popleft()
        yield scan
    yield from items


def motion_of(track: Trajectory) -> list[MotionSample]:
    """Speed and yaw rate between the poses of a track, one sample in the middle of each step and one at either end."""
    step = T_inverse(track.T_dst_vehicle[:-1]) @ track.T_dst_vehicle[1:]
    dt_s = np.diff(track.t_ns) * 1e-9
    speed, yaw_rate = step[:, 0, 3] / dt_s, log_so3(step[:, :3, :3])[:, 2] / dt_s
    middle = track.t_ns[:-1] + np.diff(track.t_ns) // 2
    t = np.concatenate([track.t_ns[:1], middle, track.t_ns[-1:]])
    k = np.clip(np.arange(len(t)) - 1, 0, len(speed) - 1)
    return [MotionSample(int(t), float(v), float(w)) for t, v, w in zip(t, speed[k], yaw_rate[k], strict=True)]


def fixes_of(recording: Recording, track: Trajectory) -> list[GnssFix]:
    """The track's positions as fixes of `GNSS_SIGMA_M`, for recordings without any."""
    lat, lon, height = recording.anchor.frame.geodetic_from_enu(track.T_dst_vehicle[:, :3, 3])
    return [
        GnssFix(int(t), float(a), float(o), float(h), GNSS_SIGMA_M)
        for t, a, o, h in zip(track.t_ns, lat, lon, height, strict=True)
    ]
