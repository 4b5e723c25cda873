"""The folders of the tutorials: KITTI's drive 0027 as KITTI packs it, and as bags of ROS 2 of two days."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from gnd.deploy.next_commands import BOXES
from gnd.deploy.play import messages_of
from gnd.fleet_sim.made_up import bare_places, write_with_boxes
from gnd.vehicle_agent.importer import import_recording, open_recording
from gnd.vehicle_agent.importers.planes import KITTI_INS_HEIGHT_M

SCANS = 32
NAME = "2011_09_26_drive_0027_sync"
ACCURACY_M = 0.1
TYPES = get_typestore(Stores.ROS2_JAZZY)


def kitti_folder(shared_data: Path, parent: Path) -> Path:
    """The first scans of the drive, with the records of its INS, in the layout of the raw data.

    The reflectances are not in the shared copy (they are 0), the stamps of the scans are those of its reader.
    """
    recording = open_recording("auto", shared_data / "kitti_raw_0027")
    drive = parent / "2011_09_26" / NAME
    for part in ("velodyne_points", "oxts"):
        (drive / part / "data").mkdir(parents=True)
    for k in range(SCANS):
        points = recording.read(k).points_m
        rows = np.column_stack([points, np.zeros(len(points))]).astype("<f4")
        rows.tofile(drive / "velodyne_points" / "data" / f"{k:010d}.bin")
        fix, motion = recording.gnss[k], recording.motion[k]
        record = np.zeros(30)
        record[:3] = np.degrees(fix.lat_rad), np.degrees(fix.lon_rad), fix.height_m + KITTI_INS_HEIGHT_M
        record[8], record[22], record[23] = motion.speed_mps, motion.yaw_rate_radps, ACCURACY_M
        (drive / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(f"{value:.12f}" for value in record) + "\n")
    stamps = {"velodyne_points": recording.t_ns, "oxts": [fix.t_ns for fix in recording.gnss]}
    for part, t_ns in stamps.items():
        (drive / part / "timestamps.txt").write_text("".join(f"{_stamp(int(t))}\n" for t in t_ns[:SCANS]))
    return drive


def _stamp(t_ns: int) -> str:
    second, rest = divmod(t_ns, 1_000_000_000)
    return f"{datetime.fromtimestamp(second, UTC):%Y-%m-%d %H:%M:%S}.{rest:09d}"


def bag_of(drive: Path, bag: Path) -> Path:
    """A bag of ROS 2 (MCAP) with what the vehicle's drivers publish: /points, /gnss, /odometry, /tf_static."""
    with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections: dict[str, Any] = {}
        for message in messages_of(drive):
            name = message.topic.name
            if name not in connections:
                connections[name] = writer.add_connection(name, message.topic.type_name, typestore=TYPES)
            writer.write(connections[name], message.sent_ns, message.payload)
    return bag


def bags_of_two_days(shared_data: Path, folder: Path) -> None:
    """`monday` as KITTI recorded it, and `tuesday`: the same with made-up boxes in its scans."""
    drive, changed = folder / "drive.mcap", folder / "changed.mcap"
    import_recording("auto", kitti_folder(shared_data, folder), drive)
    write_with_boxes(drive, changed, bare_places(drive, BOXES))
    bag_of(drive, folder / "monday")
    bag_of(changed, folder / "tuesday")
