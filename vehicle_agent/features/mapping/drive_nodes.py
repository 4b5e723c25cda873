"""The nodes of a drive's graph: keyframes, first poses by smoothing motion and GNSS, fixes put together."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.vehicle_agent.features.mapping.dead_reckoning import DeadReckoning, composed, relative, rotated
from gnd.vehicle_agent.features.mapping.feature_drive import FeatureDrive, GnssFixes
from gnd.vehicle_agent.features.mapping.graph import solve
from gnd.vehicle_agent.features.mapping.graph_edges import (
    NO_FIX_NODES,
    FixNodes,
    Problem,
    State,
)
from gnd.vehicle_agent.features.mapping.landmarks import Sight
from gnd.vehicle_agent.features.mapping.sensors import DriveSensors, GnssReceiver

_KEYFRAME_M: Final = 5.0
_KEYFRAME_S: Final = 1.0
"""A pose of the graph every so many metres, and every so many seconds."""

_FIX_NODE_S: Final = 1.0
"""A state of the GNSS's slow error at least this far from the next."""

SMOOTHINGS = 2  # of motion and fixes, each with the wheel scale and gyro bias of the one before
CHORD_M = 60.0  # GNSS gives a direction over so long a way


@dataclass(frozen=True, slots=True, eq=False)
class DriveNodes:
    """A drive and its keyframes. t_ns: (K,)."""

    drive: FeatureDrive
    sensors: DriveSensors
    t_ns: I64
    reckoning: DeadReckoning
    calibration: F64

    @classmethod
    def of(cls, drive: FeatureDrive, sensors: DriveSensors) -> "DriveNodes":
        """Keyframes by the way driven; no wheel scale and gyro bias known yet."""
        reckoning = DeadReckoning.of(drive.motion, sensors.motion, 0.0, 0.0)
        t_ns = reckoning.keyframes(_KEYFRAME_M, _KEYFRAME_S)
        return cls(drive, sensors, t_ns, reckoning, np.zeros(2))

    def calibrated(self, calibration: F64) -> "DriveNodes":
        """The same keyframes, dead reckoning with wheel scale and gyro bias (2,)."""
        scale, bias = calibration.tolist()
        reckoning = DeadReckoning.of(self.drive.motion, self.sensors.motion, scale, bias)
        return replace(self, reckoning=reckoning, calibration=calibration)

    def sight(self, t_ns: I64) -> Sight:
        """Where the vehicle was at times (M,) as seen from the nearest keyframes."""
        key = nearest(self.t_ns, t_ns)
        here, base = self.reckoning.at(t_ns), self.reckoning.at(self.t_ns)[key]
        way = np.interp(t_ns - self.t_ns[0], self.reckoning.t_ns - self.t_ns[0], self.reckoning.way_m)
        return Sight(key, relative(base, here), way)

    def problem(self, pose: F64) -> Problem:
        """Motion and fixes as edges; pose: (K, 3) as known so far."""
        return Problem(
            self.reckoning.steps(self.t_ns),
            self.calibration,
            self._fix_nodes(self.drive.fixes, pose, self.sensors.gnss),
        )

    def _fix_nodes(self, fixes: GnssFixes, pose: F64, noise: GnssReceiver) -> FixNodes:
        """Fixes brought to keyframes and averaged: what is white in them becomes less."""
        if len(fixes.t_ns) == 0:
            return NO_FIX_NODES
        base = spaced(self.t_ns, round(_FIX_NODE_S * 1e9))
        node = base[nearest(self.t_ns[base], fixes.t_ns)]
        driven = relative(self.reckoning.at(self.t_ns[node]), self.reckoning.at(fixes.t_ns))
        xy = fixes.xy_m - rotated(pose[node, 2], driven[:, :2])
        key, group, count = np.unique(node, return_inverse=True, return_counts=True)
        mean = np.stack([np.bincount(group, column) / count for column in xy.T], axis=1)
        span_s = np.bincount(group, np.abs(fixes.t_ns - self.t_ns[node]) * 1e-9) / count * 4.0
        # A mean over a span of a Gauss-Markov process differs from its middle by about 2 sigma² / tau * span / 12.
        slow = noise.sigma_m**2 * span_s / (6.0 * noise.correlation_s)
        return FixNodes(key, (self.t_ns[key] - self.t_ns[0]) * 1e-9, mean, noise.white_m**2 / count + slow)

    def first_state(self) -> tuple["DriveNodes", State]:
        """Poses (K, 3) by smoothing motion and fixes: no features yet, no map."""
        nodes = self.calibrated(np.array([0.0, self._first_bias()]))
        state = State(nodes._laid_out(), np.empty((0, 2)), nodes.calibration)
        for _ in range(SMOOTHINGS):
            nodes = nodes.calibrated(state.calibration)
            state = solve(nodes.problem(state.pose), state, self.sensors).state
        return nodes, state

    def _first_bias(self) -> float:
        """Gyro bias [rad/s] roughly: how directions by GNSS turn against those of dead reckoning."""
        t_ns, xy = self.drive.fixes.t_ns, self.drive.fixes.xy_m
        way = np.interp(t_ns - self.t_ns[0], self.reckoning.t_ns - self.t_ns[0], self.reckoning.way_m)
        last = np.searchsorted(way, way + CHORD_M)
        first = np.flatnonzero(last < len(way))
        if len(first) < 10:
            return 0.0
        driven = self.reckoning.at(t_ns)[:, :2]
        a, b = xy[last[first]] - xy[first], driven[last[first]] - driven[first]
        off = np.unwrap(np.arctan2(b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0], (a * b).sum(axis=1)))
        t_s = (t_ns[first] - t_ns[0]) * 1e-9
        slope = float(np.polyfit(t_s, off, 1)[0]) if np.ptp(t_s) > 0 else 0.0
        limit = 4.0 * self.sensors.motion.gyro_bias_radps
        return float(np.clip(-slope, -limit, limit))

    def _laid_out(self) -> F64:
        """(K, 3) dead reckoning laid onto the fixes as a whole: turned and shifted, least squares."""
        t_ns, xy = self.drive.fixes.t_ns, self.drive.fixes.xy_m
        driven, base = self.reckoning.at(t_ns)[:, :2], self.reckoning.at(self.t_ns)
        a, b = driven - driven.mean(axis=0), xy - xy.mean(axis=0)
        yaw = float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum()))
        shift = xy.mean(axis=0) - rotated(np.array(yaw), driven.mean(axis=0))
        return composed(np.broadcast_to(np.array([*shift, yaw]), base.shape), base)


def nearest(base: I64, values: I64) -> I64:
    """(N,) the row of increasing `base` (K,) that is nearest to each of `values` (N,)."""
    after = np.clip(np.searchsorted(base, values), 1, max(len(base) - 1, 1))
    if len(base) == 1:
        return np.zeros(len(values), np.int64)
    return np.asarray(np.where(values - base[after - 1] <= base[after] - values, after - 1, after))


def spaced(values: I64 | F64, least: float) -> I64:
    """Rows of increasing values (K,) of which each is larger than the one before by `least` or more."""
    kept = [0]
    for row in range(1, len(values)):
        if values[row] - values[kept[-1]] >= least:
            kept.append(row)
    return np.array(kept, np.int64)
