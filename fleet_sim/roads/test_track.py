"""A closed test track with beacons, like UTAC CERAM at Mortefontaine (Kim et al. 2018, section 5).

About 2 km around, two lanes, curves to both sides, a beacon every 25 m or so off the road. The map has the lanes only;
the beacons are the new layer.
"""

from math import radians, tau
from typing import Final

import numpy as np

from gnd.fleet_sim.errors import RoadError
from gnd.fleet_sim.roads.curve import Centreline, of_figure
from gnd.fleet_sim.roads.route import FeatureState, Route, placed
from gnd.gnd_map.geodesy import LocalFrame

LENGTH_M: Final = 2_000.0
LANE_M: Final = 3.5
BEACON_EVERY_M: Final = 25.0
SHARPEST_M: Final = 55.0
"""Radius of the sharpest curve."""

_ANCHOR: Final = LocalFrame(radians(49.145), radians(2.595), 120.0)
"""The longitudes of the paper's Figure 4."""


def test_track(seed: int) -> Route:
    """Return the test track of a seed.

    Raises:
        RoadError: the seed is negative.
    """
    if seed < 0:
        raise RoadError(f"the seed of a test track must be >= 0, got {seed}")
    shape, stands, survey = (np.random.default_rng([seed, stream, 7]) for stream in range(3))
    line = _loop(shape)
    count = round(line.length_m / BEACON_EVERY_M)
    beacons: list[tuple[float, float, str, float, FeatureState]] = []
    for index in range(count):
        way = (index + float(stands.uniform(0.2, 0.8))) * line.length_m / count
        side = 1.0 if stands.random() < 0.5 else -1.0
        beacons.append((way, side * (LANE_M + float(stands.uniform(1.0, 6.0))), "beacon", 1.0, "new"))
    features = placed(line, beacons, survey)
    lanes, markings = (-LANE_M / 2, LANE_M / 2), (-LANE_M, 0.0, LANE_M)
    return Route(f"test-track-{seed}", seed, _ANCHOR, line, lanes, markings, features, "beacons", (11.0, 16.0))


test_track.__test__ = False  # type: ignore[attr-defined]  # pytest takes the name for a test's


def _loop(rng: np.random.Generator) -> Centreline:
    """A rounded closed figure of some waves, drawn again until no curve is too sharp."""
    angle = np.linspace(0.0, tau, 40_000, endpoint=False)
    while True:
        waves = [(k, float(rng.uniform(0.4, 1.0)) * 0.5 / k, float(rng.uniform(0.0, tau))) for k in (2, 3, 4, 5)]
        radius = 1.0 + np.sum([a * np.cos(k * angle + phase) for k, a, phase in waves], axis=0)
        figure = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        around = np.linalg.norm(np.roll(figure, -1, axis=0) - figure, axis=1).sum()
        if radius.min() < 0.2:
            continue
        line = of_figure(figure * (LENGTH_M / around))
        way = np.arange(0.0, line.length_m, 2.0)
        bend = line.at(way + 2.0)[1] - line.at(way - 2.0)[1]
        if np.abs(bend).max() / 4.0 <= 1.0 / SHARPEST_M:
            return line
