"""Whether an estimator's errors are as large as it claims: NEES against a reference, NIS against its own prediction
(Bar-Shalom, Li and Kirubarajan 2001, section 5.4). Both are means over degrees of freedom: 1 is honest, more too sure.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse, log_so3
from gnd.vehicle_agent.localise.estimates import PoseEstimate

HEADING, PLACE = [2], [3, 4]
"""Rows of a pose's covariance, rotation before position."""


@dataclass(frozen=True, slots=True)
class Nees:
    """Normalised estimation error squared of `n` poses, over degrees of freedom: of place, of heading, and of both."""

    n: int
    place: float
    heading: float
    joint: float

    def as_json(self) -> dict[str, float | int]:
        """Plain values."""
        return {
            "n": self.n,
            "place": round(self.place, 3),
            "heading": round(self.heading, 3),
            "joint": round(self.joint, 3),
        }


def nees_of(estimates: Sequence[PoseEstimate], reference: Trajectory) -> Nees | None:
    """Of the estimates that have a covariance and lie within the reference's time; None without any."""
    first, last = int(reference.t_ns[0]), int(reference.t_ns[-1])
    known = [(e, e.covariance) for e in estimates if e.covariance is not None and first <= e.t_ns <= last]
    if not known:
        return None
    true = reference.at(np.array([e.t_ns for e, _ in known], np.int64))
    off = T_inverse(true) @ np.stack([e.T_map_vehicle for e, _ in known])
    error = np.concatenate([log_so3(off[:, :3, :3]), off[:, :3, 3]], axis=1)
    covariance = np.stack([c for _, c in known])
    place, heading, joint = (_mean_square(error, covariance, rows) for rows in (PLACE, HEADING, HEADING + PLACE))
    return Nees(len(known), place, heading, joint)


def _mean_square(error: F64, covariance: F64, rows: list[int]) -> float:
    e, C = error[:, rows], covariance[:, rows][:, :, rows]
    return float(np.einsum("ni,nij,nj->n", e, np.linalg.inv(C), e).mean() / len(rows))


class Innovations:
    """Running NIS of matches with the map against what was predicted: heading and place, three degrees of freedom."""

    def __init__(self) -> None:
        self.n = 0
        self._sum = 0.0

    def see(self, T_predicted: F64, predicted: F64, T_matched: F64, matched: F64) -> None:
        """Take a match: poses (4, 4), and covariances (6, 6) in the vehicle frame, rotation first."""
        off = T_inverse(T_predicted) @ T_matched
        e = np.array([np.arctan2(off[1, 0], off[0, 0]), off[0, 3], off[1, 3]])
        rows = np.ix_(HEADING + PLACE, HEADING + PLACE)
        self._sum += float(e @ np.linalg.solve(predicted[rows] + matched[rows], e)) / 3.0
        self.n += 1

    @property
    def mean(self) -> float | None:
        """NIS over degrees of freedom; None before the first match."""
        return self._sum / self.n if self.n else None
