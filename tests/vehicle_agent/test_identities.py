"""Which track is which feature of the map: all at once, with the pose common to them."""

from math import radians

import numpy as np
import pytest
from particle_filter_plain import h

from gnd.vehicle_agent.features.slamcu.identities import NONE, best_identities
from gnd.vehicle_agent.features.slamcu.particle_filter import ParticleFilter

VARIANCE = np.array([0.2, radians(0.4)]) ** 2
TRUE = np.zeros(3)
LANE_M = 3.5


def gantry(
    tracks: list[tuple[float, float]], mapped: list[tuple[float, float]], sigma_m: float = 1.5
) -> ParticleFilter:
    """Particles with tracks of what stands there; the first ones belong to features of the map, rightly or wrongly."""
    particles = ParticleFilter(2000, TRUE, np.diag([0.04, sigma_m**2, 1e-8]), np.random.default_rng(1))
    for i, place in enumerate(tracks):
        prior = (np.array(mapped[i]), np.array([0.01, 0.0, 0.01])) if i < len(mapped) else None
        particles.add(h(TRUE, np.array(place)), VARIANCE, prior)
    return particles


PANELS = [(40.0, -LANE_M), (40.0, 0.0), (40.0, LANE_M)]


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (2, 1, 0), (1, 2, 0)])
def test_two_of_three_panels_are_the_maps_whatever_they_were_taken_for(order: tuple[int, ...]) -> None:
    particles = gantry([PANELS[i] for i in order], PANELS[:2])
    assert best_identities(particles, [0, 1, 2], 2).slots == [order.index(0), order.index(1)]


def test_a_panel_that_is_gone_is_none_of_the_tracks() -> None:
    """Of the map's two the right one is gone; the vehicle may be a lane aside, but not by 15 m."""
    mapped = [(40.0, -5 * LANE_M), PANELS[1]]
    particles = gantry([PANELS[1], PANELS[2]], mapped)
    assert best_identities(particles, [0, 1], 2).slots == [NONE, 0]


def test_the_pose_is_common_to_all() -> None:
    """Both tracks lie 3 m aside: a vehicle 3 m aside explains both, though a swap has each nearer to one panel."""
    particles = gantry([(40.0, -LANE_M + 3.0), (40.0, 3.0)], PANELS[:2], sigma_m=2.5)
    assert best_identities(particles, [0, 1], 2).slots == [0, 1]


def test_too_many_to_try_all() -> None:
    many = [(40.0, LANE_M * i) for i in range(9)]
    particles = gantry(many, many[:7], sigma_m=0.3)
    assert best_identities(particles, list(range(9)), 7).slots == list(range(7))
