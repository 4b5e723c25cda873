"""Where the vehicle is by wheels, gyro and GNSS alone: a Kalman filter that has never seen a feature of the map.

The particles are compared with it, and drawn around it when they are lost. Its place can be coarse;
it cannot be led astray by a sign that was taken for its neighbour. Its state is that of a particle (`ParticleFilter`).
"""

from dataclasses import dataclass
from math import cos, exp, sin
from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.slamcu import noise
from gnd.vehicle_agent.features.view import wrapped

X, Y, HEADING, SCALE, BIAS, GNSS_X, GNSS_Y = range(7)
JUMP: Final = 30.0
"""Squared Mahalanobis distance of a fix from where it was expected, beyond which it is another reflection and is
left out: χ² of 2 degrees of freedom, one of three million. Without fixes the place grows uncertain, until one fits."""
MOST_SHARED: Final = 0.95
"""A first pose made of fixes has at most this share of its variance from their slow error."""
STANDING_MPS: Final = 0.02
"""Slower than this a vehicle stands, and what its gyro shows is its bias."""


@dataclass(frozen=True, slots=True, eq=False)
class BlindBelief:
    """Gaussian over x, y [m], heading [rad], wheel scale, gyro bias [rad/s] and the GNSS's slow error x, y [m].

    Attributes:
        mean: float64 (7,), map frame.
        cov: float64 (7, 7).
    """

    mean: F64
    cov: F64

    @classmethod
    def first(cls, pose: F64, cov: F64, gnss_sigma_m: float = 0.0) -> "BlindBelief":
        """The belief at the start.

        Args:
            pose: (3,) x, y, heading.
            cov: (3, 3) of it.
            gnss_sigma_m: of the fixes that the pose was made of, whose slow error is in it; 0: made otherwise.
        """
        mean, full = np.zeros(7), np.zeros((7, 7))
        mean[:3], full[:3, :3] = pose, cov
        full[SCALE, SCALE], full[BIAS, BIAS] = noise.SCALE**2, noise.BIAS_RADPS**2
        if gnss_sigma_m > 0.0:
            _, slow = noise.gnss_variances_m2(gnss_sigma_m)
            free = np.linalg.inv(np.linalg.inv(cov + 1e-12 * np.eye(3))[:2, :2])  # of the place, the heading known
            shared = min(slow, MOST_SHARED * float(np.linalg.eigvalsh(free)[0]))
            for place, error in ((X, GNSS_X), (Y, GNSS_Y)):
                full[error, error] = slow
                full[place, error] = full[error, place] = -shared
        return cls(mean, full)


class BlindFilter:
    """Extended Kalman filter of the vehicle without its map.

    Args:
        belief: at the start; a GNSS error without variance means that no fix has been seen.

    Attributes:
        has_fixes: whether a fix has been seen, or the first pose was made of some.
    """

    def __init__(self, belief: BlindBelief) -> None:
        self._mean, self._cov = belief.mean.copy(), belief.cov.copy()
        self.has_fixes = float(belief.cov[GNSS_X, GNSS_X]) > 0.0
        self._since = np.zeros(3)  # x, y, heading at the last propagation of the covariance
        self._since[:] = self._mean[:3]
        self._driven_s = 0.0
        self._F = np.eye(7)  # since the last fix
        self._expected = belief, np.eye(7)

    @property
    def expected(self) -> tuple[BlindBelief, F64]:
        """What was believed right before the last fix, and the transition (7, 7) from right after the one before."""
        return self._expected

    @property
    def belief(self) -> BlindBelief:
        """What is believed now."""
        self._propagate()
        return BlindBelief(self._mean.copy(), self._cov.copy())

    def predict(self, dt_s: float, speed_mps: float, yaw_rate_radps: float) -> None:
        """The vehicle drove on."""
        if abs(speed_mps) < STANDING_MPS:
            return
        x, y, heading, scale, bias = self._mean[:5].tolist()
        way, turn = speed_mps * dt_s * (1.0 + scale), (yaw_rate_radps - bias) * dt_s
        middle = heading + 0.5 * turn
        self._mean[:3] = x + way * cos(middle), y + way * sin(middle), heading + turn
        self._driven_s += dt_s

    def _propagate(self) -> None:
        """Covariance over the way driven since the last time, its steps together: they are a second long."""
        t_s = self._driven_s
        if t_s == 0.0:
            return
        dx, dy, _ = self._mean[:3] - self._since
        q = np.zeros((7, 7))
        F = np.eye(7)
        F[X, HEADING], F[Y, HEADING] = -dy, dx
        F[X, SCALE], F[Y, SCALE] = np.array([dx, dy]) / (1.0 + self._mean[SCALE])
        F[HEADING, BIAS], F[X, BIAS], F[Y, BIAS] = -t_s, 0.5 * t_s * dy, -0.5 * t_s * dx
        c, s = cos(self._mean[HEADING]), sin(self._mean[HEADING])
        # white turns over the way: heading t, and a third of their lever² across, half of it with the heading
        across = np.array([-dy, dx])
        q[:2, :2] = noise.SPEED_M**2 * t_s * np.outer([c, s], [c, s])
        q[:2, :2] += noise.YAW_RAD**2 * t_s / 3.0 * np.outer(across, across)
        q[:2, HEADING] = q[HEADING, :2] = 0.5 * noise.YAW_RAD**2 * t_s * across
        q[HEADING, HEADING] = noise.YAW_RAD**2 * t_s
        q[SCALE, SCALE], q[BIAS, BIAS] = noise.SCALE_WALK**2 * t_s, noise.BIAS_WALK_RADPS**2 * t_s
        self._cov, self._F = F @ self._cov @ F.T + q, F @ self._F
        self._since[:] = self._mean[:3]
        self._driven_s = 0.0

    def fix(self, xy_m: F64, sigma_m: float, dt_s: float) -> bool:
        """Take a fix (2,), `dt_s` after the last one; False: it lies so far off that it was left out."""
        self._propagate()
        white, slow = noise.gnss_variances_m2(sigma_m)
        fade = exp(-dt_s / noise.GNSS_CORRELATION_S)
        if not self.has_fixes:
            self._cov[[GNSS_X, GNSS_Y], [GNSS_X, GNSS_Y]], self.has_fixes = slow, True
            fade = 1.0
        F = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, fade, fade])
        self._mean, self._cov = F @ self._mean, F @ self._cov @ F
        self._cov[[GNSS_X, GNSS_Y], [GNSS_X, GNSS_Y]] += (1.0 - fade**2) * slow
        self._expected, self._F = (BlindBelief(self._mean.copy(), self._cov.copy()), F @ self._F), np.eye(7)
        H = np.zeros((2, 7))
        H[0, [X, GNSS_X]] = H[1, [Y, GNSS_Y]] = 1.0
        nu, S = xy_m - H @ self._mean, H @ self._cov @ H.T + white * np.eye(2)
        if float(nu @ np.linalg.solve(S, nu)) > JUMP:
            return False
        K = np.linalg.solve(S, H @ self._cov).T
        self._mean = self._mean + K @ nu
        rest = np.eye(7) - K @ H
        self._cov = rest @ self._cov @ rest.T + white * K @ K.T
        self._since[:] = self._mean[:3]
        return True


def apart(pose: F64, cov: F64, belief: BlindBelief) -> float:
    """Squared Mahalanobis distance of a pose (3,) with its covariance (3, 3) from a belief's."""
    off = pose - belief.mean[:3]
    off[2] = float(wrapped(off[2]))
    return float(off @ np.linalg.solve(cov + belief.cov[:3, :3], off))
