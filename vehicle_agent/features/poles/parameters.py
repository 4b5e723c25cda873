"""Parameters of the pole detector."""

from dataclasses import dataclass

from gnd.vehicle_agent.errors import VehicleError


class PoleError(VehicleError):
    """Base of what the pole detector raises."""


class PoleParameterError(PoleError):
    """A parameter of the pole detector lies outside its range."""


class PoleInputError(PoleError):
    """Points that are no scan: wrong shape, or rays without an origin."""


@dataclass(frozen=True, slots=True)
class PoleParameters:
    """What counts as a pole, and how exact the sensor is. Tuned on the streets 101 to 105."""

    range_min_m: float = 2.0
    """Nearer points are the vehicle itself."""
    range_max_m: float = 40.0
    """Farther points are left out: a ring hits a post once or not at all there."""
    ground_cell_m: float = 1.0
    ground_slope: float = 0.12
    """The ground rises no steeper than this."""
    feet_m: float = 0.25
    """What lies lower over the ground is the ground."""
    row_deg: float = 0.4
    """Rays whose elevations differ by less are neighbours of a row; rows are even in the tangent of the elevation."""
    link_m: float = 0.25
    """Neighbours of a row whose ranges differ by less lie on one thing."""
    diameter_max_m: float = 0.55
    """Beams have a width: 0.5 m of a trunk measure this."""
    clear_m: float = 0.35
    """So far beside a pole nothing stands at its range, on at least one side …"""
    jump_m: float = 0.4
    """… nor behind it by less than this."""
    axis_m: float = 0.25
    """Slices one above the other lie so near to each other in plan."""
    layers_apart: float = 1.6
    """A pole goes on where the next slice is so many layers of the sensor away …"""
    gap_m: float = 0.6
    """… or so far above."""
    wider_m: float = 0.15
    """Slices that are wider than the thin ones of their pole by this much are a plate or a foot."""
    min_slices: int = 3
    min_points: int = 4
    min_length_m: float = 0.8
    """Length of the thin part that is visible."""
    min_top_m: float = 1.9
    """Height over the ground that it reaches."""
    lean_max: float = 0.12
    """Horizontal metres a metre upwards."""
    scatter_max_m: float = 0.08
    """Standard deviation of the slices about the axis, beside what the sensor's noise and its rays' distance make."""
    ring_share_max: float = 0.5
    """Share of the heights of a pole's thin part at which something stands in the ring around it …"""
    free_m: float = 0.75
    """… and length of a part of it at which nothing does."""
    hidden_share_max: float = 0.65
    """Share of its slices beside which something nearer stands: all of them are beside an edge, not on a thin thing."""
    seen_share_min: float = 0.4
    """Share of the sensor's layers between bottom and top that meet it."""
    foot_m: float = 0.5
    """A pole begins no higher over the ground, but for the next lower layer, unless its foot is hidden."""
    body_diameter_m: float = 0.3
    """What is thicker than this …"""
    body_top_m: float = 2.2
    """… and lower than this is somebody who stands there."""
    streetlight_m: float = 5.0
    """Lower posts are no streetlights."""
    sigma_range_m: float = 0.03
    """Noise of a range: VLP-16 user manual 63-9243, ±3 cm."""
    sigma_tilt_rad: float = 0.02
    """Of a vehicle that does not know how it and the road are tilted: of single looks in its own frame."""
    sigma_floor_m: float = 0.015
    """What more points do not improve: calibration of the lasers, the pose within the sweep."""

    def __post_init__(self) -> None:
        """Each value within its range, or `PoleParameterError` with the value."""
        lengths = (
            "ground_cell_m",
            "link_m",
            "diameter_max_m",
            "clear_m",
            "jump_m",
            "axis_m",
            "gap_m",
            "min_length_m",
            "wider_m",
        )
        for name in (*lengths, "row_deg", "layers_apart", "scatter_max_m", "sigma_range_m", "sigma_floor_m"):
            self._check(name, 0.001, 10.0)
        for name in ("range_min_m", "feet_m", "min_top_m", "foot_m", "body_diameter_m", "body_top_m", "streetlight_m"):
            self._check(name, 0.0, 20.0)
        for name in (
            "ground_slope",
            "lean_max",
            "ring_share_max",
            "free_m",
            "seen_share_min",
            "hidden_share_max",
            "sigma_tilt_rad",
        ):
            self._check(name, 0.0, 1.0)
        self._check("range_max_m", self.range_min_m + self.ground_cell_m, 200.0)
        self._check("min_slices", 2, 1000)
        self._check("min_points", 2, 1000)

    def _check(self, name: str, low: float, high: float) -> None:
        value = getattr(self, name)
        if not low <= value <= high:
            raise PoleParameterError(f"{name} = {value} lies outside {low} … {high}")
