"""Dead reckoning from wheel speed and yaw rate, and the two constants of the sensors that the map can teach."""

from bisect import bisect_left

import numpy as np
from numpy.typing import NDArray

from gnd_map.motion import Trajectory
from gnd_map.se3 import T_inverse
from vehicle_agent.localise.graph import SmoothedPose

F64 = NDArray[np.float64]

KEEP_NS = 20_000_000_000  # more than any lag
STRETCH_S = 1.0
STRETCH_SIGMA_M, STRETCH_SIGMA_RAD = 0.03, 1e-3  # of the motion over a stretch that two final poses tell
SCALE_PRIOR = 0.01  # one sigma of a wheel's scale error before anything is learnt
BIAS_PRIOR_RADPS = 0.005
SCALE_DRIFT = 1e-4  # a root second
BIAS_DRIFT_RADPS = 1e-5


class MotionBuffer:
    """The last seconds of wheel speed and yaw rate, integrated as a car moves: along its x axis, turning about z."""

    def __init__(self) -> None:
        self._t_ns: list[int] = []
        self._speed_mps: list[float] = []
        self._yaw_rate_radps: list[float] = []
        self.speed_scale = 1.0
        self.yaw_bias_radps = 0.0

    def __len__(self) -> int:
        return len(self._t_ns)

    @property
    def last_ns(self) -> int:
        """Time of the newest sample; the buffer must not be empty."""
        return self._t_ns[-1]

    @property
    def speed_mps(self) -> float:
        """Newest speed, corrected; 0 before the first sample."""
        return self._speed_mps[-1] * self.speed_scale if self._speed_mps else 0.0

    def push(self, t_ns: int, speed_mps: float, yaw_rate_radps: float) -> bool:
        """Add a sample; False (and nothing kept) when it is not finite or not later than the one before."""
        if not np.isfinite(speed_mps + yaw_rate_radps) or (self._t_ns and t_ns <= self._t_ns[-1]):
            return False
        self._t_ns.append(t_ns)
        self._speed_mps.append(speed_mps)
        self._yaw_rate_radps.append(yaw_rate_radps)
        if t_ns - self._t_ns[0] > 2 * KEEP_NS:
            self._drop(bisect_left(self._t_ns, t_ns - KEEP_NS))
        return True

    def _drop(self, n: int) -> None:
        del self._t_ns[:n], self._speed_mps[:n], self._yaw_rate_radps[:n]

    def trajectory(self, first_ns: int, last_ns: int) -> Trajectory:
        """Poses in the vehicle frame at `first_ns`, from there to `last_ns` (>= first), at the samples' times.

        Beyond the samples the nearest one is continued; without any the vehicle is taken to stand.
        """
        t, speed, yaw_rate = self._resampled(first_ns, last_ns)
        dt = np.diff(t) * 1e-9
        dyaw = 0.5 * (yaw_rate[1:] + yaw_rate[:-1]) * dt
        ds = 0.5 * (speed[1:] + speed[:-1]) * dt
        yaw = np.concatenate([[0.0], np.cumsum(dyaw)])
        chord = ds * np.sinc(dyaw / (2 * np.pi))  # a chord of the arc
        middle = yaw[:-1] + 0.5 * dyaw
        T = np.zeros((len(t), 4, 4))
        T[:, 0, 0] = T[:, 1, 1] = np.cos(yaw)
        T[:, 1, 0] = np.sin(yaw)
        T[:, 0, 1] = -T[:, 1, 0]
        T[:, 2, 2] = T[:, 3, 3] = 1.0
        T[1:, 0, 3] = np.cumsum(chord * np.cos(middle))
        T[1:, 1, 3] = np.cumsum(chord * np.sin(middle))
        return Trajectory(t, T)

    def delta(self, first_ns: int, last_ns: int) -> F64:
        """(4, 4) T_first_last: the motion from `first_ns` to `last_ns`, in either order."""
        if last_ns < first_ns:
            return T_inverse(self.delta(last_ns, first_ns))
        return np.asarray(self.trajectory(first_ns, last_ns).T_dst_vehicle[-1])

    def _resampled(self, first_ns: int, last_ns: int) -> tuple[NDArray[np.int64], F64, F64]:
        """Sample times within the span with both ends added, and the corrected samples there."""
        low = max(bisect_left(self._t_ns, first_ns) - 1, 0)
        high = min(bisect_left(self._t_ns, last_ns) + 1, len(self._t_ns))
        known = np.array(self._t_ns[low:high], np.int64)
        inner = known[(known > first_ns) & (known < last_ns)]
        end = [last_ns] if last_ns > first_ns else []
        t = np.concatenate([[first_ns], inner, end]).astype(np.int64)
        if not len(known):
            return t, np.zeros(len(t)), np.zeros(len(t))
        at, x = (t - first_ns).astype(np.float64), (known - first_ns).astype(np.float64)
        speed = np.interp(at, x, self._speed_mps[low:high])
        yaw_rate = np.interp(at, x, self._yaw_rate_radps[low:high])
        return t, speed * self.speed_scale, yaw_rate - self.yaw_bias_radps


class MotionTeacher:
    """Learns wheel scale and gyro bias of a `MotionBuffer` from final poses: two scalar Kalman filters."""

    def __init__(self, motion: MotionBuffer) -> None:
        self._motion = motion
        self._scale_var = SCALE_PRIOR**2
        self._bias_var = BIAS_PRIOR_RADPS**2
        self._anchor: SmoothedPose | None = None

    def forget(self) -> None:
        """The poses to come do not continue those before."""
        self._anchor = None

    def learn(self, pose: SmoothedPose) -> None:
        """Take a final pose; after each `STRETCH_S` the motion since the last such pose is compared."""
        anchor = self._anchor
        if anchor is None or pose.t_ns - anchor.t_ns > 3e9 * STRETCH_S:
            self._anchor = pose
        elif pose.t_ns - anchor.t_ns >= STRETCH_S * 1e9:
            self._compare(anchor, pose)
            self._anchor = pose

    def _compare(self, first: SmoothedPose, last: SmoothedPose) -> None:
        dt_s = (last.t_ns - first.t_ns) * 1e-9
        self._scale_var += SCALE_DRIFT**2 * dt_s
        self._bias_var += BIAS_DRIFT_RADPS**2 * dt_s
        seen = T_inverse(first.T_map_vehicle) @ last.T_map_vehicle
        driven = self._motion.delta(first.t_ns, last.t_ns)
        self._learn_scale(driven[0, 3] / self._motion.speed_scale, seen[0, 3])
        self._learn_bias(_yaw(driven) + self._motion.yaw_bias_radps * dt_s, _yaw(seen), dt_s)

    def _learn_scale(self, wheel_m: float, map_m: float) -> None:
        gain = self._scale_var * wheel_m / (wheel_m**2 * self._scale_var + STRETCH_SIGMA_M**2)
        self._motion.speed_scale += gain * (map_m - self._motion.speed_scale * wheel_m)
        self._scale_var *= 1.0 - gain * wheel_m

    def _learn_bias(self, gyro_rad: float, map_rad: float, dt_s: float) -> None:
        gain = self._bias_var * dt_s / (dt_s**2 * self._bias_var + STRETCH_SIGMA_RAD**2)
        self._motion.yaw_bias_radps += gain * (gyro_rad - map_rad - self._motion.yaw_bias_radps * dt_s)
        self._bias_var *= 1.0 - gain * dt_s


def _yaw(T: F64) -> float:
    return float(np.arctan2(T[1, 0], T[0, 0]))
