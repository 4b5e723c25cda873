"""Measurements on their way from the simulator to the vehicle."""

from collections.abc import Iterable, Iterator
from pathlib import Path

from gnd.schemas.drive import DriveHeader, DriveItem, GnssFix, ReferencePose, Scan
from gnd.schemas.drive_mcap import DriveWriter
from gnd.schemas.drive_messages import fix_of, gnss_of, pose_message_of, reference_of
from studies.frame.pool import Tick


def ticking(items: Iterable[DriveItem], tick: Tick, scans: int) -> Iterator[DriveItem]:
    """Pass items on; tell `tick` about every scan that has been worked on."""
    done = 0
    for item in items:
        yield item
        if isinstance(item, Scan):
            done += 1
            tick(done, scans)


def as_recorded(item: DriveItem) -> DriveItem:
    """Return a measurement as a recording gives it back: positions in degrees and poses by quaternion round a bit."""
    if isinstance(item, GnssFix):
        return gnss_of(fix_of(item))
    return reference_of(pose_message_of(item)) if isinstance(item, ReferencePose) else item


def recorded(items: Iterable[DriveItem], header: DriveHeader, path: Path) -> Iterator[DriveItem]:
    """Pass items on and write them to an MCAP file, which appears when all have passed."""
    with DriveWriter(path, header) as writer:
        for item in items:
            writer.add(item)
            yield item
