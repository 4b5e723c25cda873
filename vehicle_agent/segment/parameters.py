"""Settings of motion segmentation."""

from dataclasses import dataclass
from typing import Final

from gnd.gnd_map.settings import check_settings, setting
from gnd.vehicle_agent.errors import VehicleError

RANGE_MIN_M: Final = 2.0
"""Nearer points are the vehicle itself."""
PAST_S: Final = 4.0
"""Scans this much older are compared."""


class SegmentParameterError(VehicleError):
    """A parameter of motion segmentation lies outside its range."""


@dataclass(frozen=True, slots=True)
class SegmentParameters:
    """Which scans are compared."""

    enabled: bool = setting(True, "Without it every point is taken for static.")
    future_s: float = setting(
        1.2,
        "Scans this much newer are compared: a scan waits this long. What drives away ahead shows only there.",
        unit="s",
        least=0,
        most=100,
    )
    range_max_m: float = setting(
        50.0,
        "Farther points are not judged (they count as static).",
        unit="m",
        least=RANGE_MIN_M,
        most=300,
    )

    def __post_init__(self) -> None:
        """Each value within its range, or `SegmentParameterError` with the value."""
        check_settings(self, SegmentParameterError)
