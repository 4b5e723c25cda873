"""Whether the points of a scan lie in the order in which they were fired, and the times that follow from it."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

BLOCKS: Final = 180
TURN: Final = (0.8, 1.1)
"""Turns that a sweep in firing order makes from its first points to its last; files ring by ring make one a ring."""
BACKWARDS: Final = 0.05
"""Share of the blocks that may go against the others: few points, or a wall seen by some lasers only."""


def firing_share(points_lidar_m: NDArray[np.generic]) -> F64 | None:
    """(N,) share of the sweep, 0 ... 1, at which each point (N, 3) was fired; None when the order is another.

    Lasers of a head look past its azimuth to both sides, so azimuths jump from point to point; means over blocks of
    points follow the head. The sweep's length is taken to be a turn.
    """
    azimuth = np.arctan2(points_lidar_m[:, 1].astype(np.float64), points_lidar_m[:, 0].astype(np.float64))
    if len(azimuth) < 10 * BLOCKS:
        return None
    edges = np.linspace(0, len(azimuth), BLOCKS + 1).astype(np.int64)
    pointer = np.add.reduceat(np.exp(1j * azimuth), edges[:-1]) / np.diff(edges)
    if np.abs(pointer).min() < 0.5:  # points of a block look all ways: no firing order
        return None
    head = np.unwrap(np.angle(pointer))
    steps = np.diff(head)
    turns = abs(head[-1] - head[0]) / (2.0 * np.pi) * BLOCKS / (BLOCKS - 1)
    against = float((np.sign(steps) != np.sign(head[-1] - head[0])).mean())
    if not TURN[0] <= turns <= TURN[1] or against > BACKWARDS:
        return None
    turned = np.maximum.accumulate(np.abs(head - head[0]))
    ends = turned[0] - 0.5 * (turned[1] - turned[0]), turned[-1] + 0.5 * (turned[-1] - turned[-2])
    at = np.concatenate([[0], 0.5 * (edges[:-1] + edges[1:]), [len(azimuth) - 1]])
    turned = np.interp(np.arange(len(azimuth)), at, np.concatenate([ends[:1], turned, ends[1:]])) - ends[0]
    return np.asarray(np.clip(turned / (2.0 * np.pi), 0.0, 1.0))
