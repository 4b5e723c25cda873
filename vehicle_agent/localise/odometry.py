"""Dead reckoning from wheel speed and yaw rate."""

from bisect import bisect_left
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse
from gnd.vehicle_agent.localise.odometry_kernels import integrate, resampled

KEEP_NS = 45_000_000_000  # more than any lag, and than the steps that the clock is estimated from
MAX_ACCELERATION_MPS2 = 15.0  # tyres on dry tarmac hold about 10
SLIP_MPS = 0.5  # beyond what is possible, before it is a slip and no noise
SLIP_LASTS_NS = 1_000_000_000
GAP_NS = 100_000_000  # two samples farther apart leave something unknown between them


@dataclass(frozen=True, slots=True)
class ClockModel:
    """Stamps of the samples are later than the LiDAR's clock by `offset_s` at `at_ns` of it, growing by `rate`."""

    at_ns: int = 0
    offset_s: float = 0.0
    rate: float = 0.0

    def offset_ns(self, t_ns: int) -> int:
        """How much later the samples are stamped at a time of the LiDAR's clock."""
        return round(self.offset_s * 1e9 + self.rate * (t_ns - self.at_ns))

    def stamp(self, t_ns: int) -> int:
        """The stamp of a sample taken at `t_ns` of the LiDAR's clock."""
        return t_ns + self.offset_ns(t_ns)

    def of_stamps(self, stamp_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Times (N,) of the LiDAR's clock of samples with these stamps (N,)."""
        since = stamp_ns - self.at_ns - round(self.offset_s * 1e9)
        return self.at_ns + np.round(since / (1.0 + self.rate)).astype(np.int64) if self.rate else since + self.at_ns

    def of_stamp(self, stamp_ns: int) -> int:
        """The same of one sample."""
        since = stamp_ns - self.at_ns - round(self.offset_s * 1e9)
        return self.at_ns + (round(since / (1.0 + self.rate)) if self.rate else since)


class MotionBuffer:
    """The last seconds of wheel speed and yaw rate, integrated as a car moves: along its x axis, turning about z.

    All times asked for are of the LiDAR's clock; samples are kept as stamped, and `clock` is applied as they are read.
    """

    def __init__(self) -> None:
        self.clock = ClockModel()
        self._slipped_ns: list[int] = []
        self._t_ns: list[int] = []
        self._speed_mps: list[float] = []
        self._yaw_rate_radps: list[float] = []
        self.speed_scale = 1.0
        self.yaw_bias_radps = 0.0
        self.course = np.zeros(2)
        """Sideways and upward motion per metre forward: how the vehicle's axes, as mounted, lie to its course."""

    def __len__(self) -> int:
        return len(self._t_ns)

    @property
    def last_ns(self) -> int:
        """Time of the newest sample by the LiDAR's clock; the buffer must not be empty."""
        return self.clock.of_stamp(self._t_ns[-1])

    @property
    def last_stamp_ns(self) -> int:
        """Stamp of the newest sample; the buffer must not be empty."""
        return self._t_ns[-1]

    def samples(self, first_stamp_ns: int) -> tuple[NDArray[np.int64], F64, F64]:
        """Stamps, speed and yaw rate (N,) from a stamp on, nothing applied."""
        low = bisect_left(self._t_ns, first_stamp_ns)
        return (
            np.array(self._t_ns[low:], np.int64),
            np.array(self._speed_mps[low:], np.float64),
            np.array(self._yaw_rate_radps[low:], np.float64),
        )

    @property
    def speed_mps(self) -> float:
        """Newest speed, corrected; 0 before the first sample."""
        return self._speed_mps[-1] * self.speed_scale if self._speed_mps else 0.0

    def shared(self) -> NDArray[np.float64]:
        """(4,) what is taken off all samples: gyro bias [rad/s], wheel scale, motion left and up per metre forward."""
        return np.array([self.yaw_bias_radps, self.speed_scale, *self.course])

    def push(self, t_ns: int, speed_mps: float, yaw_rate_radps: float) -> bool:
        """Add a sample; False (and nothing kept) when it is not finite or not later than the one before."""
        if not np.isfinite(speed_mps + yaw_rate_radps) or (self._t_ns and t_ns <= self._t_ns[-1]):
            return False
        possible_mps = self._possible(t_ns, speed_mps)
        if abs(speed_mps - possible_mps) > SLIP_MPS:
            self._slipped_ns.append(t_ns)
        self._speed_mps.append(possible_mps)
        self._t_ns.append(t_ns)
        self._yaw_rate_radps.append(yaw_rate_radps)
        if t_ns - self._t_ns[0] > 2 * KEEP_NS:
            self._drop(bisect_left(self._t_ns, t_ns - KEEP_NS))
        return True

    def clear(self) -> None:
        """Forget the samples, not what was learnt about them."""
        self._drop(len(self._t_ns))

    def unknown_s(self, first_ns: int, last_ns: int) -> float:
        """How much of the time from `first_ns` to `last_ns` lies in gaps between samples or beyond them, seconds."""
        first_ns, last_ns = self.clock.stamp(first_ns), self.clock.stamp(last_ns)
        low = max(bisect_left(self._t_ns, first_ns) - 1, 0)
        inner = self._t_ns[low : bisect_left(self._t_ns, last_ns) + 1]
        if not inner:
            return (last_ns - first_ns) * 1e-9
        known = [first_ns] * (inner[0] > first_ns) + inner + [last_ns] * (inner[-1] < last_ns)
        gaps = (min(b, last_ns) - max(a, first_ns) for a, b in pairwise(known) if b - a > GAP_NS)
        return sum(gaps) * 1e-9

    def slipped(self, first_ns: int, last_ns: int) -> bool:
        """Whether between two times, or up to `SLIP_LASTS_NS` before, a slip of the wheels was seen: a speed that
        changed faster than any road allows. Slips are remembered as long as samples.
        """
        k = bisect_left(self._slipped_ns, self.clock.stamp(first_ns) - SLIP_LASTS_NS)
        return k < len(self._slipped_ns) and self._slipped_ns[k] <= self.clock.stamp(last_ns)

    def _possible(self, t_ns: int, speed_mps: float) -> float:
        """The speed that the vehicle can have: wheels that lock or spin change theirs faster than any road allows."""
        if not self._t_ns:
            return speed_mps
        most, before = MAX_ACCELERATION_MPS2 * (t_ns - self._t_ns[-1]) * 1e-9, self._speed_mps[-1]
        return min(max(speed_mps, before - most), before + most)

    def age_s(self, now_ns: int) -> float:
        """How old the newest sample is, seconds; infinite without one."""
        return (now_ns - self.last_ns) * 1e-9 if self._t_ns else float("inf")

    def _drop(self, n: int) -> None:
        del self._t_ns[:n], self._speed_mps[:n], self._yaw_rate_radps[:n]
        del self._slipped_ns[: bisect_left(self._slipped_ns, self._t_ns[0]) if self._t_ns else None]

    def trajectory(self, first_ns: int, last_ns: int) -> Trajectory:
        """Poses in the vehicle frame at `first_ns`, from there to `last_ns` (>= first), at the samples' times.

        Beyond the samples the nearest one is continued; without any the vehicle is taken to stand.
        """
        return Trajectory(*self._driven(first_ns, last_ns))

    def _driven(self, first_ns: int, last_ns: int) -> tuple[NDArray[np.int64], F64]:
        """Times (N,) and poses (N, 4, 4) of `trajectory`."""
        t, speed, yaw_rate = self._resampled(first_ns, last_ns)
        T = np.empty((len(t), 4, 4))
        integrate(t, speed, yaw_rate, self.course, T)
        return t, T

    def delta(self, first_ns: int, last_ns: int) -> F64:
        """(4, 4) T_first_last: the motion from `first_ns` to `last_ns`, in either order."""
        if last_ns < first_ns:
            return T_inverse(self.delta(last_ns, first_ns))
        return np.asarray(self._driven(first_ns, last_ns)[1][-1])

    def changes(self, first_ns: int, last_ns: int) -> tuple[float, float]:
        """What speed [m/s] and yaw rate [rad/s] changed by between two times: what an offset of the clock acts on."""
        _, speed, yaw_rate = self._resampled(first_ns, last_ns)
        return float(speed[-1] - speed[0]), float(yaw_rate[-1] - yaw_rate[0])

    def _resampled(self, first_ns: int, last_ns: int) -> tuple[NDArray[np.int64], F64, F64]:
        """Sample times within the span with both ends added, and the corrected samples there."""
        low = max(bisect_left(self._t_ns, self.clock.stamp(first_ns)) - 1, 0)
        high = min(bisect_left(self._t_ns, self.clock.stamp(last_ns)) + 1, len(self._t_ns))
        known = self.clock.of_stamps(np.array(self._t_ns[low:high], np.int64))
        speed, yaw_rate = np.array(self._speed_mps[low:high]), np.array(self._yaw_rate_radps[low:high])
        return resampled(known, speed * self.speed_scale, yaw_rate - self.yaw_bias_radps, first_ns, last_ns)
