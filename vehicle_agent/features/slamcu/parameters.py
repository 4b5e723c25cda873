"""Parameters of SLAMCU; the defaults are the paper's where it names a value (section 6.2)."""

from dataclasses import dataclass

from gnd.gnd_map.settings import check_settings, setting
from gnd.vehicle_agent.features.errors import SlamcuParameterError


@dataclass(frozen=True, slots=True)
class SlamcuParameters:
    """Existence and filter. The errors of the sensors are constants (`noise.py`)."""

    particles: int = setting(
        1000, "Number M of particles; one is enough where poses are given and certain.", least=1, most=100_000
    )
    detection_confidence: float = setting(
        0.9, "Confidence in a detection: λ of Eq. (1) and (2).", least=1e-3, most=0.999
    )

    def __post_init__(self) -> None:
        check_settings(self, SlamcuParameterError)
