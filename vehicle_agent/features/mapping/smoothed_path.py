"""The way of a vehicle as the graph has smoothed it: keyframes, and dead reckoning in between."""

from dataclasses import dataclass

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.vehicle_agent.features.mapping.dead_reckoning import DeadReckoning, composed, relative
from gnd.vehicle_agent.features.view import wrapped


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedPath:
    """Poses of K keyframes in the map frame and dead reckoning in between.

    t_ns: (K,) increasing. pose: (K, 3) x, y [m], yaw [rad]. reckoning: with the drive's wheel scale and gyro bias.
    """

    t_ns: I64
    pose: F64
    reckoning: DeadReckoning

    def at(self, t_ns: I64) -> F64:
        """(N, 3) poses at times (N,): from the keyframes before and after, each by how near it is."""
        after = np.clip(np.searchsorted(self.t_ns, t_ns), 1, len(self.t_ns) - 1)
        span = (self.t_ns[after] - self.t_ns[after - 1]).astype(np.float64)
        share = np.clip((t_ns - self.t_ns[after - 1]) / span, 0.0, 1.0)[:, None]
        driven, here = self.reckoning.at(self.t_ns), self.reckoning.at(np.asarray(t_ns, np.int64))
        low, high = (composed(self.pose[k], relative(driven[k], here)) for k in (after - 1, after))
        off = high - low
        off[:, 2] = wrapped(off[:, 2])
        pose = low + share * off
        pose[:, 2] = wrapped(pose[:, 2])
        return np.asarray(pose)
