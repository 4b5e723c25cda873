"""A recording with somebody's own trajectory: read, laid into the map frame, compared with the scans' times.

Poses become the track as they are: nothing is fitted, smoothed or moved. A scan in a gap of the poses, or before or
after them, has no pose and is left out by name. Positions without rotations become the recording's fixes.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.geodesy import geodetic_from_ecef
from gnd.gnd_map.motion import TOLERANCE_NS, Trajectory
from gnd.gnd_map.se3 import T_inverse
from gnd.schemas.drive import GnssFix, Scan
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.cleaning import RawScan
from gnd.vehicle_agent.importers.fitting import fit_heading_and_position
from gnd.vehicle_agent.importers.kitti import calibration_of
from gnd.vehicle_agent.importers.quality import antenna_m
from gnd.vehicle_agent.importers.recording import GNSS_SIGMA_M, Entry, Recording, RecordingAnchor
from gnd.vehicle_agent.importers.trajectories.frames import ecef_poses, in_map, with_frame, without_camera
from gnd.vehicle_agent.importers.trajectories.pose_file import read_poses
from gnd.vehicle_agent.importers.trajectories.pose_table import PoseTable

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

GAP_NS: Final = 1_000_000_000
GAP_STEPS: Final = 5
"""Poses farther apart than both are a gap: a straight line between them is no measurement of the way."""
RELATIVE_NS: Final = 100_000_000 * 1_000_000_000
"""Times before 1973 count from the beginning of the recording."""


def with_poses(recording: Recording, folder: Path, choices: Choices) -> Recording:
    """The recording with the poses that were chosen as its track, or with the positions as its fixes.

    Raises:
        ImportDriveError: no such file, no trajectory, a frame that is not known, times other than the scans'.
    """
    assert choices.poses is not None
    path = Path(choices.poses)
    of_topic = recording.poses_on is not None and not path.exists()
    table = recording.poses_on(choices.poses) if recording.poses_on is not None and of_topic else read_poses(path)
    return with_table(recording, folder, choices, table)


def with_table(recording: Recording, folder: Path, choices: Choices, table: PoseTable) -> Recording:
    """The same with a trajectory that was read from elsewhere."""
    if table.camera and table.R is not None:
        table = without_camera(table, calibration_of(folder))
        choices = replace(choices, poses_of=choices.poses_of or "lidar")
    table, zone, southern = with_frame(table, choices.poses_frame, _somewhere(recording, choices))
    p_ecef, R_ecef = ecef_poses(table, zone, southern, choices.anchor or _local_place(recording, table, choices))
    anchor, placed = _anchor(recording, choices, table, p_ecef)
    recording = replace(recording, anchor=anchor, placed=placed, notes=(*recording.notes, *table.notes))
    if table.R is None:
        return _with_fixes(recording, table, p_ecef)
    recording, t_ns = _at_one_time(recording, table)
    T = in_map(p_ecef, R_ecef, anchor.frame)
    if table.coordinates == "local" and choices.anchor is None and recording.gnss:
        recording, T = _over_fixes(recording, table, Trajectory(t_ns, T))
    whose = choices.poses_of or ("lidar" if recording.mount == "assumed" else "vehicle")
    if whose == "lidar":
        T = T @ T_inverse(recording.T_vehicle_lidar)
    return _with_track(recording, table, Trajectory(t_ns, np.ascontiguousarray(T)), whose)


def _somewhere(recording: Recording, choices: Choices) -> RecordingAnchor | None:
    """Some place of the recording, where anything tells one."""
    return choices.anchor or (recording.anchor if recording.placed else None)


def _local_place(recording: Recording, table: PoseTable, choices: Choices) -> RecordingAnchor | None:
    """Where the origin of a local frame is put when nobody says: nowhere in particular, or where the fixes lay it."""
    return recording.anchor if table.coordinates == "local" and (choices.nowhere or len(recording.gnss) > 1) else None


def _over_fixes(recording: Recording, table: PoseTable, track: Trajectory) -> tuple[Recording, F64]:
    """Poses of a local frame whose place nobody gave, laid over the recording's fixes; their shape stays."""
    by_track, measured = antenna_m(recording, track)
    if len(by_track) < 2:
        raise ImportDriveError(f"{table.source}: {len(by_track)} fixes at the times of its poses: give --anchor")
    T = fit_heading_and_position(by_track, measured)
    note = f"{table.source}: local frame laid over {len(by_track)} fixes (heading and position)"
    return _noted(recording, note), np.asarray(T @ track.T_dst_vehicle)


def _anchor(recording: Recording, choices: Choices, table: PoseTable, p_ecef: F64) -> tuple[RecordingAnchor, bool]:
    """Origin of the map frame, and whether the recording has a place now."""
    if choices.anchor is not None:
        return choices.anchor, True
    if table.coordinates == "local":
        return recording.anchor, recording.placed and not choices.nowhere
    lat, lon, height = (float(one) for one in geodetic_from_ecef(p_ecef[0]))
    return RecordingAnchor(float(np.degrees(lat)), float(np.degrees(lon)), height), True


