"""Measure `gnd map align` on a recorded drive: python tests/map_align/measure_recorded.py DRIVE FOLDER.

The even scans of DRIVE (MCAP, `gnd import`) are one session, the odd ones another, which is moved and built anew. Then
the first half of the way is laid onto the second half, which is another place.
"""

import sys
from pathlib import Path

import numpy as np
from measure_alignment import REACH, line, random_motion, tell, tiles_of

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import T_inverse
from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import DriveWriter, drive_counts, read_drive, read_header
from gnd.vehicle_agent.map_align.align import align_clouds
from gnd.vehicle_agent.map_align.cloud import cloud_of_tiles
from gnd.vehicle_agent.map_align.move import moved_drive


def part_of(source: Path, target: Path, numbers: range) -> Path:
    """The scans with these numbers, and everything else of the drive."""
    scan = 0
    with DriveWriter(target, read_header(source)) as writer:
        for item in read_drive(source):
            if not isinstance(item, Scan) or scan in numbers:
                writer.add(item)
            scan += isinstance(item, Scan)
    return target


def main(drive: Path, folder: Path) -> None:
    """Both halves, three motions, and the other place."""
    n = drive_counts(drive).scans
    even, odd = (part_of(drive, folder / f"half-{k}.mcap", range(k, n, 2)) for k in (0, 1))
    tiles = tiles_of(even)
    frame = LocalFrame.of_tile(tiles[len(tiles) // 2].tile_id)
    a = cloud_of_tiles(tiles, frame)
    rng = np.random.default_rng(1000)
    for k in range(3):
        T = random_motion(rng, a.mean_m.mean(axis=0))
        path = folder / f"moved-{k}.mcap"
        moved_drive(odd, path, frame, T, "moved by the measurement")
        found = align_clouds(a, cloud_of_tiles(tiles_of(path), frame), REACH)
        tell(line("odd scans, moved, built anew", found, T_inverse(T)))
    first, second = (
        cloud_of_tiles(tiles_of(part_of(drive, folder / f"way-{k}.mcap", r)), frame)
        for k, r in enumerate((range(n // 3), range(n - n // 3, n)))
    )
    away = np.eye(4)
    away[:3, 3] = first.mean_m.mean(axis=0) - second.mean_m.mean(axis=0)
    tell(line("another place of the drive", align_clouds(first, second.moved(away), REACH)))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
