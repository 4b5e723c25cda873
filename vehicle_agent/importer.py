"""Recordings into drives: read a folder, find the track of all scans, put it on the Earth, write the chosen scans.

The track is found over *all* scans before any is left out, so that the halves of a recording share one frame: what one
half maps, the other half can drive on.

Nothing is invented: a recording that does not say where on the Earth it was taken becomes no drive, unless the drive is
marked so; fixes and motion that were not measured are written only on request, and the drive says which.
"""

import re
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse, log_so3
from gnd.schemas.drive import DriveHeader, DriveItem, GnssFix, MotionSample, ReferencePose, Scan, StandIn
from gnd.schemas.drive_mcap import DriveWriter
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.apollo import open_apollo
from gnd.vehicle_agent.importers.argoverse_logs import open_argoverse
from gnd.vehicle_agent.importers.bins import open_bins
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.cleaning import MAX_RANGE_M, Cleaned, RawScan, cleaned
from gnd.vehicle_agent.importers.damage import named_damage
from gnd.vehicle_agent.importers.deskewing import with_times
from gnd.vehicle_agent.importers.detect_format import format_of
from gnd.vehicle_agent.importers.fitting import fit_heading_and_position as fit_heading_and_position
from gnd.vehicle_agent.importers.journal import ImportJournal, kept_on_interrupt, key_of
from gnd.vehicle_agent.importers.kitti import open_kitti
from gnd.vehicle_agent.importers.kitti_raw import open_kitti_raw
from gnd.vehicle_agent.importers.las import open_las
from gnd.vehicle_agent.importers.lidar_odometry import Progress, lidar_odometry
from gnd.vehicle_agent.importers.mcap_clouds import is_foxglove_or_own, open_mcap_clouds
from gnd.vehicle_agent.importers.mounting import levelled, with_mount
from gnd.vehicle_agent.importers.nuscenes import open_nuscenes
from gnd.vehicle_agent.importers.output import check_output
from gnd.vehicle_agent.importers.overrides import BadScans, as_chosen, passing_over
from gnd.vehicle_agent.importers.pcap import open_pcap
from gnd.vehicle_agent.importers.pcd import open_pcd
from gnd.vehicle_agent.importers.planes import open_planes
from gnd.vehicle_agent.importers.quality import ImportQuality, fixes_within, quality_of
from gnd.vehicle_agent.importers.radiate import open_radiate
from gnd.vehicle_agent.importers.recording import GNSS_SIGMA_M, Entry, Recording, RecordingAnchor
from gnd.vehicle_agent.importers.ros.reader import open_ros
from gnd.vehicle_agent.importers.splits import chosen_scans
from gnd.vehicle_agent.importers.suspicions import check_track, suspicious_scans

F64 = NDArray[np.float64]

FORMATS: Final[dict[str, Callable[[Path, RecordingAnchor | None], Recording]]] = {
    "kitti": open_kitti,
    "radiate": open_radiate,
    "pcd": open_pcd,
    "mcap": open_mcap_clouds,
    "planes": open_planes,
    "apollo": open_apollo,
    "ros": open_ros,
    "bin": open_bins,
    "kitti-raw": open_kitti_raw,
    "nuscenes": open_nuscenes,
    "argoverse": open_argoverse,
    "las": open_las,
    "pcap": open_pcap,
}
CHOOSING: Final[dict[str, Callable[[Path, RecordingAnchor | None, Choices | None], Recording]]] = {
    "ros": open_ros,
    "pcd": open_pcd,
    "nuscenes": open_nuscenes,
    "argoverse": open_argoverse,
    "las": open_las,
    "pcap": open_pcap,
}
"""Formats whose readers heed choices themselves: topics, fields."""
AUTO: Final = "auto"
AROUND_NS = 300_000_000  # motion and fixes kept before the first and after the last chosen scan
DEFAULTS: Final = Choices()
LEAST_SURE_HEADING_DEG: Final = 5.0
"""A heading that the fixes tell less surely is a warning: 9 m beside the track after 100 m."""


