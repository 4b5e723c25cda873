"""What wheels and gyro are wrong by all along a stretch, as the map tells."""

from dataclasses import dataclass
from typing import NamedTuple


class Slope(NamedTuple):
    """Growth of an error and one sigma of it."""

    value: float
    sigma: float


@dataclass(frozen=True, slots=True)
class PoseDrift:
    """What the odometry adds: heading [rad/s]; forward, left and up [m per metre forward]."""

    yaw_radps: Slope
    forward: Slope
    left: Slope
    up: Slope
