"""A recording as its reader gives it, with what somebody decided instead, and without the scans that cannot be read."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from gnd.gnd_map.errors import GndError
from gnd.schemas.drive import Scan
from gnd.vehicle_agent.importers.attached_poses import with_poses
from gnd.vehicle_agent.importers.choices import METRES_OF, Choices
from gnd.vehicle_agent.importers.cleaning import RawScan
from gnd.vehicle_agent.importers.mounting import moved
from gnd.vehicle_agent.importers.ouster.capture import metadata_named
from gnd.vehicle_agent.importers.recording import Recording


def as_chosen(recording: Recording, folder: Path, choices: Choices) -> Recording:
    """The recording with another unit, sensor, mount or track than its reader found."""
    if choices.unit != "m":
        recording = _scaled(recording, METRES_OF[choices.unit])
    if choices.sensor is not None and metadata_named(choices) is None:
        recording = replace(recording, sensor_model=choices.sensor)
    if choices.mount is not None:
        recording = _mounted(recording, choices)
    return recording if choices.poses is None else with_poses(recording, folder, choices)


def _scaled(recording: Recording, metres: float) -> Recording:
    def read(number: int) -> RawScan:
        scan = recording.read(number)
        return RawScan(scan.t_ns, (scan.points_m * np.float64(metres)).astype(np.float32), scan.t_offset_ns, scan.ring)

    return replace(recording, read=read)


def _mounted(recording: Recording, choices: Choices) -> Recording:
    """With the mount that was chosen; poses of a LiDAR without a mount stay where the LiDAR was."""
    assert choices.mount is not None
    track = recording.track
    if track is not None and recording.mount == "assumed":
        track = moved(track, recording.T_vehicle_lidar, choices.mount)
    return replace(recording, T_vehicle_lidar=choices.mount, mount="given", mount_sigma=None, track=track)


@dataclass
class BadScans:
    """Scans that could not be read: number and reason."""

    found: dict[int, str] = field(default_factory=dict)

    @property
    def reasons(self) -> tuple[str, ...]:
        """In the order of the scans."""
        return tuple(self.found[number] for number in sorted(self.found))


def passing_over(recording: Recording, bad: BadScans) -> Recording:
    """The recording whose damaged scans have no points; what is wrong with them is noted in `bad`."""

    def read(number: int) -> RawScan | Scan:
        if number not in bad.found:
            try:
                return recording.read(number)
            except GndError as error:
                bad.found[number] = str(error)
        return RawScan(int(recording.t_ns[number]), np.zeros((0, 3), np.float32), np.zeros(0, np.uint32))

    return replace(recording, read=read)
