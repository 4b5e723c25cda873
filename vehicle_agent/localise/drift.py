"""What wheels and gyro are wrong by all along a stretch, as the submap matches on it tell: robust straight lines.

Where a match is wrong, it is wrong by much and for some metres; what the odometry is wrong by, grows with way and time.
Hence the median of the slopes between all pairs of matches that are far enough apart (Theil and Sen).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd_map.se3 import T_inverse
from vehicle_agent.localise.graph import MapMatch

F64 = NDArray[np.float64]

MIN_MATCHES = 6
APART = 0.25  # of the whole span, at least, between two matches that give a slope
MAD = 1.4826  # one sigma of normal noise, in medians of its absolute value


class Slope(NamedTuple):
    """Growth of an error and one sigma of it."""

    value: float
    sigma: float


@dataclass(frozen=True, slots=True)
class Drift:
    """What the odometry adds: heading [rad/s]; forward, left and up [m per metre forward]."""

    yaw_radps: Slope
    forward: Slope
    left: Slope
    up: Slope


def drift_of(t_ns: Sequence[int], steps: Sequence[F64], matches: Sequence[MapMatch | None]) -> Drift | None:
    """The drift along N anchors; None when fewer than `MIN_MATCHES` have a match.

    Args:
        t_ns: (N) times.
        steps: (N - 1) motions (4, 4) between them by odometry.
        matches: (N) where the map says that they are.
    """
    known = [n for n, match in enumerate(matches) if match is not None]
    if len(known) < MIN_MATCHES:
        return None
    off, way = [np.zeros(4)], [0.0]
    for a, b in pairwise(known):
        driven = reduce(np.matmul, steps[a:b])
        first, last = matches[a], matches[b]
        assert first is not None
        assert last is not None
        more = T_inverse(T_inverse(first.T_map_vehicle) @ last.T_map_vehicle) @ driven
        off.append(off[-1] + [np.arctan2(more[1, 0], more[0, 0]), *more[:3, 3]])
        way.append(way[-1] + driven[0, 3])
    errors, time_s = np.array(off), (np.array([t_ns[n] for n in known]) - t_ns[known[0]]) * 1e-9
    yaw = slope(time_s, errors[:, 0])
    forward, left, up = (slope(np.array(way), errors[:, axis]) for axis in (1, 2, 3))
    return Drift(yaw, forward, left, up)


def slope(x: F64, y: F64) -> Slope:
    """The median slope of y (N,) over ascending x (N,); 0 with an endless sigma when x spans next to nothing."""
    span = float(x[-1] - x[0])
    i, j = np.triu_indices(len(x), 1)
    apart = x[j] - x[i] >= APART * max(span, 1e-3)
    if not apart.any():
        return Slope(0.0, np.inf)
    value = float(np.median((y[j] - y[i])[apart] / (x[j] - x[i])[apart]))
    rest = y - value * x
    noise = MAD * float(np.median(np.abs(rest - np.median(rest))))
    return Slope(value, noise / span * np.sqrt(12.0 / len(x)))
