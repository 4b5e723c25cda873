"""Which estimate is which feature of the map, decided when all of its measurements are in.

The panels of a gantry stand a lane apart, and one look at 80 m cannot distinguish them: what is measured at
first may be taken for its neighbour, and everything after it follows. An estimate gathered over a passage can. So
before the map's features are settled, all ways to give the estimates at hand to them are compared, by the likelihood of
the whole in each particle: the pose is the same for all of them.
"""

from itertools import permutations
from math import perm
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.slamcu import measurement
from gnd.vehicle_agent.features.slamcu.particle_filter import ParticleFilter

NONE: Final = -1
"""Of a feature of the map that none of the estimates is."""
LN_NONE: Final = -25.0
"""Natural logarithm of the density of that, 1/m^2: a sign gone and a new one of its kind in its place are rare, and a
pose that is surer than it should be makes the map look changed."""
LN_NONE_DOUBTED: Final = -10.0
"""The same for a place in doubt, when all signs may seem to have their neighbour's place."""
MOST_WAYS: Final = 720
"""More ways than this are not compared; then the best pairs alone are the only other way."""


class Identities(NamedTuple):
    """The likeliest way to give estimates to features of the map."""

    slots: list[int]
    """J of the slots, in the order of the features; `NONE` for one that none of them is."""
    lead: float
    """How much likelier than the next way, natural logarithm; inf where there is only one."""


def best_identities(particles: ParticleFilter, slots: list[int], owned: int, ln_none: float = LN_NONE) -> Identities:
    """Which of `slots` are the features of the map that own the first ones.

    Args:
        particles: the filter; slots that are owned have a prior.
        slots: S slots of one kind near one another, the `owned` ones first.
        owned: J features of the map, J <= S.
        ln_none: of the density of a feature that is none of them, 1/m^2.
    """
    fit = agreements(particles, slots, owned)
    log_weight = np.log(np.maximum(particles.weights(without=set(slots)), 1e-300))
    ways = _ways(fit, log_weight)
    likelihoods = np.array([likelihood(fit, log_weight, way, ln_none) for way in ways])
    best = int(np.argmax(likelihoods))
    lead = float(likelihoods[best] - np.delete(likelihoods, best).max(initial=-np.inf))
    return Identities([NONE if i == NONE else slots[i] for i in ways[best]], lead)


def agreements(particles: ParticleFilter, slots: list[int], owned: int) -> F64:
    """(J, S, M) log likelihood of each prior, were it the slot's."""
    fit = np.empty((owned, len(slots), particles.m))
    for j in range(owned):
        prior = particles.priors[slots[j]]
        assert prior is not None
        for s, slot in enumerate(slots):
            fit[j, s] = measurement.agreement(particles.mu[slot], particles.sigma[slot], *prior)
    return fit


def likelihood(fit: F64, log_weight: F64, way: tuple[int, ...], ln_none: float = LN_NONE) -> float:
    """Log likelihood of a way to give slots to features, over all particles."""
    log = log_weight + sum(ln_none if s == NONE else fit[j, s] for j, s in enumerate(way))
    most = float(log.max())
    return most + float(np.log(np.exp(log - most).sum()))


def _ways(fit: F64, log_weight: F64) -> list[tuple[int, ...]]:
    features, slots = fit.shape[:2]
    if perm(slots + features, features) <= MOST_WAYS:
        return sorted(set(permutations([*range(slots), *[NONE] * features], features)))
    pairs = np.array([[likelihood(fit[[j]][:, [s]], log_weight, (0,)) for s in range(slots)] for j in range(features)])
    return [tuple(linear_sum_assignment(-pairs)[1].tolist()), tuple(range(features))]
