"""Parameters of change detection: the paper's own in `paper` mode, the measured improvements in `default` mode."""

from dataclasses import dataclass, field
from typing import Literal

from gnd.gnd_map.evidence import MassParameters
from gnd.vehicle_agent.detect.uncertainty import PoseUncertainty
from gnd.vehicle_agent.errors import VehicleError

Mode = Literal["paper", "default"]
PassRule = Literal["ml", "ahead", "plane"]


class DetectParameterError(VehicleError):
    """A detection parameter lies outside its range."""


@dataclass(frozen=True, slots=True)
class SoftParameters:
    """How the uncertainty of the poses softens the evidence; 0 switches a rule off.

    The variance of a ray's end, s², is the position's and, times the squared range, the heading's, less `included_m`².
    """

    included_m: float = 0.05
    """So much uncertainty `block_noise_m` and the others stand for: poses that good soften nothing."""
    block: float = 1.0
    """BI/BO: this share of s² is added to `block_noise_m`², along the axis in which the Gaussian is thin."""
    beyond_sigmas: float = 2.0
    """PI: a ray must end farther behind the plane by this many s (root of the sum of squares with `beyond_m`)."""

    similarity: float = 1.0
    """This share of s² of a tile's points is added to Σi + Σj where the new Gaussian is compared with the map's."""

    def __post_init__(self) -> None:
        """Each value within its range, or `DetectParameterError` with the value."""
        for name in ("included_m", "block", "beyond_sigmas", "similarity"):
            _check(f"soft.{name}", getattr(self, name), 0.0, 10.0)

    @classmethod
    def off(cls) -> "SoftParameters":
        """Poses are taken for exact, as in the paper."""
        return cls(block=0.0, beyond_sigmas=0.0, similarity=0.0)

    def excess_m2(self, pose: PoseUncertainty) -> float:
        """Return s² of points at the pose's range."""
        return max(pose.of_points_m**2 - self.included_m**2, 0.0)


@dataclass(frozen=True, slots=True)
class DetectParameters:
    """How rays become evidence and evidence becomes classes.

    Paper mode is `DetectParameters.paper()`: Eq. (1) to (12) taken plainly. The defaults add what was measured to help.
    """

    mode: Mode = "default"
    masses: MassParameters = field(default_factory=lambda: MassParameters(lambda_c_pass=0.05))
    """λcp is larger than the paper's 0.01 because `plane` lets few rays pass that have not: 14 of them delete."""
    eta_block: float = 0.95
    """η_bound of Eq. (1) for points that end in a voxel."""
    block_noise_m: float = 0.05
    """Standard deviation added to the map's Gaussian for BI/BO: thin covariances turn 3 cm of noise into "outside"."""
    passing_rule: PassRule = "plane"
    """`ml`: Eq. (4) plainly; `ahead`: the same, only where the crossing lies `ahead_m` before the hit; `plane`: a
    planar Gaussian counts as passed only where the ray crosses its plane and ends `beyond_m` behind it."""
    eta_pass: float = 0.9
    """η_bound of Eq. (4) for rays that pass."""
    eta_plane: float = 0.97
    """The same for the point where a ray crosses the plane of a planar Gaussian."""
    pass_noise_m: float = 0.01
    """Keeps the whitening of flat Gaussians finite."""
    ahead_m: float = 1.0
    beyond_m: float = 0.15
    planar_ratio: float = 10.0
    """λ2 / λ1 from which a Gaussian is planar (the paper's ratio, Eq. 16)."""
    face_m: float = 0.10
    """A blocked point this close to a face is ignored where the neighbour's Gaussian explains it; 0 switches off."""
    face_sigma: float = 3.0
    range_min_m: float = 2.0
    """Nearer points are the vehicle itself."""
    range_max_m: float = 50.0
    """Farther hits are not used; their rays still pass what lies within the range."""
    min_cells: int = 20
    """Occupied 10 cm sub-cells that make a Gaussian, the same rule as the map's."""
    new_cells: int = 30
    """The same where the map has none: noise and the error of poses thicken a surface, on real scans nine in ten false
    new voxels had fewer than 38 sub-cells."""
    new_cells_at_edge: int = 45
    """The same within `edge_m` of the plane of a planar Gaussian of the map next door: the edge of a known surface."""
    edge_m: float = 0.15
    weak_cells: int = 5
    """From here to `min_cells` a voxel has hits, but too few for a Gaussian: it abstains (see `many_rays`)."""
    min_passes: int = 3
    """Rays through an empty voxel before it counts as observed empty."""
    many_rays: int = 100
    """So many rays into a voxel without a Gaussian make too few hits a statement: by the one rule it is empty."""
    empty_cells: int = 15
    """From here on a voxel is never called empty: another vehicle may find the sub-cells that are missing."""
    min_pass_inside: int = 3
    """PI rays that a deletion needs."""
    reshaped_log_odds: float = -0.4
    """A measured Gaussian is of another shape than the map's from these log-odds on (see `shape_change`)."""
    soft: SoftParameters = field(default_factory=SoftParameters)
    """What the uncertainty of the poses changes."""

    def __post_init__(self) -> None:
        """Each value within its range, or `DetectParameterError` with the value."""
        for name in ("eta_block", "eta_pass", "eta_plane"):
            _check(name, getattr(self, name), 0.0, 1.0, open_ends=True)
        _check("face_m", self.face_m, 0.0, 0.4)
        _check("pass_noise_m", self.pass_noise_m, 1e-4, 1.0)
        _check("block_noise_m", self.block_noise_m, 1e-4, 1.0)
        _check("range_max_m", self.range_max_m, self.range_min_m, 500.0, open_ends=True)
        _check("reshaped_log_odds", self.reshaped_log_odds, -10.0, 10.0)
        _check("weak_cells", self.weak_cells, 1, self.min_cells)
        _check("new_cells", self.new_cells, self.min_cells, 1000)
        _check("new_cells_at_edge", self.new_cells_at_edge, self.new_cells, 1000)
        _check("edge_m", self.edge_m, 0.0, 1.0)

    @classmethod
    def paper(cls) -> "DetectParameters":
        """Eq. (1) to (12) plainly: 1 cm keeps Σ invertible, every hit counts, evidence alone decides."""
        return cls(
            mode="paper",
            masses=MassParameters(lambda_s_block=0.2, lambda_c_block=0.05, lambda_c_pass=0.01),
            eta_block=0.95,
            eta_pass=0.95,
            block_noise_m=0.01,
            passing_rule="ml",
            face_m=0.0,
            new_cells=20,
            weak_cells=1,
            min_passes=1,
            min_pass_inside=1,
            soft=SoftParameters.off(),
        )


def _check(name: str, value: float, low: float, high: float, *, open_ends: bool = False) -> None:
    inside = low < value < high if open_ends else low <= value <= high
    if not inside:
        raise DetectParameterError(f"{name} = {value} lies outside {low} ... {high}")
