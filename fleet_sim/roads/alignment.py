"""How a road bends: straights and arcs in turn, with clothoids between, drawn so that it never meets itself again."""

from dataclasses import dataclass
from typing import Final

import numpy as np

_TURN_BACK_RAD: Final = 0.3
_ARC_RAD: Final = 0.9
"""A road that has turned farther than the first bends back; with the second and two clothoids it stays below 90° from
where it set out to, and so never crosses itself."""


@dataclass(frozen=True, slots=True)
class Bends:
    """Least and greatest size of the elements of a road, each drawn evenly but radii evenly in their logarithm.

    Attributes:
        radius_m: of arcs.
        straight_m: straights.
        arc_m: arcs, shortened where they would turn by more than 0.9 rad.
        clothoid_m: clothoids; at most 0.28 times the least radius.
    """

    radius_m: tuple[float, float]
    straight_m: tuple[float, float]
    arc_m: tuple[float, float]
    clothoid_m: tuple[float, float]


def drawn_bends(bends: Bends, length_m: float, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Return the pieces (length [m], curvature at its end [1/m]) of a road, as `curve.of_curvature` takes them."""
    pieces: list[tuple[float, float]] = []
    left_m, turned_rad = length_m, 0.0
    while left_m > 0:
        radius_m = float(np.exp(rng.uniform(*np.log(bends.radius_m))))
        side = float(rng.choice((-1.0, 1.0)))
        side = -float(np.sign(turned_rad)) if abs(turned_rad) > _TURN_BACK_RAD else side
        straight, arc, clothoid = (
            float(rng.uniform(*span)) for span in (bends.straight_m, bends.arc_m, bends.clothoid_m)
        )
        arc, curvature = min(arc, _ARC_RAD * radius_m), side / radius_m
        turned_rad += (arc + clothoid) * curvature
        for piece, end in ((straight, 0.0), (clothoid, curvature), (arc, curvature), (clothoid, 0.0)):
            if left_m > 0:
                pieces.append((min(piece, left_m), end))
            left_m -= piece
    return pieces