@dataclass(frozen=True, slots=True)
class Imported:
    """What became of a recording.

    scans: written. empty_scans: left out, because no point of them was left. points_not_finite, points_too_far: left
    out of scans that were written or empty. notes: what else had to be put right. bad: files that could not be read
    and were passed over, with the reason. quality: what a mapper wants to know.
    """

    scans: int
    empty_scans: int
    points_not_finite: int
    points_too_far: int
    notes: tuple[str, ...] = ()
    bad: tuple[str, ...] = ()
    quality: ImportQuality | None = None

    @property
    def skipped(self) -> tuple[str, ...]:
        """One sentence for each thing that was left out or put right."""
        counts = (
            (self.empty_scans, "scans without a usable point: left out"),
            (self.points_not_finite, "points that are no numbers: left out"),
            (self.points_too_far, f"points beyond {MAX_RANGE_M:.0f} m: left out"),
        )
        passed = (f"passed over: {reason}" for reason in self.bad)
        return (*self.notes, *passed, *(f"{n} {what}" for n, what in counts if n))


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
    choices: Choices = DEFAULTS,
    progress: Progress = no_progress,
) -> Imported:
    """Write the drive `out` (MCAP) from a recording; return what was written and what was left out.

    Args:
        kind: one of `FORMATS`, or "auto" to find out.
        folder: of the recording (or its file); see the readers for what it must hold.
        out: file to write.
        scans: which scans; see `chosen_scans`.
        anchor: place on the Earth; see the readers for what it means and whether it may be left out.
        vehicle: pseudonym written into the drive.
        topic: of the clouds in a bag that has several.
        choices: all other decisions; `anchor` and `topic` come before what it says of them.
        progress: called with a step's name, how much is done, and of how much.

    Raises:
        ImportDriveError: the folder is missing, holds no scans of that format, is damaged, or does not say where on
            the Earth it was recorded; or `out` is one of the files that are read, or another process writes it.
        DriveError: the drive cannot be written.
    """
    choices = replace(choices, anchor=anchor or choices.anchor, topic=topic or choices.topic)
    inputs = (folder, *choices.files)
    check_output(out, *inputs)
    recording = open_recording(kind, folder, choices.anchor, choices.topic, choices)
    with kept_on_interrupt(ImportJournal(out, key_of(kind, inputs, choices))) as journal:
        return import_opened(
            recording, out, scans=scans, vehicle=vehicle, choices=choices, progress=progress, journal=journal
        )


def import_opened(
    recording: Recording,
    out: Path,
    *,
    scans: str = "all",
    vehicle: str = "recorded",
    choices: Choices = DEFAULTS,
    progress: Progress = no_progress,
    journal: ImportJournal | None = None,
) -> Imported:
    """The same with a recording that is open already; whoever calls has looked that `out` is none of its files.

    journal: of an import of these files to `out`; without one an interrupted import begins anew.
    """
    chosen_scans(scans, len(recording))  # a wrong rule is named before the long work
    if not (recording.placed or choices.nowhere):
        raise ImportDriveError(
            f"{recording.name}: nothing says where on the Earth it was recorded: give --anchor LAT,LON,HEIGHT, or"
            " --poses with geodetic, UTM or ECEF coordinates or a GNSS track; --nowhere makes a drive that no shared"
            " map takes"
        )
    bad = BadScans()
    if not choices.strict:
        recording = passing_over(recording, bad)
    recording = replace(recording, notes=(*recording.notes, *_made_up_times(recording), *suspicious_scans(recording)))
    recording, track = prepared(recording, progress, journal)
    recording = replace(recording, notes=(*recording.notes, *check_track(recording, track)))
    imported = write_drive(recording, track, out, scans, vehicle, progress, stand_ins=choices.stand_ins)
    return replace(imported, bad=bad.reasons, quality=quality_of(recording, track))


def _made_up_times(recording: Recording) -> tuple[str, ...]:
    """What a drive's times are where the recording has none."""
    if recording.timed:
        return ()
    rate_hz = (len(recording) - 1) / float((recording.t_ns[-1] - recording.t_ns[0]) * 1e-9)
    return (f"no times of scans: taken as {rate_hz:.2f} Hz from a made-up day (--poses with times gives them)",)


