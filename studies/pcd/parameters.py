"""Parameters of the point-cloud baseline; tuned on world seeds 101 to 105 (docs/pcd_baseline.md)."""

from dataclasses import dataclass, field

from gnd.gnd_map.evidence import MassParameters
from studies.pcd.errors import PcdError


@dataclass(frozen=True, slots=True)
class PcdDetectParameters:
    """How rays become evidence about single points."""

    masses: MassParameters = field(default_factory=lambda: MassParameters(lambda_c_pass=0.05))
    """Evidence of a map point: hits near it (BI) and rays that passed it (PI), Eq. (5) and (7)."""
    lambda_new: float = 0.1
    """A hit where the map has no point says "changed" (Eq. 9)."""
    lambda_empty: float = 0.05
    """A ray that passes a cell where the map has no point says "sustained": nothing stands there."""
    near_m: float = 0.15
    """A hit this close to a map point (across its surface, where it has one) is explained by it."""
    planar_ratio: float = 10.0
    """λ2 / λ1 of the points around a map point from which it lies on a surface (as Eq. 16)."""
    beyond_m: float = 0.15
    """A ray has passed a point on a surface when it ends so far behind the surface."""
    beside_m: float = 0.05
    """A ray has passed a point without surface when it went by this close ..."""
    ahead_m: float = 0.5
    """... and so far before its own end."""
    support_cells: int = 3
    """Evidence of a map point is that of all map points within so many leaf cells."""
    new_support_cells: int = 1
    """The same for new points."""
    min_passes: int = 3
    """Rays through an empty block before it counts as observed."""
    min_pass_points: int = 2
    """Passing rays in the support that a deletion needs."""
    range_min_m: float = 2.0
    """Nearer points are the vehicle itself."""
    range_max_m: float = 50.0
    """Farther hits are not used; their rays still pass what lies within the range."""

    def __post_init__(self) -> None:
        for name in ("lambda_new", "lambda_empty"):
            _check(name, getattr(self, name), 0.0, 0.999)
        for name in ("near_m", "beyond_m", "beside_m", "ahead_m"):
            _check(name, getattr(self, name), 0.0, 10.0)
        _check("support_cells", self.support_cells, 0, 5)
        _check("new_support_cells", self.new_support_cells, 0, 5)
        _check("planar_ratio", self.planar_ratio, 1.0, 1e6)
        _check("range_max_m", self.range_max_m, self.range_min_m, 500.0)

    @property
    def new_masses(self) -> MassParameters:
        """The evidence of a cell without map points: hits are its "passes" (C), rays through it its "hits" (S)."""
        return MassParameters(lambda_s_block=self.lambda_empty, lambda_c_block=0.0, lambda_c_pass=self.lambda_new)


@dataclass(frozen=True, slots=True)
class PcdMergeParameters:
    """How the reports of many vehicles become one point cloud."""

    xi: float = 0.5
    """More than this share of a block's observers must agree (the analogue of ξ_update, GND 5.3)."""
    reach_cells: int = 1
    """New points of several vehicles this many leaf cells apart speak of the same surface."""
    similar: float = 0.8
    """Score: a voxel whose Gaussians before and after are at least this similar counts as not modified."""

    def __post_init__(self) -> None:
        _check("xi", self.xi, 0.0, 0.999)
        _check("reach_cells", self.reach_cells, 0, 3)
        _check("similar", self.similar, 0.0, 1.0)


def _check(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise PcdError(f"{name} = {value} lies outside {low} ... {high}")
