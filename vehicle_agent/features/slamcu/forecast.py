"""Where a look will find features: predicted measurements over all particles."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.slamcu.blind import HEADING
from gnd.vehicle_agent.features.slamcu.measurement import PACKED
from gnd.vehicle_agent.features.slamcu.particle_filter import ParticleFilter
from gnd.vehicle_agent.features.slamcu.tracked_feature import TrackedFeature
from gnd.vehicle_agent.features.view import wrapped


@dataclass(frozen=True, slots=True, eq=False)
class Forecast:
    """What is predicted of n features.

    Attributes:
        z: (n, 2) range [m] and bearing [rad].
        cov: (n, 2, 2) of z, without the sensor's noise: that of the pose and the feature, as they go together.
    """

    z: F64
    cov: F64

    @property
    def sigma(self) -> F64:
        """(n, 2) of range and bearing."""
        return np.sqrt(np.stack([self.cov[:, 0, 0], self.cov[:, 1, 1]], axis=1))


def forecast(particles: ParticleFilter, weights: F64, features: Sequence[TrackedFeature]) -> Forecast:
    """Predict range and bearing of features.

    A feature that is estimated in the particles is predicted from each one's own position of it, so that errors of the
    pose that are in the feature as well do not count.
    """
    n = len(features)
    if n == 0:
        return Forecast(np.zeros((0, 2)), np.zeros((0, 2, 2)))
    places, within = np.zeros((n, 4, particles.m)), np.zeros((n, 10))
    for i, feature in enumerate(features):
        if feature.slot is not None:
            places[i], within[i] = particles.mean[feature.slot].T, weights @ particles.cov[feature.slot]
        else:
            places[i, :2] = feature.xy_m[:, None]
            within[i, :3] = 0.0 if feature.cov is None else feature.cov
            within[i, [7, 9]] = particles.held
    d = places[:, :2] - particles.state[None, :2]
    range_m = np.hypot(d[:, 0], d[:, 1]) * (1.0 + particles.camera[0] + places[:, 2])
    bearing = np.arctan2(d[:, 1], d[:, 0]) - particles.state[HEADING] + particles.camera[1] + places[:, 3]
    z = np.stack([range_m, bearing[:, :1] + wrapped(bearing - bearing[:, :1])])
    mean = z @ weights
    off = z - mean[..., None]
    cov = np.einsum("anm,bnm,m->nab", off, off, weights) + _projected(d @ weights, within)
    return Forecast(np.stack([mean[0], wrapped(mean[1])], axis=1), cov)


def _projected(d: F64, within: F64) -> F64:
    """H Σ Hᵀ (n, 2, 2) of features at d (n, 2) from the vehicle with covariances (n, 10), `measurement.PACKED`."""
    range_m = np.maximum(np.hypot(d[:, 0], d[:, 1]), 1e-3)
    cos, sin, none = d[:, 0] / range_m, d[:, 1] / range_m, np.zeros(len(d))
    h = np.stack(
        [np.stack([cos, sin, range_m, none], -1), np.stack([-sin / range_m, cos / range_m, none, none + 1.0], -1)],
        axis=1,
    )
    sigma = np.empty((len(d), 4, 4))
    for k, (i, j) in enumerate(PACKED):
        sigma[:, i, j] = sigma[:, j, i] = within[:, k]
    return np.asarray(h @ sigma @ h.transpose(0, 2, 1))