def _at_one_time(recording: Recording, table: PoseTable) -> tuple[Recording, I64]:
    """Times of the poses; where poses or scans have none of their own, those of the others, in order."""
    n, source = len(recording), table.source
    relative = table.t_ns is not None and int(table.t_ns[0]) < RELATIVE_NS
    if table.t_ns is None or (relative and _elsewhen(recording, table.t_ns)):
        if len(table) != n:
            raise ImportDriveError(
                f"{source}: {len(table)} poses without times of day for {n} scans: one each is needed"
            )
        return _noted(recording, f"{source}: poses without times of day, one for each scan in order"), recording.t_ns
    if not recording.timed and len(table) == n:
        note = f"{source}: the scans have no times: those of the poses, in order"
        return _noted(_retimed(recording, table.t_ns), note), table.t_ns
    if _elsewhen(recording, table.t_ns):
        raise ImportDriveError(
            f"{source}: {len(table)} poses from {table.t_ns[0] * 1e-9:.3f} to {table.t_ns[-1] * 1e-9:.3f} s, scans from"
            f" {recording.t_ns[0] * 1e-9:.3f} to {recording.t_ns[-1] * 1e-9:.3f} s: {_apart(recording, table.t_ns)}"
        )
    return recording, table.t_ns


def _noted(recording: Recording, note: str) -> Recording:
    return replace(recording, notes=(*recording.notes, note))


def _retimed(recording: Recording, t_ns: I64) -> Recording:
    def read(number: int) -> RawScan:
        scan = recording.read(number)
        return RawScan(int(t_ns[number]), scan.points_m, scan.t_offset_ns, scan.ring)

    return replace(recording, t_ns=t_ns, read=read, timed=True)


def _elsewhen(recording: Recording, t_ns: I64) -> bool:
    return bool(t_ns[0] > recording.t_ns[-1] + TOLERANCE_NS or t_ns[-1] < recording.t_ns[0] - TOLERANCE_NS)


def _apart(recording: Recording, t_ns: I64) -> str:
    """How far the clocks are apart, and what that may come from."""
    seconds = float((recording.t_ns[0] - t_ns[0]) * 1e-9)
    days = seconds / 86_400.0
    if abs(days) < 2.0:
        return f"{seconds:+.1f} s apart: GPS time is 18 s ahead of UTC, a time zone whole hours"
    if 3600.0 < abs(days) < 3700.0:
        return "about ten years apart: seconds of GPS time count from 1980, not 1970"
    return f"{days:+.1f} days apart: other drives, or times that count from another day"


def _with_fixes(recording: Recording, table: PoseTable, p_ecef: F64) -> Recording:
    """Positions as fixes; the track stays what it was."""
    if table.t_ns is None:
        raise ImportDriveError(f"{table.source}: positions without rotations need times")
    if _elsewhen(recording, table.t_ns):
        raise ImportDriveError(f"{table.source}: at no time of the scans: {_apart(recording, table.t_ns)}")
    lat, lon, height = geodetic_from_ecef(p_ecef)
    sigma = np.full(len(table), GNSS_SIGMA_M) if table.sigma_m is None else np.maximum(table.sigma_m, 1e-3)
    rows = zip(table.t_ns, lat, lon, height, sigma, strict=True)
    fixes = tuple(GnssFix(int(t), *map(float, row)) for t, *row in rows)
    detail = f"{table.coordinates}, sigma {np.median(sigma):.2f} m"
    entry = Entry(table.source, "positions", len(fixes), detail, "fixes")
    return replace(recording, gnss=fixes, entries=(*recording.entries, entry))


def _with_track(recording: Recording, table: PoseTable, track: Trajectory, whose: str) -> Recording:
    """The recording with this track, without the scans that have no pose; they are named."""
    gaps = gaps_of(track.t_ns)
    posed = has_pose(recording.t_ns, track.t_ns, gaps)
    n = int(posed.sum())
    if n < 2:
        raise ImportDriveError(f"{table.source}: {n} of {len(recording)} scans have a pose; at least 2 are needed")
    notes = [_gap_note(table, track.t_ns, k, recording.t_ns) for k in gaps]
    if n < len(recording):
        notes.append(f"{len(recording) - n} of {len(recording)} scans without a pose: left out")
    entry = Entry(table.source, "poses", len(table), f"{table.coordinates}, of the {whose}", "track")
    kept = np.flatnonzero(posed)
    return replace(
        recording,
        t_ns=recording.t_ns[kept],
        read=_chosen(recording.read, kept),
        track=track,
        posed=n / len(recording),
        notes=(*recording.notes, *notes),
        entries=(*recording.entries, entry),
    )


def _chosen(read: Callable[[int], RawScan | Scan], kept: I64) -> Callable[[int], RawScan | Scan]:
    return lambda number: read(int(kept[number]))


def gaps_of(t_ns: I64) -> I64:
    """Numbers of the poses after which there is a gap."""
    step = np.diff(t_ns)
    return np.flatnonzero(step > max(GAP_NS, GAP_STEPS * float(np.median(step)) if len(step) else 0.0))


def has_pose(scan_ns: I64, pose_ns: I64, gaps: I64) -> NDArray[np.bool_]:
    """(N,) whether a scan lies between poses, or near to the first or last of them, and in no gap."""
    within = (scan_ns >= pose_ns[0] - TOLERANCE_NS // 2) & (scan_ns <= pose_ns[-1] + TOLERANCE_NS // 2)
    for k in gaps:
        within &= ~((scan_ns > pose_ns[k]) & (scan_ns < pose_ns[k + 1]))
    return np.asarray(within)


def _gap_note(table: PoseTable, pose_ns: I64, k: int, scan_ns: I64) -> str:
    inside = int(((scan_ns > pose_ns[k]) & (scan_ns < pose_ns[k + 1])).sum())
    seconds, after = (pose_ns[k + 1] - pose_ns[k]) * 1e-9, (pose_ns[k] - scan_ns[0]) * 1e-9
    return f"{table.source}: gap of {seconds:.1f} s {after:.1f} s after the first scan, {inside} scans in it"
