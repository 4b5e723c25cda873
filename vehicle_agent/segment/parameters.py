"""Settings of motion segmentation."""

from dataclasses import dataclass

from gnd.gnd_map.settings import check_settings, setting
from gnd.vehicle_agent.errors import VehicleError


class SegmentParameterError(VehicleError):
    """A parameter of motion segmentation lies outside its range."""


@dataclass(frozen=True, slots=True)
class SegmentParameters:
    """Which scans are compared."""

    enabled: bool = setting(True, "Without it every point is taken for static.")
    past_s: float = setting(4.0, "Scans this much older are compared.", unit="s", least=0, most=100)
    future_s: float = setting(
        1.2,
        "Scans this much newer are compared: a scan waits this long. What drives away ahead shows only there.",
        unit="s",
        least=0,
        most=100,
    )
    range_min_m: float = setting(2.0, "Nearer points are the vehicle itself.", unit="m", least=0)
    range_max_m: float = setting(
        50.0,
        "Farther points are not judged (they count as static); at least `range_min_m`.",
        unit="m",
        least=0,
        most=300,
    )

    def __post_init__(self) -> None:
        """Each value within its range, or `SegmentParameterError` with the value."""
        check_settings(self, SegmentParameterError)
        if self.range_max_m < self.range_min_m:
            raise SegmentParameterError(
                f"range_max_m = {self.range_max_m} lies outside {self.range_min_m} … 300 (range_min_m and on)"
            )
