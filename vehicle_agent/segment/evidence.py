"""Votes into belief: Dempster's rule for "moving" against "static", in closed form."""

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64

U8 = NDArray[np.uint8]

WEIGHTS = 4
"""Weight of a full vote for "static"; others have less."""


def belief(passed: U8, met: U8, mass_moving: float, mass_static: float) -> tuple[F64, F64]:
    """Mass of "moving" and of "static", float64 (V,) each, after `passed` votes and votes of `met` weights together.

    A vote of weight w has the mass 1 - (1 - mass_static)^(w / WEIGHTS). Every vote is a simple support function; equal
    ones combine to 1 - (1 - m)^n, and Dempster's rule joins the two (Shafer 1976, chapter 4). The rest is "not known".
    """
    doubt_moving = (1.0 - mass_moving) ** passed.astype(np.float64)
    doubt_static = (1.0 - mass_static) ** (met / WEIGHTS)
    conflict = (1.0 - doubt_moving) * (1.0 - doubt_static)
    moving = (1.0 - doubt_moving) * doubt_static / (1.0 - conflict)
    static = (1.0 - doubt_static) * doubt_moving / (1.0 - conflict)
    return moving, static
