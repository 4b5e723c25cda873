"""The mount as it is used: the header's, corrected where the ground shows that it is certainly wrong.

While a pose is tracked, points and poses stay in the axes that they were matched in, so that no track is torn: the
LiDAR's place on the map does not depend on the mount. What depends on it is where the vehicle is from there, and where
its wheels are: both are taken through `T_used_vehicle`. Between tracks the axes themselves are changed (`remount`).
"""

from typing import Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_inverse, exp_so3, transform
from gnd.schemas.drive import DriveHeader, MountSigma
from gnd.vehicle_agent.importers.mount import HEIGHTS_M
from gnd.vehicle_agent.localise.mount import AXES, SIGMAS, TOLERANCE, WRONG, MountResidual, MountWatch
from gnd.vehicle_agent.localise.registration import WHEELS_M

TRUSTED_RAD: Final = float(np.radians(0.3))
TRUSTED: Final = MountSigma(0.05, TRUSTED_RAD, TRUSTED_RAD, TRUSTED_RAD)
"""One sigma of a header without uncertainty of its mount."""
BROKEN_SHARE: Final = 0.05
BROKEN_RAD: Final = float(np.radians(1.0))
MEANT_RAD: Final = float(np.radians(0.15))
"""Of headers without an uncertainty, one in twenty is wrong by a degree (one sigma); axes of the
others may mean something else than the axle's by so much, and are right by what they mean."""
UNKNOWN_RAD: Final = float(np.radians(5.0))
"""One sigma of an angle that nobody knows."""
KEPT_SHARE: Final = 0.5
"""An axis that is put right stays so until it may be off by less than this share of what makes it wrong (one sigma)."""
SETTLED_SCANS: Final = 5
_MOST_KNOWN: Final = 8
MOST_WAIT: Final = 3
"""Scans that a first pose waits for the ground where the header cannot be right."""


def header_sigma(header: DriveHeader) -> MountSigma:
    """How far the mount in a drive's header is known."""
    if header.mount == "assumed":
        return MountSigma(*[float("inf")] * 4)
    return TRUSTED if header.mount_sigma is None else header.mount_sigma


def tilted(T_vehicle_lidar: F64, off: F64, yaw_rad: float = 0.0) -> F64:
    """(4, 4) the mount with `off` (3,) added: height [m], roll, pitch [rad] about the vehicle's axes, and a yaw; the
    LiDAR stays where it is along and across the vehicle.
    """
    T = T_vehicle_lidar.copy()
    T[:3, :3] = exp_so3(np.array([off[1], off[2], 0.0])) @ exp_so3(np.array([0.0, 0.0, yaw_rad])) @ T[:3, :3]
    T[2, 3] += off[0]
    return T


def lever_covariance(p_vehicle_lidar_m: F64, variance_rad2: F64) -> F64:
    """(6, 6) of the vehicle's pose, vehicle frame, rotation first, from variances (3,) of roll, pitch and yaw of a
    mount at (3,): the LiDAR's place is known, the vehicle turns about it. Not known to which side, so that turn and
    shift go together.
    """
    x, y, z = p_vehicle_lidar_m
    lever = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    J = np.concatenate([-np.eye(3), -lever])
    return np.asarray(J * variance_rad2 @ J.T)


def left_over(found: float, sigma: float, applied: float, trusted: float) -> tuple[float, float]:
    """What an angle is still off by, and one sigma of it: `found` with one sigma, of a header trusted to `trusted` (one
    sigma), of which `applied` was put right. Where something was put right, the header is not asked any more.
    """
    if applied:
        return found - applied, sigma
    if not np.isfinite(sigma):
        return 0.0, trusted
    share = trusted**2 / (trusted**2 + sigma**2)
    return share * found, float(np.sqrt(share)) * sigma


def left_sigma(found: float, sigma: float, applied: float, trusted: float) -> float:
    """Root mean square of what an angle is still off by, arguments as of `left_over`. A header that does not say how
    well it is known is either right or broken: by Bayes, from how well what was found fits either.
    """
    if applied or trusted != TRUSTED_RAD:
        return float(np.hypot(*left_over(found, sigma, applied, trusted)))
    if not np.isfinite(sigma):
        return float(np.sqrt(BROKEN_SHARE)) * BROKEN_RAD
    broken = BROKEN_SHARE * _density(found, float(np.hypot(sigma, BROKEN_RAD)))
    right = (1.0 - BROKEN_SHARE) * _density(found, float(np.hypot(sigma, MEANT_RAD)))
    share = broken / max(broken + right, 1e-300)
    return float(np.sqrt(share) * np.hypot(*left_over(found, sigma, 0.0, BROKEN_RAD)))


def _density(value: float, sigma: float) -> float:
    return float(np.exp(-0.5 * (value / sigma) ** 2) / sigma)


