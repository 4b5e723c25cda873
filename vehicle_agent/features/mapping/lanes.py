"""Lane looks of a drive matched with the HD map: Eq. (7)-(9) of Kim et al. 2018.

The looks of a window of some metres are put together before they are matched, which beats their noise. The match is
generalised ICP (section 5.1) of the lanes as seen with the lanes of the map, both sampled every 0.1 m. How much it
says, and along which direction, is not a constant: it comes from how the polylines' two numbers each (offset and turn)
depend on the pose, by the lanes' geometry. Along straight lanes, and along circles, that is nothing.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple

import gtsam
import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.schemas.drive import LaneLook
from gnd.vehicle_agent.features.mapping.dead_reckoning import composed, relative, rotated
from gnd.vehicle_agent.features.mapping.drive_nodes import DriveNodes, nearest, spaced
from gnd.vehicle_agent.features.mapping.graph import pose2
from gnd.vehicle_agent.features.mapping.graph_edges import NO_MATCHES, PoseMatches
from gnd.vehicle_agent.features.mapping.lane_looks import LANE_GATE, Offsets, Polylines, choices, offsets
from gnd.vehicle_agent.features.mapping.lane_map import LaneMap, gicp

_MAP_SIGMA_M: Final = 0.01
"""Of the lines of the HD map."""
_WINDOW_M: Final = 20.0
"""Looks of so long a way are put together."""
_SEARCH_M: Final = 4.0
"""The first match tries so far to either side."""
_MAX_CORRESPONDENCE_M: Final = 1.5
"""Of GICP."""
_MIN_POLYLINES: Final = 3
"""A window of fewer polylines is not matched."""
_INFORMATION: Final = 0.75
"""The share of the information that polylines would have if it were certain which lane each is. With the paper's noise
some are taken for their neighbour; with 0.75 the squared errors of features are as large as they should be."""

__all__ = ["LaneMap", "LaneMatcher"]

TURN_AT_M = 20.0  # turns and shifts are compared at this distance
MUCH = 0.05  # share of it above which GICP corrects a direction
NOTHING = 1e-4  # share of the best direction's information below which a direction is not known
ASIDE_STEP_M = 0.25
ASIDE_SIGMA_M = 2.5  # what the first poses may be off by to either side
SMOOTH = 8  # windows before and after that search together
MARGIN_M = 5.0  # more of the map than of what is seen
SEEN_M = (5.0, 35.0)  # ahead of the vehicle: the part of lanes that GICP is given


@dataclass(frozen=True, slots=True, eq=False)
class WindowMatch:
    """Matches of the looks of W windows. key: (W,). base: (W, 3) poses they were compared at.

    off: (W, 3) that the pose is off from the base, in its frame. information: (W, 3, 3) of it, singular where lanes
    constrain nothing. strong: (W, 3, 3) projection of `off` onto what lanes constrain well.
    """

    key: I64
    base: F64
    off: F64
    information: F64
    strong: F64


class _Chosen(NamedTuple):
    """Polylines with their lanes, S of them."""

    window: I64
    lane: I64
    residual: F64
    by_pose: F64
    variance: F64


class LaneMatcher:
    """Matches the lane looks of a drive, again and again as its poses become better."""

    def __init__(self, lanes: LaneMap, looks: tuple[LaneLook, ...], nodes: DriveNodes) -> None:
        self.lanes = lanes
        self.lines = Polylines.of(looks)
        self.t_ns = np.array([look.t_ns for look in looks], np.int64)
        self.keys = spaced(nodes.sight(nodes.t_ns).way_m, _WINDOW_M)
        self.window = nearest(nodes.t_ns[self.keys], self.t_ns) if len(looks) else np.empty(0, np.int64)
        self._searched = False

    def matched(self, nodes: DriveNodes, pose: F64, *, polish: bool = False) -> PoseMatches:
        """Poses of windows by their lanes, from poses (K, 3) as believed.

        polish: by GICP; else by the linear fit that GICP starts from.
        """
        if len(self.lines) == 0:
            return NO_MATCHES
        base = pose[self.keys]
        driven = nodes.reckoning.at(nodes.t_ns[self.keys])[self.window]
        at = composed(base[self.window], relative(driven, nodes.reckoning.at(self.t_ns)))
        o = offsets(self.lines, self.lanes, at, base[self.window])
        chosen = self._chosen(o)
        found = self._fitted(chosen, base)
        rows = np.flatnonzero(np.trace(found.information, axis1=1, axis2=2) > 0.0)
        off = self._polished(found, chosen, rows) if polish else found.off
        return PoseMatches(found.key[rows], base[rows], off[rows], found.information[rows])

    def _chosen(self, o: Offsets) -> _Chosen:
        n_looks = int(self.lines.look.max()) + 1
        aside = np.zeros((n_looks, 1)) if self._searched else self._search(o, n_looks)
        self._searched = True
        column = choices(self.lines, o, aside)[0][:, 0]
        rows = np.arange(len(column))
        residual = o.residual[rows, column]
        moved = residual[:, 0] + aside[self.lines.look, 0]
        squared = np.stack([moved, residual[:, 1]], axis=1) ** 2 / self.lines.tolerance**2
        good = (column >= 0) & (squared.max(axis=1) <= LANE_GATE**2) & (o.cost[rows, column] < 1e5)
        window, lane = self.window[self.lines.look], o.lane[rows, column]
        variance = self._variance(window, lane, good)
        kept = np.flatnonzero(good)
        return _Chosen(window[kept], lane[kept], residual[kept], o.by_pose[kept, column[kept]], variance[kept])

    def _variance(self, window: I64, lane: I64, good: F64) -> F64:
        """(P, 2) of offset and turn; the map's own error does not grow less with more looks."""
        group = window * len(self.lanes) + np.maximum(lane, 0)
        count = np.bincount(group, good, minlength=len(self.keys) * len(self.lanes))
        variance = self.lines.sigma**2
        variance[:, 0] += count[group] * _MAP_SIGMA_M**2
        return np.asarray(variance)

    def _search(self, o: Offsets, n_looks: int) -> F64:
        """(L, 1) the move sideways at which the looks of some windows together fit best; the first poses may be a lane
        off.
        """
        aside = np.arange(-_SEARCH_M, _SEARCH_M + 1e-9, ASIDE_STEP_M)
        _, cost = choices(self.lines, o, aside)
        total = np.zeros((len(self.keys), len(aside)))
        np.add.at(total, self.window[:n_looks], cost)
        summed = np.cumsum(np.concatenate([np.zeros((1, len(aside))), total]), axis=0)
        rows = np.arange(len(self.keys))
        high, low = np.minimum(rows + SMOOTH + 1, len(rows)), np.maximum(rows - SMOOTH, 0)
        best = np.argmin(summed[high] - summed[low] + (aside / ASIDE_SIGMA_M) ** 2, axis=1)
        return np.asarray(aside[best][self.window[:n_looks], None])

    def _fitted(self, c: _Chosen, base: F64) -> WindowMatch:
        """Least squares of the polylines of each window."""
        A, g = _normal_equations(c, c.window, len(self.keys))
        few = np.bincount(c.window, minlength=len(self.keys)) < _MIN_POLYLINES
        A[few] = 0.0
        off, information, strong = solved(A, -g)
        return WindowMatch(self.keys, base, off, _INFORMATION * information, strong)

    def _polished(self, found: WindowMatch, c: _Chosen, rows: I64) -> F64:
        """(W, 3) what the poses of windows are off by GICP, Eq. (8), where lanes constrain them well."""
        pairs, group = np.unique(np.stack([c.window, c.lane], axis=1), axis=0, return_inverse=True)
        off, _, strong = solved(*_normal_equations(c, group.ravel(), len(pairs)))
        of_lane = np.einsum("nij,nj->ni", strong, off)
        off = found.off.copy()
        for row in rows:
            of = np.flatnonzero(pairs[:, 0] == row)
            source = [self._as_seen(int(pairs[n, 1]), found.base[row], of_lane[n]) for n in of]
            start = moved(found.base[row], found.strong[row] @ off[row])
            polished = self._gicp(np.concatenate(source), start)
            if polished is not None:
                off[row] += found.strong[row] @ (logarithm(found.base[row], polished) - off[row])
        return off

    def _gicp(self, source: F64, pose: F64) -> F64 | None:
        if len(source) < 20:
            return None
        near = self.lanes.near(pose[:2], SEEN_M[1] + 4.0 * MARGIN_M)
        ahead = rotated(np.full(len(near), -pose[2]), near - pose[:2])[:, 0]
        target = near[(ahead > SEEN_M[0] - MARGIN_M) & (ahead < SEEN_M[1] + MARGIN_M)]
        if len(target) < 20:
            return None
        return gicp(target, source, pose, _MAX_CORRESPONDENCE_M)

    def _as_seen(self, lane: int, base: F64, off: F64) -> F64:
        """(N, 2) a lane of the map, in the frame of the window, moved to where the looks saw it on average."""
        xy = self.lanes.stretch(lane, base[:2], SEEN_M[1] + 4.0 * MARGIN_M) - base[:2]
        xy = rotated(np.full(len(xy), -base[2]), xy)
        xy = xy[(xy[:, 0] > SEEN_M[0]) & (xy[:, 0] < SEEN_M[1]) & (np.abs(xy[:, 1]) < SEEN_M[1])]
        return np.asarray(xy + off[:2] + off[2] * np.stack([-xy[:, 1], xy[:, 0]], axis=1))


