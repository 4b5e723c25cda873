"""A recorded drive with objects in it that were not there: exact truth in the noise of a real sensor."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import SimError
from gnd.fleet_sim.insert import Inserter
from gnd.fleet_sim.shapes import Shape
from gnd.gnd_map.motion import Trajectory
from gnd.schemas.drive import DriveHeader, DriveItem, Scan
from gnd.schemas.drive_mcap import DriveWriter, load_track, read_drive, read_header

_STEP_NS = 1_000_000
"""Poses within a sweep are taken this often: at 30 m/s the sensor moves 3 cm meanwhile."""

_MANY = 10**9
"""More scans than a drive can have: `slice` then works like on a list of scans."""


@dataclass(frozen=True, slots=True, eq=False)
class Rewritten:
    """What became of a drive.

    Attributes:
        scans: scans written.
        on_object_m: float64 (M, 3), the points that now lie on an object, in the frame of the reference poses: which
            voxels the sensor has measured on it is exact truth.
    """

    scans: int
    on_object_m: NDArray[np.float64] = field(repr=False)

    @property
    def moved(self) -> int:
        """Points that now lie on an object."""
        return len(self.on_object_m)


def rewrite_drive(
    source: Path,
    target: Path,
    shapes: Sequence[Shape] = (),
    scans: slice = slice(None),
    range_sigma_m: float = 0.02,
    seed: int = 0,
) -> Rewritten:
    """Write a part of a drive, with objects inserted ray-accurately into its scans.

    Args:
        source: a drive with reference poses.
        target: the drive to write.
        shapes: the objects, in the frame of the drive's reference poses (ENU at its anchor).
        scans: which scans to keep, by number; everything else is kept whole.
        range_sigma_m: range noise of the points that are moved onto an object.
        seed: of that noise.

    Returns:
        How many scans were written and how many points were moved.

    Raises:
        DriveError: the source is damaged, or the target cannot be written.
        SimError: the source has no reference poses to place the objects with.
    """
    header, reference = read_header(source), load_track(source)[2]
    if shapes and len(reference.t_ns) < 2:
        raise SimError(f"{source} has {len(reference.t_ns)} reference poses: objects cannot be placed without poses")
    chosen = range(_MANY)[scans]
    painter = _Painter(header, shapes, reference.t_ns, reference.T_map_vehicle, range_sigma_m, seed) if shapes else None
    written, on_object = 0, [np.empty((0, 3))]
    with DriveWriter(target, header) as writer:
        for number, item in _numbered(source):
            if not isinstance(item, Scan):
                writer.add(item)
            elif number in chosen:
                scan, points_m = painter.paint(item) if painter else (item, on_object[0])
                writer.add(scan)
                on_object.append(points_m)
                written += 1
    return Rewritten(written, np.concatenate(on_object))


def _numbered(source: Path) -> Iterator[tuple[int, DriveItem]]:
    number = -1
    for item in read_drive(source):
        number += isinstance(item, Scan)
        yield number, item


class _Painter:
    """Puts objects into the scans of one drive."""

    def __init__(
        self,
        header: DriveHeader,
        shapes: Sequence[Shape],
        t_ns: NDArray[np.int64],
        T_map_vehicle: NDArray[np.float64],
        range_sigma_m: float,
        seed: int,
    ) -> None:
        self._track = Trajectory(t_ns, T_map_vehicle)
        self._T_vehicle_lidar, self._sigma_m = header.T_vehicle_lidar, range_sigma_m
        self._inserter, self._rng = Inserter(shapes), np.random.default_rng(seed)

    def paint(self, scan: Scan) -> tuple[Scan, NDArray[np.float64]]:
        """Return the scan with the objects in it, and the points (M, 3) that now lie on them, map frame."""
        step, at = np.unique(scan.t_offset_ns // _STEP_NS, return_inverse=True)
        last = int(self._track.t_ns[-1])
        t_ns = np.minimum(scan.t_ns + step.astype(np.int64) * _STEP_NS, last)
        T_map_lidar = (self._track.at(t_ns) @ self._T_vehicle_lidar)[at]
        inserted = self._inserter.insert(scan.points_m, T_map_lidar, self._rng, self._sigma_m)
        T, points_m = T_map_lidar[inserted.hit], inserted.points_lidar_m[inserted.hit]
        on_object_m = np.einsum("nij,nj->ni", T[:, :3, :3], points_m) + T[:, :3, 3]
        return replace(scan, points_m=inserted.points_lidar_m), on_object_m