def open_recording(
    kind: str,
    folder: Path,
    anchor: RecordingAnchor | None = None,
    topic: str | None = None,
    choices: Choices = DEFAULTS,
) -> Recording:
    """A recording of a known format, or of the one that it is found to be of; ImportDriveError when it is none."""
    if kind not in (*FORMATS, AUTO):
        raise ImportDriveError(f"format {kind!r} is not known; known are {', '.join(FORMATS)} and {AUTO}")
    with named_damage(folder):
        return _opened(kind, folder, anchor, topic, choices)


def _read_named(read: Callable[[int], RawScan | Scan], folder: Path, number: int) -> RawScan | Scan:
    with named_damage(folder):
        return read(number)


def _opened(kind: str, folder: Path, anchor: RecordingAnchor | None, topic: str | None, choices: Choices) -> Recording:
    found = format_of(folder) if kind == AUTO else kind
    choices = replace(choices, anchor=anchor or choices.anchor, topic=topic or choices.topic)
    if found == "mcap" and is_foxglove_or_own(folder):
        recording = open_mcap_clouds(folder, choices.anchor, choices.topic)
    elif found in CHOOSING or found == "mcap":
        recording = CHOOSING.get(found, open_ros)(folder, choices.anchor, choices)
    else:
        recording = FORMATS[found](folder, choices.anchor)
    recording = replace(recording, read=partial(_read_named, recording.read, folder))
    return as_chosen(_with_entries(recording, found, folder), folder, choices)


def _with_entries(recording: Recording, found: str, folder: Path) -> Recording:
    """The recording with a list of what it holds, where its reader gives none."""
    if recording.entries:
        return recording
    entries = [Entry(str(folder), f"{found} scans", len(recording), recording.sensor_model, "scans")]
    held = (("fixes", recording.gnss, "place"), ("speed and yaw rate", recording.motion, "motion"))
    entries += [Entry("", kind, len(items), "", used) for kind, items, used in held if items]
    if recording.track is not None:
        entries.append(Entry("", "poses", len(recording.track), "", "track"))
    return replace(recording, entries=tuple(entries))


def write_drive(
    recording: Recording,
    track: Trajectory,
    out: Path,
    scans: str = "all",
    vehicle: str = "recorded",
    progress: Progress = no_progress,
    *,
    stand_ins: bool = False,
) -> Imported:
    """Write the chosen scans of a recording whose track (T_map_vehicle of all scans) is known.

    stand_ins: where the recording has no fixes or no motion, compute them from the track; the header says so.
    """
    chosen, read = chosen_scans(scans, len(recording)), list[Cleaned]()
    held: dict[StandIn, bool] = {"gnss": bool(recording.gnss), "motion": bool(recording.motion)}
    missing = [one for one, measured in held.items() if not measured]
    computed = tuple(missing) if stand_ins else ()
    header = _header(recording, f"{recording.name}-{scans}".replace(":", "-"), vehicle)
    with DriveWriter(out, replace(header, stand_ins=computed)) as writer:
        for item in _items(recording, track, chosen, read, computed):
            writer.add(item)
            progress("writing scans", len(read), len(chosen))
        return _imported(recording, read, _missing_notes(missing, stand_ins))


def _missing_notes(missing: list[StandIn], stand_ins: bool) -> tuple[str, ...]:
    """What the recording did not measure, and what the drive has instead."""
    if not missing:
        return ()
    what = " and no ".join({"gnss": "GNSS", "motion": "speed and yaw rate"}[one] for one in missing)
    if stand_ins:
        return (f"no {what} measured: computed from the poses and marked so: errors against them are circular",)
    return (f"no {what} measured: the drive has none (`gnd localise` and vehicles need them: --stand-ins)",)


def _imported(recording: Recording, read: list[Cleaned], notes: tuple[str, ...]) -> Imported:
    empty = sum(one.scan is None for one in read)
    if empty == len(read):
        raise ImportDriveError(f"{recording.name}: none of {len(read)} scans has a usable point")
    lost = sum(one.not_finite for one in read), sum(one.far for one in read)
    return Imported(len(read) - empty, empty, *lost, notes=(*recording.notes, *notes))


def _header(recording: Recording, drive_id: str, vehicle: str) -> DriveHeader:
    return DriveHeader(
        drive_id=drive_id_of(drive_id),
        vehicle=vehicle,
        sensor_model=recording.sensor_model,
        anchor=recording.anchor.frame,
        T_vehicle_lidar=recording.T_vehicle_lidar,
        source=recording.source,
        deskew=recording.deskew,
        sweep_ns=recording.sweep_ns,
        mount=recording.mount,
        mount_sigma=recording.mount_sigma,
        nowhere=not recording.placed,
    )


