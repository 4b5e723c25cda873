"""A recorded drive with a van ahead that was not there: what moves along, in the noise of a real sensor."""

from dataclasses import dataclass, replace
from math import pi, sin
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.errors import SimError
from gnd.fleet_sim.insert import Inserter
from gnd.fleet_sim.shapes import Block
from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import DriveWriter, read_drive, read_header

_LENGTH_M: Final = 5.6
_WIDTH_M: Final = 2.0
_BOTTOM_M, _TOP_M = 0.35, 2.55
_NS: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class VanAhead:
    """A van 5.6 m long, 2 m wide, of 2.2 m from bottom to roof, in the lane of the vehicle.

    Attributes:
        rear_m: its rear face, ahead of the vehicle's origin.
        swing_m: by so much the distance swings, to either side.
        period_s: once in so long.
        left_m: its middle, to the left of the vehicle's.
    """

    rear_m: float = 13.0
    swing_m: float = 0.0
    period_s: float = 9.0
    left_m: float = 0.0

    def __post_init__(self) -> None:
        if not self.rear_m - abs(self.swing_m) >= 4.0 or not self.period_s > 0.0:
            raise SimError(
                f"a van's rear comes as near as {self.rear_m - abs(self.swing_m)} m, at least 4 m are needed"
            )

    def block(self, t_s: float) -> Block:
        """Return its box in the vehicle frame at a time [s]."""
        rear_m = self.rear_m + self.swing_m * sin(2.0 * pi * t_s / self.period_s)
        return Block(
            rear_m + 0.5 * _LENGTH_M, self.left_m, 0.5 * _LENGTH_M, 0.5 * _WIDTH_M, _BOTTOM_M, _TOP_M, reflectivity=0.5
        )


def put_behind_a_van(
    source: Path, target: Path, van: VanAhead, range_sigma_m: float = 0.02, seed: int = 0
) -> list[NDArray[np.bool_]]:
    """Write a drive with a van ahead, put ray-accurately into every scan.

    The van keeps its place in the vehicle frame during a sweep, as one that drives at the vehicle's speed does; what it
    hides is gone, and rays into the sky stay without a return.

    Args:
        source: a drive.
        target: the drive to write.
        van: where it drives.
        range_sigma_m: range noise of the points on it.
        seed: of that noise.

    Returns:
        For each scan (N,) bool: which points lie on the van.

    Raises:
        DriveError: the source is damaged, or the target cannot be written.
    """
    header, rng, on_van, first_ns = read_header(source), np.random.default_rng([seed, 0xA4]), [], None
    with DriveWriter(target, header) as writer:
        for item in read_drive(source):
            if not isinstance(item, Scan):
                writer.add(item)
                continue
            first_ns = item.t_ns if first_ns is None else first_ns
            inserter = Inserter([van.block((item.t_ns - first_ns) / _NS)])
            found = inserter.insert(item.points_m, header.T_vehicle_lidar, rng, range_sigma_m)
            writer.add(replace(item, points_m=found.points_lidar_m))
            on_van.append(found.hit)
    return on_van
