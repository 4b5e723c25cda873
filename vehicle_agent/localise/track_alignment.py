"""Fixes, and the rigid pose that lays a local track over them, robust to a minority of them.

Iterated weights, the scale of the robust cost lowered step by step, so that a third of the fixes may be wild (graduated
non-convexity, Yang et al., RA-L 2020, with the Geman-McClure cost); never below what the track's own drift asks for.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import T_from_R_t, exp_so3, transform
from gnd.schemas.drive import GnssFix
from gnd.vehicle_agent.errors import LocaliseError

TRACK_ROBUST_K: Final = 2.0
"""Where the robust cost begins to give way, in sigmas of a fix."""
TRACK_STEP_M: Final = 0.01
TRACK_STEP_SHARE: Final = 0.01
TRACK_LASTING_M: Final = 50.0
"""An error of scale of so much lasts for so long a way; steps get the sigma with which they add up to it."""
TRACK_STEP_RAD: Final = 0.0005
"""One sigma of a step of the track, whatever its length."""
TRACK_STEP_RAD_PER_ROOT_M: Final = 0.001
"""Of its turn, with it."""

_ROUNDS: Final = 40
_SHRINK: Final = 1.4
"""Of the robust scale, a round."""
FIX_INFLATION: Final = 3.0
FIX_SPACING_M: Final = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class FixTable:
    """Fixes in time order: t_ns (N,), lat_rad, lon_rad, height_m (ellipsoidal, NaN where unknown), sigma_m (horizontal
    axis) and sigma_up_m, each (N,).
    """

    t_ns: I64
    lat_rad: F64
    lon_rad: F64
    height_m: F64
    sigma_m: F64
    sigma_up_m: F64

    def __post_init__(self) -> None:
        columns = (self.lat_rad, self.lon_rad, self.height_m, self.sigma_m, self.sigma_up_m)
        if any(column.shape != self.t_ns.shape for column in columns):
            raise LocaliseError(f"fixes: columns of {[len(c) for c in columns]} values for {len(self.t_ns)} times")
        if len(self.t_ns) and not (np.minimum(self.sigma_m, self.sigma_up_m) > 0).all():
            raise LocaliseError("fixes: every sigma must be positive")

    def __len__(self) -> int:
        return len(self.t_ns)

    @classmethod
    def of(cls, fixes: Iterable[GnssFix], up: float = 2.0) -> "FixTable":
        """Of fixes whose vertical sigma is `up` times the horizontal one."""
        rows = np.array([(f.lat_rad, f.lon_rad, f.height_m, f.sigma_m, up * f.sigma_m) for f in fixes]).reshape(-1, 5)
        return cls(np.array([f.t_ns for f in fixes], np.int64), *rows.T)

    def take(self, chosen: NDArray[np.bool_] | I64) -> "FixTable":
        """Some of the fixes."""
        columns = (self.lat_rad, self.lon_rad, self.height_m, self.sigma_m, self.sigma_up_m)
        return FixTable(self.t_ns[chosen], *(column[chosen] for column in columns))

    def enu_m(self, frame: LocalFrame) -> F64:
        """(N, 3); an unknown height counts as the frame's own."""
        return frame.enu_from_geodetic(
            self.lat_rad, self.lon_rad, np.where(self.has_height, self.height_m, frame.height_m)
        )

    @property
    def has_height(self) -> NDArray[np.bool_]:
        """(N,)."""
        return np.isfinite(self.height_m)


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """T_frame_local (4, 4), the fixes' weights 0 ... 1 (N,), and their distances from the track laid so (N,), metres
    (horizontal; in space with `tilt`).
    """

    T_frame_local: F64
    weights: F64
    off_m: F64


def align(p_local_m: F64, p_frame_m: F64, fixes: FixTable, *, tilt: bool) -> Alignment:
    """The pose that lays local points (N, 3) over the fixes' positions (N, 3).

    Raises:
        LocaliseError: the points do not lie apart, or heights are missing for a full rotation.
    """
    if tilt and not fixes.has_height.all():
        raise LocaliseError(f"{(~fixes.has_height).sum()} of {len(fixes)} fixes have no height, which tilt needs")
    span_m, sigma_m = float(np.ptp(p_local_m[:, :2], axis=0).max()), float(np.median(fixes.sigma_m))
    if span_m < 4.0 * sigma_m:
        raise LocaliseError(f"the track spans {span_m:.1f} m, which gives no heading with fixes of {sigma_m:.1f} m")
    variance, robust, scale = fixes.sigma_m**2, np.ones(len(fixes)), np.inf
    for _ in range(_ROUNDS):
        T = _rigid(p_local_m, p_frame_m, robust / variance, fixes, tilt=tilt)
        off_m = np.linalg.norm((p_frame_m - transform(T, p_local_m))[:, : 3 if tilt else 2], axis=1)
        variance = fixes.sigma_m**2 + float(np.median(off_m)) ** 2
        ratio = off_m / np.sqrt(variance)
        scale = max(TRACK_ROBUST_K, min(scale, float(ratio.max())) / _SHRINK)
        robust = (1.0 + (ratio / scale) ** 2) ** -2  # Geman-McClure
    return Alignment(T, robust, off_m)


def _rigid(p_src: F64, p_dst: F64, weights: F64, fixes: FixTable, *, tilt: bool) -> F64:
    """(4, 4) weighted least squares; heights apart unless `tilt`, because some may be unknown."""
    w = weights / weights.sum()
    middle_src, middle_dst = w @ p_src, w @ p_dst
    src, dst = p_src - middle_src, p_dst - middle_dst
    if tilt:
        R = _umeyama(src, dst, w)
        return T_from_R_t(R, middle_dst - R @ middle_src)
    sine, cosine = w @ (src[:, 0] * dst[:, 1] - src[:, 1] * dst[:, 0]), w @ (src[:, :2] * dst[:, :2]).sum(axis=1)
    R = exp_so3([0.0, 0.0, float(np.arctan2(sine, cosine))])
    T = T_from_R_t(R, middle_dst - R @ middle_src)
    known = weights * fixes.has_height / fixes.sigma_up_m**2
    T[2, 3] = (known @ (p_dst[:, 2] - p_src[:, 2])) / known.sum() if known.any() else 0.0
    return T


def _umeyama(src: F64, dst: F64, w: F64) -> F64:
    """(3, 3) rotation of centred points (Umeyama, PAMI 1991, without scale)."""
    U, _, Vt = np.linalg.svd((dst * w[:, None]).T @ src)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt)
