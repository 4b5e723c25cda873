"""Motion between the keyframes of a drive (Kim et al. 2018, Eq. 1-2): preintegrated wheel speed and yaw rate.

How the motion depends on the wheel's scale and the gyro's bias comes along, so that the graph estimates both.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.schemas.drive import MotionTrack
from gnd.vehicle_agent.features.mapping.sensors import WheelsAndGyro
from gnd.vehicle_agent.features.view import wrapped

GAP_S = 0.1  # samples farther apart leave something unknown between them
_GAP_MPS2, _GAP_RADPS2 = 2.0, 0.3  # so much may speed and yaw rate change in a gap, unseen
LEAST_M2, LEAST_RAD2 = 1e-6, 1e-9  # variances of a step: stiffer ones leave the graph ill-conditioned


class Steps(NamedTuple):
    """The motion from each keyframe to the next, K - 1 steps."""

    delta: F64
    """(K - 1, 3): x, y [m], yaw [rad] of the next keyframe in the frame of the one before."""
    jacobian: F64
    """(K - 1, 3, 2): of delta by wheel scale and gyro bias [rad/s]."""
    cov: F64
    """(K - 1, 3, 3): of delta, beyond scale and bias."""


def rotated(yaw_rad: F64, xy_m: F64) -> F64:
    """(..., 2) turned counter-clockwise by (...,) yaw."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.stack([c * xy_m[..., 0] - s * xy_m[..., 1], s * xy_m[..., 0] + c * xy_m[..., 1]], axis=-1)


def relative(base: F64, pose: F64) -> F64:
    """(..., 3) `pose` in the frame of `base`, both (..., 3)."""
    xy = rotated(-base[..., 2], pose[..., :2] - base[..., :2])
    return np.concatenate([xy, wrapped(pose[..., 2:] - base[..., 2:])], axis=-1)


def composed(base: F64, pose: F64) -> F64:
    """(..., 3) in the map frame what is `pose` (..., 3) in the frame of `base` (..., 3)."""
    xy = base[..., :2] + rotated(base[..., 2], pose[..., :2])
    return np.concatenate([xy, wrapped(base[..., 2:] + pose[..., 2:])], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class DeadReckoning:
    """The way of a vehicle by wheel speed and yaw rate alone, from (0, 0, 0) at the first of S samples.

    t_ns: (S,). pose: (S, 3), yaw not wrapped. turning: (S, 2), derivative of x, y by the gyro's bias. way_m: (S,).
    variance: (S, 2), of the way's length [m²] and of the yaw [rad²] by what is white, summed up.
    scale, bias_radps: that the samples were corrected by.
    """

    t_ns: I64
    pose: F64
    turning: F64
    way_m: F64
    variance: F64
    scale: float
    bias_radps: float

    @classmethod
    def of(cls, motion: MotionTrack, noise: WheelsAndGyro, scale: float, bias_radps: float) -> "DeadReckoning":
        """Integrate: speed times (1 + scale), yaw rate less the bias, both taken as linear between samples."""
        dt = np.diff(motion.t_ns) * 1e-9
        run = 0.5 * (motion.speed_mps[1:] + motion.speed_mps[:-1]) * (1.0 + scale) * dt
        turn = (0.5 * (motion.yaw_rate_radps[1:] + motion.yaw_rate_radps[:-1]) - bias_radps) * dt
        yaw = _summed(turn)
        middle = 0.5 * (yaw[1:] + yaw[:-1])
        t_middle = (0.5 * (motion.t_ns[1:] + motion.t_ns[:-1]) - motion.t_ns[0]) * 1e-9
        step = run[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=1)
        across = np.stack([-step[:, 1], step[:, 0]], axis=1) * -t_middle[:, None]
        xy = np.stack([_summed(step[:, 0]), _summed(step[:, 1])], axis=1)
        return cls(
            motion.t_ns,
            np.concatenate([xy, yaw[:, None]], axis=1),
            np.stack([_summed(across[:, 0]), _summed(across[:, 1])], axis=1),
            _summed(np.abs(run)),
            _white(dt, np.abs(run), noise),
            scale,
            bias_radps,
        )

    def at(self, t_ns: I64) -> F64:
        """(N, 3) poses at times (N,), straight between samples; before the first and after the last they stand."""
        return self._read(self.pose, t_ns)

    def _read(self, column: F64, t_ns: I64) -> F64:
        t = (t_ns - self.t_ns[0]) * 1e-9
        of = (self.t_ns - self.t_ns[0]) * 1e-9
        return np.stack([np.interp(t, of, c) for c in column.T], axis=1)

    def keyframes(self, every_m: float, every_s: float) -> I64:
        """(K,) times of the keyframes: first and last sample, and one every so many metres and seconds."""
        t_s = (self.t_ns - self.t_ns[0]) * 1e-9
        kept = [0]
        for n in range(1, len(t_s)):
            if self.way_m[n] - self.way_m[kept[-1]] >= every_m or t_s[n] - t_s[kept[-1]] >= every_s:
                kept.append(n)
        if kept[-1] != len(t_s) - 1:
            kept.append(len(t_s) - 1)
        return np.asarray(self.t_ns[kept])

    def steps(self, t_ns: I64) -> Steps:
        """The motion between the times (K,) of the keyframes: Eq. (1)."""
        pose, turning, t_s = self.at(t_ns), self._read(self.turning, t_ns), (t_ns - self.t_ns[0]) * 1e-9
        delta = relative(pose[:-1], pose[1:])
        by_scale = delta[:, :2] / (1.0 + self.scale)
        base = rotated(-pose[:-1, 2], turning[1:] - turning[:-1])
        by_bias = base - t_s[:-1, None] * np.stack([delta[:, 1], -delta[:, 0]], axis=1)
        jacobian = np.zeros((len(delta), 3, 2))
        jacobian[:, :2, 0], jacobian[:, :2, 1] = by_scale, by_bias
        jacobian[:, 2, 1] = -np.diff(t_s)
        return Steps(delta, jacobian, self._cov(delta, self._read(self.variance, t_ns)))

    def _cov(self, delta: F64, variance: F64) -> F64:
        """(K - 1, 3, 3): the way's length along, the yaw's random walk, and what that does across."""
        along, yaw = np.diff(variance, axis=0).T
        length = np.abs(delta[:, 0])
        cov = np.zeros((len(delta), 3, 3))
        cov[:, 0, 0] = along + LEAST_M2
        cov[:, 1, 1] = length**2 * yaw / 3.0 + along / 4.0 + LEAST_M2
        cov[:, 1, 2] = cov[:, 2, 1] = length * yaw / 2.0
        cov[:, 2, 2] = yaw + LEAST_RAD2
        return cov


def _summed(steps: F64) -> F64:
    """(S,) sums up to each sample of (S - 1,) steps."""
    return np.concatenate([[0.0], np.cumsum(steps)])


def _white(dt: F64, run_m: F64, noise: WheelsAndGyro) -> F64:
    """(S, 2) variance so far of way and yaw: white noise of the samples, slip, and what happens in gaps."""
    gap = np.where(dt > GAP_S, dt, 0.0)
    along = (noise.wheel_mps * dt) ** 2 + noise.slip_m**2 * run_m + (0.5 * _GAP_MPS2 * gap**2) ** 2
    yaw = (noise.gyro_radps * dt) ** 2 + noise.slip_rad**2 * run_m + (0.5 * _GAP_RADPS2 * gap**2) ** 2
    return np.stack([_summed(along), _summed(yaw)], axis=1)
