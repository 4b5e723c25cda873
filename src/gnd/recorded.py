"""Recorded drives: what is in one, and where on a map it went."""

import threading
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from gnd.extras import explained, need_vehicle
from gnd.map_reader import AnyTime, Map, time_ns
from gnd.schemas.drive import DriveHeader, DriveItem
from gnd.schemas.drive_mcap import DriveCounts, drive_counts, read_drive, read_header
from gnd.tile_store.values import DEFAULT_LAYER

if TYPE_CHECKING:
    from gnd.gnd_map.motion import Trajectory
    from gnd.vehicle_agent.localise.estimates import PoseEstimate
    from gnd.vehicle_agent.localise_drive.run import LocalisedDrive


class RecordedDrive:
    """A drive in one MCAP file: its header, and its items in order of time as often as it is iterated over.

    Items are `Scan`, `MotionSample`, `GnssFix`, `ReferencePose`, `Detections`, `LaneLook` of `gnd.schemas.drive`.
    `open_drive` makes one.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.header: DriveHeader = read_header(path)

    @property
    def counts(self) -> DriveCounts:
        """How many items of each kind there are, and how long it lasts; nothing else is read."""
        return drive_counts(self.path)

    def __iter__(self) -> Iterator[DriveItem]:
        return read_drive(self.path)


def open_drive(path: str | Path) -> RecordedDrive:
    """A recorded drive; `gnd import` makes one of other recordings.

    Raises:
        DriveError: no such file, or none of ours. While it is iterated over: it is damaged.
    """
    return RecordedDrive(Path(path))


def localise(
    drive: RecordedDrive | str | Path,
    map: Map | str | Path,  # noqa: A002  (what users call it)
    *,
    layer: str = DEFAULT_LAYER,
    at: AnyTime | None = None,
    progress: Callable[[int, int], None] | None = None,
    stop: threading.Event | None = None,
) -> "LocalisedDrive":
    """Localise a recorded drive on a map, as `gnd localise` does.

    Args:
        drive: the drive, or its file.
        map: the map, or its file.
        layer: a layer of Gaussians.
        at: the map as it was then; None: as it is.
        progress: called with the scans done and the scans in all.
        stop: ends it there; what was found until then is returned.

    Returns:
        `refined` and `online` poses (each with `t_ns`, `T_map_vehicle`, covariance and health; map: ENU at
        `header.anchor`), `moments` with the health of every scan, `counts`. `trajectory_of` makes arrays of poses.

    Raises:
        LocaliseError: the drive has no scan or no GNSS fix, or the map has no tiles there.
        DriveError, StoreError: one of the two cannot be read.
        MissingExtra: `gnd-fleet[vehicle]` is not installed.
    """
    need_vehicle()
    with explained():
        from gnd.vehicle_agent.localise_drive.run import localise_drive
        from gnd.vehicle_agent.localise_drive.tiles import StoreMap

    path = drive.path if isinstance(drive, RecordedDrive) else Path(drive)
    with nullcontext(map) if isinstance(map, Map) else Map(map) as opened:
        return localise_drive(path, StoreMap(opened.store, layer, time_ns(at)), progress=progress, stop=stop)


def trajectory_of(estimates: "tuple[PoseEstimate, ...]") -> "Trajectory":
    """Poses as arrays: `t_ns` (N,) int64 and `T_dst_vehicle` (N, 4, 4) float64; dst is the frame of the estimates."""
    from gnd.vehicle_agent.localise_drive.run import trajectory_of as arrays_of

    return arrays_of(estimates)
