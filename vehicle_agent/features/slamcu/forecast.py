"""Where a look will find features: predicted measurements over all particles."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.features.slamcu.blind import HEADING
from gnd.vehicle_agent.features.slamcu.existence_book import BookEntry
from gnd.vehicle_agent.features.slamcu.rbpf import Rbpf
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


def forecast(rbpf: Rbpf, weights: F64, entries: Sequence[BookEntry]) -> Forecast:
    """Predict range and bearing of features.

    A feature that is estimated in the particles is predicted from each one's own position of it, so that errors of the
    pose that are in the feature as well do not count.
    """
    n = len(entries)
    if n == 0:
        return Forecast(np.zeros((0, 2)), np.zeros((0, 2, 2)))
    places = np.empty((n, 2, rbpf.m))
    within = np.empty((n, 3))
    for i, entry in enumerate(entries):
        places[i], within[i] = _place(rbpf, weights, entry)
    d = places - rbpf.state[None, :2]
    range_m = np.hypot(d[:, 0], d[:, 1])
    bearing = np.arctan2(d[:, 1], d[:, 0]) - rbpf.state[HEADING]
    z = np.stack([range_m, bearing[:, :1] + wrapped(bearing - bearing[:, :1])])
    mean = z @ weights
    off = z - mean[..., None]
    cov = np.einsum("anm,bnm,m->nab", off, off, weights) + _projected(d @ weights, within)
    return Forecast(np.stack([mean[0], wrapped(mean[1])], axis=1), cov)


def _place(rbpf: Rbpf, weights: F64, entry: BookEntry) -> tuple[F64, F64]:
    """Positions (2, M) or (2, 1), and the covariance (3,) within each particle."""
    if entry.slot is not None:
        return rbpf.mu[entry.slot].T, weights @ rbpf.sigma[entry.slot]
    return entry.xy_m[:, None], np.zeros(3) if entry.cov is None else entry.cov


def _projected(d: F64, within: F64) -> F64:
    """H Σ Hᵀ (n, 2, 2) of features at d (n, 2) from the vehicle with covariances (n, 3)."""
    range_m = np.maximum(np.hypot(d[:, 0], d[:, 1]), 1e-3)
    cos, sin = d[:, 0] / range_m, d[:, 1] / range_m
    h = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1) / range_m[:, None]], axis=1)
    sigma = within[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    return np.asarray(h @ sigma @ h.transpose(0, 2, 1))
