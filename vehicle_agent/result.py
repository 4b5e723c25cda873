"""Results of one drive of an agent: counts, traffic, health, and errors against the recording's reference.

The reference poses of a recording are read here, and nowhere else in the vehicle.
"""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.motion import Trajectory
from gnd.schemas.drive import ReferencePose
from gnd.vehicle_agent.errors import LocaliseError
from gnd.vehicle_agent.localise.consistency import nees_of
from gnd.vehicle_agent.localise.estimates import PoseEstimate, error_series, localisation_error


@dataclass(slots=True)
class PoseEvaluation:
    """Refined poses and reference poses side by side."""

    T_map_anchor: F64
    """(4, 4) from the frame of the reference poses to the map frame."""
    estimates: list[PoseEstimate] = field(default_factory=list)
    reference_t_ns: list[int] = field(default_factory=list)
    reference_pose: list[F64] = field(default_factory=list)

    @classmethod
    def between(cls, map_frame: LocalFrame, anchor: LocalFrame) -> "PoseEvaluation":
        """For a map frame and the frame in which the drive's reference is given."""
        return cls(map_frame.T_self_other(anchor))

    def take_reference(self, pose: ReferencePose) -> None:
        """Keep a reference pose."""
        self.reference_t_ns.append(pose.t_ns)
        self.reference_pose.append(self.T_map_anchor @ pose.T_map_vehicle)

    def errors(self) -> dict[str, Any] | None:
        """Quantiles and every single error; None without reference, or without an estimate within its time."""
        if len(self.reference_t_ns) < 2 or not self.estimates:
            return None
        reference = Trajectory(np.array(self.reference_t_ns, np.int64), np.stack(self.reference_pose))
        try:
            nees = nees_of([e for e in self.estimates if e.health == "good"], reference)
            errors = asdict(localisation_error(self.estimates, reference)) | self._single(reference)
            return errors | {"nees": None if nees is None else nees.as_json()}
        except LocaliseError:
            return None

    def _single(self, reference: Trajectory) -> dict[str, Any]:
        """Signed errors along, across (m) and about (deg) the reference's heading, one a refined scan."""
        series = error_series(self.estimates, reference)
        return {
            "t_ns": series.t_ns.tolist(),
            "longitudinal_m": np.round(series.longitudinal, 4).tolist(),
            "lateral_m": np.round(series.lateral, 4).tolist(),
            "heading_deg": np.round(series.heading, 4).tolist(),
        }


@dataclass(slots=True)
class HealthTimeline:
    """When the health changed."""

    changes: list[tuple[int, str]] = field(default_factory=list)

    def note(self, t_ns: int, health: str) -> bool:
        """Keep a change; whether a pose that was known is lost."""
        before = self.changes[-1][1] if self.changes else "lost"
        if not self.changes or before != health:
            self.changes.append((t_ns, health))
        return health == "lost" != before

    def as_json(self) -> list[dict[str, Any]]:
        """One object a change."""
        return [{"t_ns": t_ns, "health": health} for t_ns, health in self.changes]


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write the whole file or nothing of it."""
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    partial.replace(path)
