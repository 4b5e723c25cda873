"""How statements become changes: the parameters of the cloud merge."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, get_args

from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.statements import Mode, Report
from gnd.gnd_map.settings import check_settings, setting
from gnd.schemas.changes import TileChange

MERGE_NOISE_M: Final = 0.05
"""Added (squared) to the covariances that the default similarity compares. It stands for poses known to so much; what a
report's poses are worse than that is added for this report."""
MERGE_XI_RESHAPED: Final = 0.5
"""ξ of a cluster most of which denies the epoch's own Gaussian ("modified"). Lower, because a shape is judged
less surely than a presence, and a parked car seldom touches what the map holds."""
MERGE_D_UPDATE: Final = 0.5
"""Published when the candidate's similarity to the epoch's voxel is smaller than this."""
MERGE_D_DENIED: Final = 0.95
"""The same where most of the candidate's statements were compared with that voxel and deny it."""
MERGE_D_RENEWED: Final = 0.9
"""A representative of more measurements takes the place of an earlier one that is less like it."""
MERGE_POSE_LEVER_M: Final = 20.0
"""At this range the heading of a report's poses is counted as a position."""


@dataclass(frozen=True, slots=True)
class MergeParameters:
    """How statements become changes."""

    mode: Mode = setting(
        "default",
        '"paper": only uploaded changes count (GND as printed, with the corrections without which it cannot '
        'run); "paper-observers": the same, but ξ is a share of all who observed the voxel; "default": the votes are '
        "those of all who observed the voxel, and similarity is the smooth one.",
    )
    eps: float = setting(
        0.7,
        "DBSCAN's neighbourhood on 1 - similarity; 0.5 splits the votes of vehicles that saw parts of one thing.",
        above=0,
        below=1,
    )
    min_samples: int = setting(1, "DBSCAN's core weight.", least=1)
    xi: float = setting(
        0.6,
        "A cluster must hold more than this share of the voxel's statements (ξ_update).",
        least=0,
        below=1,
    )
    together: bool = setting(
        False,
        "Whether what vehicles met and did not decide upon is added up; vehicles tell of it with `detect.together`. "
        "Off: it counts for nothing.",
    )
    poses: bool = setting(True, "Whether what the reports tell of their poses counts at all.")
    pose_weight_m: float = setting(
        0.1,
        "A report whose poses are this much worse than `noise_m` has half a vote; 0: poses do not weigh.",
        unit="m",
        least=0,
        most=1000,
    )
    sensor_weights: Mapping[str, float] = setting(
        {"Scala": 0.5},
        "Weight of a vote by sensor model, 1 for the others; the paper's modes do not weigh.",
    )

    def __post_init__(self) -> None:
        if self.mode not in get_args(Mode):
            raise MergerError(f"mode must be one of {', '.join(get_args(Mode))}, got {self.mode!r}")
        check_settings(self, MergerError)
        for model, weight in self.sensor_weights.items():
            if not 0 < weight <= 1:
                raise MergerError(f"the weight of {model} must lie in (0, 1], got {weight}")

    @property
    def has_paper_rules(self) -> bool:
        """Whether the rules are the paper's, in either reading of ξ."""
        return self.mode != "default"

    def weight_of(self, sensor_model: str) -> float:
        """Return the weight of a vote of this sensor."""
        return self.sensor_weights.get(sensor_model, 1.0) if self.mode == "default" else 1.0

    def pose_m2_of(self, change: TileChange) -> float:
        """Return the variance of what a report measured by its poses, beyond what `noise_m` stands for."""
        if self.has_paper_rules or not self.poses:
            return 0.0
        at_lever_m = MERGE_POSE_LEVER_M * change.pose_sigma_rad
        return max(change.pose_sigma_m**2 + at_lever_m**2 - MERGE_NOISE_M**2, 0.0)

    def report_of(self, report_id: str, sensor_model: str, change: TileChange) -> Report:
        """Return a report's part about one tile with the weight of its votes, by sensor and poses."""
        pose_m2, half_m2 = self.pose_m2_of(change), self.pose_weight_m**2
        share = half_m2 / (half_m2 + pose_m2) if half_m2 > 0.0 else 1.0
        return Report(report_id, change, self.weight_of(sensor_model) * share, pose_m2, model=sensor_model)