def _normal_equations(c: _Chosen, group: I64, n: int) -> tuple[F64, F64]:
    """(n, 3, 3) and (n, 3): information of groups of polylines about the pose's error, and its right-hand side."""
    A, g = np.zeros((n, 3, 3)), np.zeros((n, 3))
    np.add.at(A, group, np.einsum("sij,si,sik->sjk", c.by_pose, 1.0 / c.variance, c.by_pose))
    np.add.at(g, group, np.einsum("sij,si,si->sj", c.by_pose, 1.0 / c.variance, c.residual))
    return A, g


def solved(A: F64, g: F64) -> tuple[F64, F64, F64]:
    """Shortest solutions (n, 3) of A x = g; A (n, 3, 3) without directions that it hardly constrains; and
    projections (n, 3, 3) onto those that it constrains well.
    """
    scale = np.array([1.0, 1.0, 1.0 / TURN_AT_M])
    values, vectors = np.linalg.eigh(A * scale[:, None] * scale)
    most = np.maximum(values[:, -1:], 1e-12)
    known = values > NOTHING * most
    inverse = np.where(known, 1.0 / np.where(known, values, 1.0), 0.0)
    x = np.einsum("nij,nj,nkj,nk->ni", vectors, inverse, vectors, g * scale) * scale
    kept = np.einsum("nij,nj,nkj->nik", vectors, np.where(known, values, 0.0), vectors)
    strong = np.einsum("nij,nj,nkj->nik", vectors, np.where(values > MUCH * most, 1.0, 0.0), vectors)
    return x, np.asarray(kept / scale[:, None] / scale), np.asarray(strong * scale[:, None] / scale)


def moved(base: F64, off: F64) -> F64:
    """(3,) the pose that is `off` (3,), a logarithm, from `base` (3,)."""
    pose = pose2(base).compose(gtsam.Pose2.Expmap(off))
    return np.array([pose.x(), pose.y(), pose.theta()])


def logarithm(base: F64, pose: F64) -> F64:
    """(3,) how far `pose` (3,) is from `base` (3,), in its frame."""
    return np.asarray(gtsam.Pose2.Logmap(pose2(base).between(pose2(pose))))
