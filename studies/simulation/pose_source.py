"""Where the poses of the scans come from: `true`, `noisy:4cm:0.08deg`, `estimated`."""

import re
from dataclasses import dataclass
from math import degrees, radians
from typing import Final, Literal

from studies.simulation.errors import OptionError

Kind = Literal["true", "noisy", "estimated"]

_METRES: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_RADIANS: Final = {"deg": radians(1.0), "mrad": 1e-3, "rad": 1.0}
_NUMBER: Final = r"(\d+\.?\d*|\.\d+)(?:[eE]-?\d+)?"
_NOISY: Final = re.compile(rf"noisy:(?P<m>{_NUMBER})(?P<m_unit>mm|cm|m):(?P<rad>{_NUMBER})(?P<rad_unit>deg|mrad|rad)")
_MAX_SIGMA_M: Final = 1.0
_MAX_SIGMA_RAD: Final = radians(5.0)


@dataclass(frozen=True, slots=True)
class PoseSource:
    """How the poses of a drive are made.

    Attributes:
        kind: "true": the reference poses; "noisy": the same with an error; "estimated": the vehicle's own localiser.
        sigma_m: standard deviation on each horizontal axis.
        sigma_rad: of the heading.
    """

    kind: Kind = "noisy"
    sigma_m: float = 0.04
    sigma_rad: float = radians(0.08)

    def __post_init__(self) -> None:
        if not 0.0 <= self.sigma_m <= _MAX_SIGMA_M or not 0.0 <= self.sigma_rad <= _MAX_SIGMA_RAD:
            raise OptionError(
                f"poses may be off by at most {_MAX_SIGMA_M:g} m and {degrees(_MAX_SIGMA_RAD):g} deg,"
                f" got {self.sigma_m:g} m and {degrees(self.sigma_rad):g} deg"
            )

    @classmethod
    def parse(cls, text: str) -> "PoseSource":
        """Read `true`, `estimated` or `noisy:<length><mm|cm|m>:<angle><deg|mrad|rad>`.

        Raises:
            OptionError: it is none of these.
        """
        if text in ("true", "estimated"):
            return cls("true" if text == "true" else "estimated", 0.0, 0.0)
        found = _NOISY.fullmatch(text)
        if found is None:
            raise OptionError(f"poses are true, estimated or such as noisy:4cm:0.08deg, got {text!r}")
        return cls(
            "noisy", float(found["m"]) * _METRES[found["m_unit"]], float(found["rad"]) * _RADIANS[found["rad_unit"]]
        )

    def __str__(self) -> str:
        if self.kind != "noisy":
            return self.kind
        return f"noisy:{self.sigma_m * 100:.10g}cm:{degrees(self.sigma_rad):.10g}deg"
