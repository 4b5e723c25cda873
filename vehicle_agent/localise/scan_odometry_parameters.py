"""Settings of scan-to-scan odometry; units are in the names."""

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class RollingMapParameters:
    """The map of the last scans.

    reach_m, height_m, below_m: the window's half side, its height, and how much of that lies below the vehicle.
    move_m: the window moves when the vehicle is so far from its middle.
    max_voxels: room for so many.
    keep_scans: a voxel not seen in so many added scans is forgotten when the window moves; fade: what a voxel's points
        count for each later scan that sees it.
    min_cells: so many of 64 sub-cells must have been hit. line_ratio, upright: a Gaussian whose second variance is less
        than this share of the first is one ring, unless it is a post (cosine to the vertical).
    """

    reach_m: float = 60.0
    height_m: float = 28.0
    below_m: float = 8.0
    move_m: float = 8.0
    max_voxels: int = 8192
    keep_scans: int = 20
    fade: float = 0.9
    min_cells: int = 6
    line_ratio: float = 0.1
    upright: float = 0.7

    def __post_init__(self) -> None:
        if min(self.reach_m, self.height_m - self.below_m, self.move_m) <= 1 or self.reach_m > 200:
            raise ValueError(f"a window of 1 ... 200 m that rises above the vehicle is required, got {self}")
        if not 0 < self.fade <= 1 or min(self.max_voxels, self.keep_scans, self.min_cells) < 1:
            raise ValueError(f"0 < fade <= 1 and positive counts are required, got {self}")


@dataclass(frozen=True, slots=True)
class ScanOdometryParameters:
    """Scan-to-scan odometry.

    enabled: False leaves the step between two scans to wheel speed and yaw rate alone.
    n_points: so many of a scan's sampled points are matched.
    noise_m, scales, correlation, floor_m, floor_rad, degenerate_m: as in `RegistrationParameters`.
    step_share: a step's variance in that of a match: the matches of a stretch of road share most of their errors.
    steady_m, steady_rad: sigmas of going on as in the step before, which is tried where wheels and gyro lead nowhere;
        coast_s: for so long a vehicle with slipping wheels is taken to go on over scans that match nowhere.
    min_fit, min_matching_ratio: a match that fits worse is not given; min_steady_fit: the same when going on as before.
    min_standing_share: so many of a scan's points must stand above the ground. Rings on open ground keep their place
        relative to the vehicle: they fit best where it stood before, and it seems to be slower than it is.
    gate_m, gate_deg: how far a step may lie from the prediction, beyond three of its sigmas.
    add_m, add_deg: a scan joins the map when the vehicle has moved so far since the last that did; the first
        `first_scans` join in any case.
    max_gap_s: after a longer time without a scan the map begins anew.
    """

    enabled: bool = True
    n_points: int = 1250
    noise_m: float = 0.04
    scales: tuple[float, ...] = (4.0, 2.0)
    correlation: float = 3.0
    floor_m: float = 0.005
    floor_rad: float = 1e-4
    degenerate_m: float = 0.05
    step_share: float = 0.2
    steady_m: float = 0.03
    steady_rad: float = 2e-3
    coast_s: float = 0.5
    min_fit: float = 0.4
    min_steady_fit: float = 0.6
    min_matching_ratio: float = 0.5
    min_standing_share: float = 0.25
    gate_m: float = 0.08
    gate_deg: float = 0.1
    add_m: float = 1.5
    add_deg: float = 5.0
    first_scans: int = 3
    max_gap_s: float = 1.0
    rolling_map: RollingMapParameters = field(default_factory=RollingMapParameters)

    def __post_init__(self) -> None:
        if self.n_points < 100 or min(self.noise_m, self.gate_m, self.gate_deg, self.add_m, self.max_gap_s) <= 0:
            raise ValueError(f"n_points >= 100 and positive gates and steps are required, got {self}")
        if not 0 <= self.min_standing_share < 1:
            raise ValueError(f"0 <= min_standing_share < 1 is required, got {self}")
        if not (0 <= self.min_fit <= 1 and 0 <= self.min_matching_ratio <= 1) or self.first_scans < 1:
            raise ValueError(f"shares within 0 ... 1 and first_scans >= 1 are required, got {self}")
