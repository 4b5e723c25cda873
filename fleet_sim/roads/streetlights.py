"""A motorway with streetlights, like the Korean one of Kim et al. 2018, section 6: the lights are the new layer.

5 km, three lanes a direction, a light every 40 m on both verges or on the median, curves of 1 … 4 km radius; or
straight, where lanes tell nothing of the way along them.
"""

from math import pi, radians
from typing import Final

import numpy as np

from gnd.fleet_sim.errors import RoadError
from gnd.fleet_sim.roads.alignment import Bends, drawn_bends
from gnd.fleet_sim.roads.curve import of_curvature
from gnd.fleet_sim.roads.motorway import LANES, MARKINGS
from gnd.fleet_sim.roads.route import FeatureState, Route, placed
from gnd.gnd_map.geodesy import LocalFrame

LENGTH_M: Final = 5_000.0
EVERY_M: Final = 40.0

_ANCHOR: Final = LocalFrame(radians(37.45), radians(127.12), 60.0)
_BENDS: Final = Bends((1000.0, 4000.0), (50.0, 500.0), (300.0, 900.0), (150.0, 150.0))


def streetlight_motorway(seed: int, *, straight: bool = False, length_m: float = LENGTH_M) -> Route:
    """Return the motorway with streetlights of a seed.

    Args:
        seed: any integer >= 0.
        straight: no curves.
        length_m: at least 500 m.

    Raises:
        RoadError: the seed is negative or the motorway too short.
    """
    if seed < 0 or length_m < 500.0:
        raise RoadError(f"a motorway with lights needs a seed >= 0 and at least 500 m, got {seed} and {length_m:g} m")
    curves, stands, survey = (np.random.default_rng([seed, stream, 8]) for stream in range(3))
    heading = float(curves.uniform(-pi, pi))
    line = of_curvature([(length_m, 0.0)] if straight else drawn_bends(_BENDS, length_m, curves), heading)
    both = stands.random() < 0.5
    lefts = (MARKINGS[0] - 4.0, MARKINGS[-1] + 12.0 + 4.0) if both else (MARKINGS[-1] + 1.5,)
    lights: list[tuple[float, float, str, float, FeatureState]] = []
    start = float(stands.uniform(10.0, 30.0))
    for way in np.arange(start, length_m - 10.0, EVERY_M).tolist():
        for left in lefts:
            place = way + float(stands.normal(0.0, 0.3))
            lights.append((place, left + float(stands.normal(0.0, 0.1)), "streetlight", 3.0, "new"))
    name = f"streetlights-{seed}" + ("-straight" if straight else "")
    features = placed(line, lights, survey)
    return Route(name, seed, _ANCHOR, line, LANES, MARKINGS, features, "streetlights", (22.0, 28.0))