def drive_id_of(name: str) -> str:
    """A name that a drive may have: letters, digits, dots, dashes; its end, where it is too long."""
    return re.sub(r"[^A-Za-z0-9._-]", "_", name)[-64:] or "drive"


def prepared(
    recording: Recording, progress: Progress = no_progress, journal: ImportJournal | None = None
) -> tuple[Recording, Trajectory]:
    """A recording with times of points and a mount, found where it gives none, and T_map_vehicle of every scan.

    Raises:
        ImportDriveError: scans that do not fit each other.
    """
    recording = _with_times(levelled(recording))
    if recording.track is not None:
        recording, track = with_mount(recording, recording.track)
        return replace(recording, track=track), track
    recording, track = with_mount(recording, lidar_odometry(recording, progress, journal))
    track = Trajectory(track.t_ns, T_inverse(track.T_dst_vehicle[0]) @ track.T_dst_vehicle)
    laid = _over_the_fixes(recording, track)
    return replace(recording, notes=(*recording.notes, *_heading_note(recording, laid))), laid


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
    """Heading and position that lay the track over the fixes, least squares; the anchor's where fixes do not tell."""
    start = recording.anchor.T_map_start
    within = fixes_within(recording, track)
    if len(within) < 2:
        return start
    p_map = recording.anchor.frame.enu_from_geodetic(*np.array([(f.lat_rad, f.lon_rad, f.height_m) for f in within]).T)
    T = track.at(np.array([fix.t_ns for fix in within], np.int64))
    antenna = T[:, :3, 3] + T[:, :3, :3] @ np.array(recording.lever_m)
    if recording.anchor.heading_deg is None:
        return fit_heading_and_position(antenna, p_map)
    start[:3, 3] = (p_map - antenna @ start[:3, :3].T).mean(axis=0)
    return start


def _heading_note(recording: Recording, track: Trajectory) -> tuple[str, ...]:
    """A warning where the fixes do not tell the heading: the vehicle hardly moved against what they are off."""
    within = fixes_within(recording, track)
    if recording.anchor.heading_deg is not None:
        return ()
    if len(within) < 2:
        return ("heading not known: the first pose looks east (--anchor LAT,LON,HEIGHT,HEADING gives it)",)
    p = track.at(np.array([fix.t_ns for fix in within], np.int64))[:, :2, 3]
    spread_m = float(np.sqrt(((p - p.mean(axis=0)) ** 2).sum()))
    sigma_deg = float(np.degrees(np.median([fix.sigma_m for fix in within]) / max(spread_m, 1e-9)))
    if sigma_deg <= LEAST_SURE_HEADING_DEG:
        return ()
    return (
        f"warning: heading known to {min(sigma_deg, 180.0):.0f}° only: the {len(within)} fixes lie too close to each"
        " other for what they are off (--anchor LAT,LON,HEIGHT,HEADING gives it)",
    )


def _items(
    recording: Recording,
    track: Trajectory,
    chosen: NDArray[np.int64],
    read: list[Cleaned],
    computed: tuple[StandIn, ...],
) -> Iterator[DriveItem]:
    """Everything of the drive, the small things of its span first; what was read is noted in `read`."""
    first, last = int(recording.t_ns[chosen[0]]) - AROUND_NS, int(recording.t_ns[chosen[-1]]) + AROUND_NS
    small: list[MotionSample | GnssFix | ReferencePose] = [*recording.motion, *recording.gnss]
    small += motion_of(track) if "motion" in computed else []
    small += fixes_of(recording, track) if "gnss" in computed else []
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
    """The track's positions as fixes of `GNSS_SIGMA_M`, for recordings without any: stand-ins."""
    lat, lon, height = recording.anchor.frame.geodetic_from_enu(track.T_dst_vehicle[:, :3, 3])
    return [
        GnssFix(int(t), float(a), float(o), float(h), GNSS_SIGMA_M)
        for t, a, o, h in zip(track.t_ns, lat, lon, height, strict=True)
    ]
