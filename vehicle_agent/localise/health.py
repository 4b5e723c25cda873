"""Whether to believe a match, and whether to believe the pose: tells a poor place from a wrong pose."""

import numpy as np
from numpy.typing import NDArray

from gnd_map.se3 import T_inverse, log_so3
from vehicle_agent.localise.estimates import Health
from vehicle_agent.localise.parameters import HealthParameters
from vehicle_agent.localise.registration import RegistrationResult

F64 = NDArray[np.float64]


class HealthMonitor:
    """Remembers when a match was last believed, and how many fixes or wider matches in a row contradicted the pose."""

    def __init__(self, parameters: HealthParameters, now_ns: int) -> None:
        self.parameters = parameters
        self._believed_ns = now_ns
        self._far_fixes = 0
        self._better_elsewhere = 0
        self._trusted = False

    def believe(self, result: RegistrationResult | None, T_predicted: F64, sigmas: F64, t_ns: int) -> bool:
        """True when the match converged, covers enough of the scan and lies near the prediction; remembered then.

        `sigmas` (6,) of the prediction since the pose before: rotation [rad], translation [m].
        """
        if result is None or not result.converged or result.matching_ratio < self.parameters.min_matching_ratio:
            return False
        if not self._within_gate(T_inverse(T_predicted) @ result.T_map_vehicle, sigmas, self._gap_s(t_ns)):
            return False
        self._believed_ns = t_ns
        self._trusted |= result.fit >= self.parameters.trusted_fit
        return True

    def doubtful(self, result: RegistrationResult | None) -> bool:
        """True when a wider search is worth its time."""
        return result is None or not result.converged or result.fit < self.parameters.trusted_fit

    def see_wider(self, near: RegistrationResult | None, wide: RegistrationResult | None) -> None:
        """Take a match from the prediction with narrow and with wide reach."""
        fit = 0.0 if near is None else near.fit
        better = wide is not None and wide.fit > fit + self.parameters.better_fit
        self._better_elsewhere = self._better_elsewhere + 1 if better else 0

    def see_fix(self, distance_m: float, sigma_m: float) -> None:
        """Take the horizontal distance between a GNSS fix and the pose at its time."""
        far = distance_m > self.parameters.gnss_sigmas * sigma_m
        self._far_fixes = self._far_fixes + 1 if far else 0

    def health(self, t_ns: int) -> Health:
        """`lost`: the pose is worth nothing; `degraded`: dead reckoning; else `good`."""
        gap_s = self._gap_s(t_ns)
        par = self.parameters
        contradicted = self._far_fixes >= par.gnss_count or self._better_elsewhere >= par.better_count
        if contradicted or gap_s > par.lost_after_s:
            return "lost"
        return "good" if self._trusted and gap_s <= par.degraded_after_s else "degraded"

    def _gap_s(self, t_ns: int) -> float:
        return (t_ns - self._believed_ns) * 1e-9

    def _within_gate(self, innovation: F64, sigmas: F64, gap_s: float) -> bool:
        par = self.parameters
        shift_m = float(np.linalg.norm(innovation[:3, 3]))
        turn_deg = float(np.degrees(np.linalg.norm(log_so3(innovation[:3, :3]))))
        limit_m = par.gate_m + par.gate_m_per_s * gap_s + 3.0 * float(np.linalg.norm(sigmas[3:]))
        limit_deg = par.gate_deg + par.gate_deg_per_s * gap_s + np.degrees(3.0 * float(np.linalg.norm(sigmas[:3])))
        return bool(shift_m <= limit_m and turn_deg <= limit_deg)
