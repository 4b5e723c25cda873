"""Parameters of motion segmentation."""

from dataclasses import dataclass

from gnd.vehicle_agent.errors import VehicleError


class SegmentParameterError(VehicleError):
    """A parameter of motion segmentation lies outside its range."""


@dataclass(frozen=True, slots=True)
class SegmentParameters:
    """Which scans are compared, what counts as passing, and when an object moves."""

    enabled: bool = True
    """Without it every point is taken for static."""
    past_s: float = 4.0
    """Scans this much older are compared."""
    future_s: float = 1.2
    """Scans this much newer are compared: a scan waits this long. What drives away ahead shows only there."""
    every_s: float = 0.3
    """Time between the scans that are kept for comparison."""
    settled_s: float = 1.0
    """A return at the same place counts the less the nearer in time below this: what moves still covers its place."""
    apart_s: float = 0.15
    """Scans nearer in time show too little motion."""
    range_min_m: float = 2.0
    """Nearer points are the vehicle itself."""
    range_max_m: float = 50.0
    """Farther points are not judged (they count as static): beyond the range of detection."""
    column_deg: float = 0.3
    """Width of the range images' columns, at least the spacing of the sensor's shots."""
    row_deg: float = 0.4
    """Height of their rows at the horizon; rows are even in the tangent of the elevation."""
    reach_across_m: float = 0.15
    """How far from a point a ray may pass at its side and still speak about it."""
    reach_up_m: float = 0.3
    """The same above and below: layers are far apart."""
    margin_m: float = 0.45
    """A ray passes a point where it ends farther behind it than this …"""
    margin_share: float = 0.01
    """… plus this share of the range."""
    mass_moving: float = 0.5
    """Mass that one passing ray gives to "moving"."""
    mass_static: float = 0.6
    """Mass that one return at the same place gives to "static"."""
    ground_cell_m: float = 1.0
    ground_slope: float = 0.15
    """The ground rises no steeper than this."""
    road_slope: float = 0.02
    """It rises no steeper than this over the plane of the road under the vehicle."""
    ground_m: float = 0.25
    """What lies lower than this over the ground is no object by itself; it goes with what stands above it."""
    feet_m: float = 0.1
    """What lies lower than this over the ground is the ground."""
    voxel_m: float = 0.3
    """Points this near to each other are judged together, and objects farther apart are two."""
    moving_share: float = 0.3
    """Share of moving voxels that makes a whole object move."""
    min_voxels: int = 2
    """Moving voxels that an object needs."""
    part_voxels: int = 6
    """Adjacent moving voxels that are taken out of an object which as a whole stands."""

    def __post_init__(self) -> None:
        """Each value within its range, or `SegmentParameterError` with the value."""
        for name in (
            "past_s",
            "future_s",
            "apart_s",
            "reach_across_m",
            "reach_up_m",
            "margin_share",
            "ground_slope",
            "road_slope",
        ):
            self._check(name, 0.0, 100.0)
        for name in ("mass_moving", "mass_static"):
            self._check(name, 0.01, 0.99)
        for name in ("column_deg", "row_deg"):
            self._check(name, 0.05, 5.0)
        for name in ("every_s", "margin_m", "ground_m", "voxel_m", "ground_cell_m"):
            self._check(name, 0.01, 10.0)
        self._check("moving_share", 0.0, 1.0)
        self._check("min_voxels", 1, 1000)
        self._check("part_voxels", 1, 1000)
        self._check("range_max_m", self.range_min_m, 300.0)
        self._check("feet_m", 0.0, self.ground_m)

    def _check(self, name: str, low: float, high: float) -> None:
        value = getattr(self, name)
        if not low <= value <= high:
            raise SegmentParameterError(f"{name} = {value} lies outside {low} … {high}")
