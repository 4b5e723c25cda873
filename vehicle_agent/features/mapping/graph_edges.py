"""What the graph of a drive is made of: its edges as columns (Kim et al. 2018, Eq. 1-9), and its nodes' values."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.vehicle_agent.features.mapping.dead_reckoning import Steps


class FixNodes(NamedTuple):
    """Fixes put together at keyframes, G of them."""

    key: I64
    """(G,) keyframe, increasing."""
    t_s: F64
    """(G,)"""
    xy_m: F64
    """(G, 2) map frame."""
    variance_m2: F64
    """(G,) of an axis, without the slow error."""


class Ties(NamedTuple):
    """Measurements of one feature put together at a keyframe, T of them."""

    key: I64
    """(T,) keyframe."""
    landmark: I64
    """(T,)"""
    polar: F64
    """(T, 2): bearing [rad] and range [m] from the keyframe."""
    cov: F64
    """(T, 2, 2) of bearing and range."""


class PoseMatches(NamedTuple):
    """Poses of keyframes by lanes (Eq. 8)."""

    key: I64
    """(P,)"""
    pose: F64
    """(P, 3) near which they hold."""
    off: F64
    """(P, 3) that the keyframe is off from `pose`, in its frame (x ahead, y left, yaw; the logarithm)."""
    information: F64
    """(P, 3, 3) of `off`; may be singular: a direction is then not constrained."""


class GraphAnchors(NamedTuple):
    """Features whose places are known: A of them."""

    landmark: I64
    """(A,)"""
    xy_m: F64
    """(A, 2)"""
    cov: F64
    """(A, 2, 2)"""


NO_FIX_NODES = FixNodes(np.empty(0, np.int64), np.empty(0), np.empty((0, 2)), np.empty(0))
NO_TIES = Ties(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2, 2)))
NO_MATCHES = PoseMatches(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3, 3)))
NO_ANCHORS = GraphAnchors(np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2, 2)))


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """All edges of a drive.

    calibration: (2,) wheel scale and gyro bias that `steps` were made with. held: (2,) variances of the errors of range
    (share) and bearing [rad] that stay with a feature, of which its sensor states nothing; 0: there are none.
    """

    steps: Steps
    calibration: F64
    fixes: FixNodes = NO_FIX_NODES
    ties: Ties = NO_TIES
    lanes: PoseMatches = NO_MATCHES
    anchors: GraphAnchors = NO_ANCHORS
    held: F64 = field(default_factory=lambda: np.zeros(2))


class State(NamedTuple):
    """Estimates of all nodes but the GNSS's errors."""

    pose: F64
    """(K, 3)"""
    xy_m: F64
    """(N, 2) features."""
    calibration: F64
    """(2,) wheel scale and gyro bias [rad/s]."""
    errors: F64 = np.empty((0, 2))
    """(N, 2) errors of range (share) and bearing [rad] that stay with a feature; empty where none are expected."""
