"""Parameters of change detection: the paper's own in `paper` mode, the measured improvements in `default` mode."""

from dataclasses import dataclass
from typing import Final, Literal

from gnd.gnd_map.evidence import MassParameters
from gnd.gnd_map.settings import check_settings, setting
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty
from gnd.vehicle_agent.errors import VehicleError

Mode = Literal["paper", "default"]
PassRule = Literal["ml", "ahead", "plane"]

MIN_CELLS: Final = 20
"""Occupied 10 cm sub-cells that make a Gaussian, the same rule as the map's."""
INCLUDED_M: Final = 0.05
"""So much uncertainty of the poses `block_noise_m` and the others stand for: poses that good soften nothing."""


class DetectParameterError(VehicleError):
    """A detection parameter lies outside its range."""


@dataclass(frozen=True, slots=True)
class DetectRules:
    """How rays become evidence and evidence becomes classes, by a mode's rules.

    Attributes:
        block_noise_m: standard deviation added to the map's Gaussian for BI and BO.
        passing_rule: `ml`: Eq. (4) plainly; `ahead`: the same, only where the crossing lies 1 m before the hit;
            `plane`: a planar Gaussian counts as passed only where the ray crosses its plane and ends 15 cm behind it.
        eta_pass: η_bound of Eq. (4) for rays that pass.
        face_m: a blocked point this close to a face is ignored where the neighbour's Gaussian explains it; 0: none is.
        weak_cells: from here on a voxel has hits, but too few for a Gaussian: it abstains.
        min_passes: rays through an empty voxel before it counts as observed empty.
        soft: whether the uncertainty of the poses softens the evidence.
    """

    block_noise_m: float
    passing_rule: PassRule
    eta_pass: float
    face_m: float
    weak_cells: int
    min_passes: int
    soft: bool


PAPER_RULES: Final = DetectRules(
    block_noise_m=0.01, passing_rule="ml", eta_pass=0.95, face_m=0.0, weak_cells=1, min_passes=1, soft=False,
)  # fmt: skip
"""Eq. (1) to (12) plainly: 1 cm keeps Σ invertible, every hit counts, evidence alone decides."""
MEASURED_RULES: Final = DetectRules(
    block_noise_m=0.05, passing_rule="plane", eta_pass=0.9, face_m=0.10, weak_cells=5, min_passes=3, soft=True,
)  # fmt: skip
"""What was measured to help: thin covariances turn 3 cm of noise into outside (`block_noise_m`)."""


@dataclass(frozen=True, slots=True)
class DetectParameters:
    """Settings of change detection; the mode chooses the rules. Paper mode is `DetectParameters.paper()`.

    Attributes:
        own_rules: in place of the mode's, for a study of single rules; no setting.
    """

    mode: Mode = setting(
        "default",
        'Rules of detection: the paper\'s own, or with what was measured to help. "paper" has other defaults.',
    )
    masses: MassParameters = setting(
        MassParameters(lambda_c_pass=0.05),
        "The evidence model. λcp is larger than the paper's 0.01 because few rays are taken to pass that have not: 14"
        " of them delete.",
    )
    range_min_m: float = setting(2.0, "Nearer points are the vehicle itself.", unit="m", least=0)
    range_max_m: float = setting(
        50.0,
        "Farther hits are not used; their rays still pass what lies within the range. More than `range_min_m`.",
        unit="m",
        above=0,
        below=500,
    )
    new_cells: int = setting(
        18,
        "Occupied 10 cm sub-cells that make a Gaussian where the map has none, as many as half of the points would"
        " fill; twice as many at the edge of a known surface: noise and the error of poses thicken it.",
        least=10,
        most=1000,
    )
    together: bool = setting(
        False,
        "Whether to tell the cloud what was met and not decided upon, which adds it up over vehicles with"
        " `merge.together`. It helps on motorways; where the map was made from few drives it publishes what they saw"
        " too little of.",
    )
    own_rules: DetectRules | None = None

    def __post_init__(self) -> None:
        """Each value within its range, or `DetectParameterError` with the value."""
        check_settings(self, DetectParameterError)
        if self.range_max_m <= self.range_min_m:
            raise DetectParameterError(f"range_max_m = {self.range_max_m} must exceed range_min_m = {self.range_min_m}")

    @property
    def rules(self) -> DetectRules:
        """Those of the mode, or `own_rules`."""
        return self.own_rules or (PAPER_RULES if self.mode == "paper" else MEASURED_RULES)

    @property
    def new_cells_at_edge(self) -> int:
        """`new_cells` at the edge of a known surface: within 15 cm of the plane of a planar Gaussian next door."""
        return self.new_cells * 2

    def excess_m2(self, pose: PoseUncertainty) -> float:
        """Variance of points at the pose's range beyond what `block_noise_m` and the others stand for."""
        return max(pose.of_points_m**2 - INCLUDED_M**2, 0.0) if self.rules.soft else 0.0

    @classmethod
    def paper(cls) -> "DetectParameters":
        """The defaults of paper mode."""
        return cls(mode="paper", masses=MassParameters(0.2, 0.05, 0.01), new_cells=20)