class Mounting:
    """The header's mount, its error as observed on the ground, and the mount that is used."""

    def __init__(self, T_vehicle_lidar: F64, sigma: MountSigma = TRUSTED) -> None:
        """`sigma`: how far the header's mount is known."""
        self.T_header = np.array(T_vehicle_lidar, np.float64)
        self.T_used = self.T_header.copy()
        """The mount that points and tracked poses are in the axes of."""
        self.sigma = MountSigma(sigma.height_m, *(min(angle, UNKNOWN_RAD) for angle in sigma[1:]))
        """Of the header."""
        self.watch = MountWatch(self.T_header)
        self._watched = 0
        self._put_right = np.zeros(3, np.bool_)
        self._used_vehicle: dict[float, F64] = {}  # by yaw, until the mount is seen again: asked for with each scan

    @property
    def residual(self) -> MountResidual:
        """The error observed on the ground, true minus header."""
        return self.watch.residual

    def see(self, t_ns: int, points_m: F64) -> None:
        """Take a scan that is due: points (N, 3) in the axes of `T_used`, sweep motion removed."""
        self._watched += 1
        self.watch.see(t_ns, transform(self.T_header @ T_inverse(self.T_used), points_m))
        values, sigmas = np.abs(self.residual.values), self.residual.sigmas
        certain = values - SIGMAS * sigmas > TOLERANCE
        self._put_right = certain | (self._put_right & (values - sigmas > KEPT_SHARE * TOLERANCE))
        self._used_vehicle = {}

    @property
    def off(self) -> F64:
        """(3,) height [m], roll and pitch [rad] that are put right, true minus header; 0 where the header is kept."""
        return np.where(self._put_right, self.residual.values, 0.0)

    @property
    def put_right(self) -> tuple[str, ...]:
        """The axes that are put right."""
        return tuple(name for name, is_so in zip(AXES, self._put_right, strict=True) if is_so)

    @property
    def unsettled(self) -> bool:
        """True while the header is wrong by so much that poses are, and the ground was seen a few times only."""
        return self.residual.wrong and self.residual.scans < SETTLED_SCANS

    @property
    def waits(self) -> bool:
        """True while no pose is to be sought: the header has the LiDAR on the road, or does not know its height, and
        the ground is about to tell.
        """
        unknown = self.T_header[2, 3] < HEIGHTS_M[0] or np.isinf(self.sigma.height_m)
        observed = bool(np.isfinite(self.residual.height_sigma_m))
        return bool(unknown and not observed and self._watched < MOST_WAIT and self.watch.seen == self._watched)

    @property
    def torn(self) -> bool:
        """True when the axes in use are so wrong that a track in them is better begun anew."""
        return self.residual.wrong and bool((np.abs(self.off - self._off_used()) > WRONG).any())

    def _off_used(self) -> F64:
        R = self.T_used[:3, :3] @ self.T_header[:3, :3].T
        return np.array([self.T_used[2, 3] - self.T_header[2, 3], R[2, 1], R[0, 2]])

    def remount(self) -> F64:
        """Use what is known from now on; (4, 4) T_now_before that takes the axes before to those now."""
        before, self.T_used = self.T_used, tilted(self.T_header, self.off)
        self._used_vehicle = {}
        return np.asarray(self.T_used @ T_inverse(before))

    # --- what follows from it ------------------------------------------------------------------------------------

    def T_vehicle_lidar(self, yaw_rad: float = 0.0) -> F64:
        """(4, 4) the mount as it is, as far as known; `yaw_rad` is added to the header's."""
        return tilted(self.T_header, self.off, yaw_rad)

    def T_used_vehicle(self, yaw_rad: float = 0.0) -> F64:
        """(4, 4) the vehicle, as it lies under the mount as it is, in the axes of `T_used`."""
        known = self._used_vehicle.get(yaw_rad)
        if known is None:
            known = np.asarray(self.T_used @ T_inverse(self.T_vehicle_lidar(yaw_rad)))
            if len(self._used_vehicle) >= _MOST_KNOWN:
                self._used_vehicle = {}
            self._used_vehicle[yaw_rad] = known
        return known

    @property
    def wheels_m(self) -> F64:
        """(4, 3) the wheels in the axes of `T_used`."""
        return transform(self.T_used_vehicle(), WHEELS_M)

    def tilt_variance_rad2(self) -> F64:
        """(2,) mean square of what roll and pitch are still off by."""
        r, off = self.residual, self.off
        roll = left_sigma(r.roll_rad, r.roll_sigma_rad, off[1], self.sigma.roll_rad)
        pitch = left_sigma(r.pitch_rad, r.pitch_sigma_rad, off[2], self.sigma.pitch_rad)
        return np.square([roll, pitch])
