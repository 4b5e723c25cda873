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
class DetectParameters:
    """How rays become evidence and evidence becomes classes.

    Paper mode is `DetectParameters.paper()`: Eq. (1) to (12) taken plainly. The defaults add what was measured to help.
    """

    mode: Mode = setting(
        "default",
        'Rules of detection: the paper\'s own, or with what was measured to help. "paper" has other defaults.',
    )
    masses: MassParameters = setting(
        MassParameters(lambda_c_pass=0.05),
        "The evidence model. λcp is larger than the paper's 0.01 because `plane` lets few rays pass that have not: 14"
        " of them delete.",
    )
    block_noise_m: float = setting(
        0.05,
        "Standard deviation added to the map's Gaussian for BI/BO: thin covariances turn 3 cm of noise into outside.",
        unit="m",
        least=1e-4,
        most=1,
    )
    passing_rule: PassRule = setting(
        "plane",
        "`ml`: Eq. (4) plainly; `ahead`: the same, only where the crossing lies 1 m before the hit; `plane`: a planar"
        " Gaussian counts as passed only where the ray crosses its plane and ends 15 cm behind it.",
    )
    eta_pass: float = setting(0.9, "η_bound of Eq. (4) for rays that pass.", above=0, below=1)
    face_m: float = setting(
        0.10,
        "A blocked point this close to a face is ignored where the neighbour's Gaussian explains it; 0 switches off.",
        unit="m",
        least=0,
        most=0.4,
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
        30,
        "Occupied 10 cm sub-cells that make a Gaussian where the map has none: noise and the error of poses thicken a"
        " surface, on real scans nine in ten false new voxels had fewer than 38.",
        least=MIN_CELLS,
        most=1000,
    )
    new_cells_at_edge: int = setting(
        45,
        "The same at the edge of a known surface: within 15 cm of the plane of a planar Gaussian of the map next door;"
        " at least `new_cells`.",
        least=MIN_CELLS,
        most=1000,
    )
    weak_cells: int = setting(
        5, "From here on a voxel has hits, but too few for a Gaussian: it abstains.", least=1, most=MIN_CELLS
    )
    min_passes: int = setting(3, "Rays through an empty voxel before it counts as observed empty.", least=1)
    min_pass_inside: int = setting(3, "Rays through a Gaussian (PI) that a deletion needs.", least=0)
    soft: bool = setting(True, "Whether the uncertainty of the poses softens the evidence.")

    def __post_init__(self) -> None:
        """Each value within its range, or `DetectParameterError` with the value."""
        check_settings(self, DetectParameterError)
        if self.new_cells_at_edge < self.new_cells:
            raise DetectParameterError(
                f"new_cells_at_edge = {self.new_cells_at_edge} must be at least new_cells = {self.new_cells}"
            )
        if self.range_max_m <= self.range_min_m:
            raise DetectParameterError(f"range_max_m = {self.range_max_m} must exceed range_min_m = {self.range_min_m}")

    def excess_m2(self, pose: PoseUncertainty) -> float:
        """Variance of points at the pose's range beyond what `block_noise_m` and the others stand for."""
        return max(pose.of_points_m**2 - INCLUDED_M**2, 0.0) if self.soft else 0.0

    @classmethod
    def of_mode(cls, mode: Mode) -> "DetectParameters":
        """The defaults of a mode."""
        return cls.paper() if mode == "paper" else cls()

    @classmethod
    def paper(cls) -> "DetectParameters":
        """Eq. (1) to (12) plainly: 1 cm keeps Σ invertible, every hit counts, evidence alone decides."""
        return cls(
            mode="paper",
            masses=MassParameters(lambda_s_block=0.2, lambda_c_block=0.05, lambda_c_pass=0.01),
            eta_pass=0.95,
            block_noise_m=0.01,
            passing_rule="ml",
            face_m=0.0,
            new_cells=20,
            weak_cells=1,
            min_passes=1,
            min_pass_inside=1,
            soft=False,
        )
