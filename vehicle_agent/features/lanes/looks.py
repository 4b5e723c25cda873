"""What a camera's lane detector sees in one look: points on borders of lanes, and what each border looks like."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.schemas.limits import MAX_POINTS_OF_LANE_LOOK
from gnd.vehicle_agent.features.errors import BadLook

Marking = Literal["solid", "dashed"]
Colour = Literal["white", "yellow"]
MAX_BORDER_RANGE_M: Final = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class BorderLook:
    """One look of a camera.

    Attributes:
        xy_m: (N, 2) vehicle frame, points on the middle of the paint.
        line: (N,) number of the border in this look.
        markings: of each border, solid or dashed as the detector takes it.
        colours: of each border.
    """

    xy_m: F64
    line: I64
    markings: tuple[Marking, ...]
    colours: tuple[Colour, ...]

    def __post_init__(self) -> None:
        n = len(self.xy_m)
        if np.shape(self.xy_m) != (n, 2) or np.shape(self.line) != (n,):
            raise BadLook(f"borders: points of shape {np.shape(self.xy_m)}, lines of shape {np.shape(self.line)}")
        if n > MAX_POINTS_OF_LANE_LOOK:
            raise BadLook(f"a look of {n} points of borders, at most {MAX_POINTS_OF_LANE_LOOK}")
        if not np.isfinite(self.xy_m).all() or (n and np.abs(self.xy_m).max() > MAX_BORDER_RANGE_M):
            raise BadLook(f"points of borders not finite, or farther than {MAX_BORDER_RANGE_M:.0f} m")
        if len(self.markings) != len(self.colours) or (
            n and not 0 <= self.line.min() <= self.line.max() < len(self.markings)
        ):
            raise BadLook(f"lines {self.line.min()} … {self.line.max()} of {len(self.markings)} borders")
