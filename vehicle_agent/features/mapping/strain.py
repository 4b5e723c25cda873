"""Whether the edges of a solved graph contradict each other: what an optimum hides in its cost.

A graph always has an optimum. With lanes of another road, a GNSS that reflections led astray, or wheels that slip, it
is a compromise between statements that cannot all be true, and its covariances know nothing of it. So each sort of edge
is held against the others over stretches of the drive: what is left over must be no more than its noise.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.stats import binom, chi2

from gnd.gnd_map.arrays import F64, I64
from gnd.vehicle_agent.features.mapping.dead_reckoning import relative
from gnd.vehicle_agent.features.mapping.graph_edges import FixNodes, Problem, State
from gnd.vehicle_agent.features.mapping.sensors import DriveSensors
from gnd.vehicle_agent.features.view import wrapped

WINDOW_S: Final = 120.0
"""Stretches of this length are asked: nine time constants of the GNSS's slow error."""
CHANCE: Final = 1e-6
"""A stretch without contradiction is called one so rarely, each test by itself."""
OUTLIERS: Final = 0.02
"""Share of ties that may be another feature's: beyond χ² 99.9 % of their own noise."""
LASTING_M: Final = 1.0
"""What a GNSS may be off by over a whole stretch (ionosphere, the antenna's place), each axis."""
FEWEST: Final = 3


@dataclass(frozen=True, slots=True)
class Strain:
    """Edges that the rest of the graph contradicts.

    Attributes:
        what: "motion", "fixes", "jumps of fixes", "features" or "calibration".
        from_s: since the first keyframe.
        until_s: its end.
        value: of the statistic.
        gate: that it should stay below.
    """

    what: str
    from_s: float
    until_s: float
    value: float
    gate: float

    def __str__(self) -> str:
        return f"{self.what} {self.from_s:.0f} … {self.until_s:.0f} s: {self.value:.3g}, at most {self.gate:.3g}"


def strains(problem: Problem, state: State, t_ns: I64, sensors: DriveSensors) -> tuple[Strain, ...]:
    """Return what contradicts in a solved graph; none: nothing does.

    Args:
        problem: its edges.
        state: its optimum.
        t_ns: (K,) times of the keyframes.
        sensors: that it was made with.
    """
    t_s = (t_ns - t_ns[0]) * 1e-9
    found: list[Strain | None] = [_calibration(state, t_s, sensors)]
    for low in np.arange(0.0, max(float(t_s[-1]), 1e-3), WINDOW_S):
        span = low, min(low + WINDOW_S, float(t_s[-1]))
        inside = (t_s >= span[0]) & (t_s <= span[1])
        found += [_motion(problem, state, inside, span), _ties(problem, state, inside, span)]
        found += _fixes(problem.fixes, state, span, sensors)
    return tuple(one for one in found if one is not None and one.value > one.gate)


def _calibration(state: State, t_s: F64, sensors: DriveSensors) -> Strain:
    sigma = np.array([sensors.motion.wheel_scale, sensors.motion.gyro_bias_radps])
    value = float(np.square(state.calibration / sigma).sum())
    return Strain("calibration", 0.0, float(t_s[-1]), value, float(chi2.isf(CHANCE, 2)))


def _motion(problem: Problem, state: State, inside: np.ndarray, span: tuple[float, float]) -> Strain | None:
    """What is left of Eq. (2), whitened; an optimum leaves less than the noise."""
    rows = np.flatnonzero(inside[:-1] & inside[1:])
    if len(rows) < FEWEST:
        return None
    steps = problem.steps
    off = relative(state.pose[rows], state.pose[rows + 1]) - steps.delta[rows]
    off -= steps.jacobian[rows] @ (state.calibration - problem.calibration)
    off[:, 2] = wrapped(off[:, 2])
    value = float(np.einsum("ki,ki->", off, np.linalg.solve(steps.cov[rows], off[..., None])[..., 0]))
    return Strain("motion", *span, value, float(chi2.isf(CHANCE, 3 * len(rows))))


def _fixes(fixes: FixNodes, state: State, span: tuple[float, float], sensors: DriveSensors) -> tuple[Strain, ...]:
    """Fix minus pose under the slow and the white error: its mean by generalised least squares (the slow error lasts,
    so a mean of many is not sure), and what is left over as a whole, which jumps show in.
    """
    rows = np.flatnonzero((fixes.t_s >= span[0]) & (fixes.t_s <= span[1]))
    if len(rows) < FEWEST:
        return ()
    gnss, t_s = sensors.gnss, fixes.t_s[rows]
    slow = gnss.sigma_m**2 * np.exp(-np.abs(t_s[:, None] - t_s) / gnss.correlation_s)
    inverse = np.linalg.inv(slow + np.diag(fixes.variance_m2[rows]))
    off, information = fixes.xy_m[rows] - state.pose[fixes.key[rows], :2], float(inverse.sum())
    mean = inverse.sum(axis=0) @ off / information
    offset = float(mean @ mean) / (1.0 / information + LASTING_M**2)
    rest = float(np.einsum("gi,gh,hi->", off - mean, inverse, off - mean))
    return (
        Strain("fixes", *span, offset, float(chi2.isf(CHANCE, 2))),
        Strain("jumps of fixes", *span, rest, float(chi2.isf(CHANCE, 2 * len(rows)))),
    )


def _ties(problem: Problem, state: State, inside: np.ndarray, span: tuple[float, float]) -> Strain | None:
    """How many ties of Eq. (5) lie beyond their noise: a few are another feature's, many are another place's."""
    ties = problem.ties
    rows = np.flatnonzero(inside[ties.key])
    if len(rows) < FEWEST:
        return None
    places = np.column_stack([state.xy_m[ties.landmark[rows]], np.zeros(len(rows))])
    seen = relative(state.pose[ties.key[rows]], places)[:, :2]
    errors = state.errors[ties.landmark[rows]] if len(state.errors) else np.zeros((len(rows), 2))
    bearing, range_m = np.arctan2(seen[:, 1], seen[:, 0]) + errors[:, 1], np.hypot(*seen.T) * (1.0 + errors[:, 0])
    off = ties.polar[rows] - np.column_stack([bearing, range_m])
    off[:, 0] = wrapped(off[:, 0])
    squared = np.einsum("ti,ti->t", off, np.linalg.solve(ties.cov[rows], off[..., None])[..., 0])
    beyond = int((squared > chi2.isf(1e-3, 2)).sum())
    return Strain("features", *span, float(beyond), float(max(binom.isf(CHANCE, len(rows), OUTLIERS), FEWEST)))
