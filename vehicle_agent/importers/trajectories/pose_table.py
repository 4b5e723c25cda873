"""Poses or positions as a file holds them: in its own frame, at its own times."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.damage import MAX_NUMBER

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

Coordinates = Literal["local", "utm", "ecef", "geodetic"]
"""What positions are: x, y, z of a level frame; easting, northing, ellipsoidal height; earth-centred x, y, z; latitude,
longitude in radians, ellipsoidal height. Rotations are against the same axes: the frame's, the grid's east, north and
up, earth-centred, east-north-up at the place."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseTable:
    """N poses of a body (x forward, y left, z up) or, where `R` is None, positions.

    source: format and file. t_ns: (N,) UTC; None: none, a pose for each scan. p: (N, 3). R: (N, 3, 3). sigma_m: (N,)
    standard deviation of positions along the ground, where the file gives it. camera: the body's axes are a camera's
    (x right, y down, z forward), and so are those of the frame. notes: what had to be decided, a sentence each.
    """

    source: str
    t_ns: I64 | None
    p: F64
    R: F64 | None
    coordinates: Coordinates
    sigma_m: F64 | None = None
    camera: bool = False
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.p) < 2:
            raise ImportDriveError(f"{self.source}: {len(self.p)} poses; at least 2 are needed")
        if not (np.abs(self.p) <= MAX_NUMBER).all() or (self.R is not None and not np.isfinite(self.R).all()):
            raise ImportDriveError(f"{self.source}: a position or rotation is not finite, or beyond {MAX_NUMBER:g} m")
        if self.t_ns is None:
            return
        late = np.flatnonzero(np.diff(self.t_ns) <= 0)
        if len(late):
            k = int(late[0])
            what = "has the time of" if self.t_ns[k + 1] == self.t_ns[k] else "is earlier than"
            raise ImportDriveError(f"{self.source}: pose {k + 2} of {len(self.t_ns)} {what} the one before it")

    def __len__(self) -> int:
        return len(self.p)
