"""Whether a Gaussian of the map is gone, or rays pass through it as they always did.

Leaves, bushes, wire and the rims of things stop only a part of the rays that meet them: on real recordings seven in ten
false deletions were Gaussians that most rays of the mapping drive itself had passed. Far from the vehicle few rays meet
such a Gaussian, and that all of them pass is chance, not change. So it is gone only where so few hits of so many rays
are improbable for what stops the least that such a Gaussian may stop.

That share is of rays from all heights. A few level layers pass a voxel again and again at one height: over the ground
and in front of the wall that one Gaussian holds together, hundreds of times without a hit. What they pass says nothing
of a Gaussian that is no plane; a plane that they cross they would meet.
"""

from array import array
from functools import cache
from threading import Lock
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I32, I64
from gnd.gnd_map.gaussian import Gaussians
from gnd.vehicle_agent.detect.records import planar_normals

OPACITY_OF_SURFACE: Final = 0.25
"""Of the rays through it, a planar Gaussian stops at least this share: 14 passes without a hit delete it, as Eq. (11)
does with the default λcp."""
OPACITY_OF_VOLUME: Final = 0.10
"""The same of a Gaussian that is no plane: 38 passes without a hit delete it."""
_CHANCE: Final = 0.02
"""So improbable the few hits must be."""


def least_opacity(gaussians: Gaussians) -> F64:
    """(K,) least share of the rays through each Gaussian that it stops."""
    planar = planar_normals(gaussians.full_cov()).any(axis=1)
    return np.where(planar, OPACITY_OF_SURFACE, OPACITY_OF_VOLUME)


def is_gone(gaussians: Gaussians, hits: I32, passes: I32, *, at_one_height: bool = False) -> NDArray[np.bool_]:
    """(K,) whether so few hits show that a Gaussian is not there any more.

    The number of hits is binomial; the test is one-sided at 2 %.

    Args:
        gaussians: K of the map.
        hits: (K,) rays that ended in its voxel.
        passes: (K,) rays that passed through the Gaussian.
        at_one_height: all rays came from a sensor of a few level layers.
    """
    opacity = least_opacity(gaussians)
    rays = hits.astype(np.int64) + passes
    gone = np.zeros(len(hits), np.bool_)
    for share in (OPACITY_OF_SURFACE, OPACITY_OF_VOLUME):
        rows = np.flatnonzero((opacity == share) & (hits < share * rays))  # of more hits every second happens by chance
        least = least_rays(share, int(hits[rows].max(initial=0)) + 1)
        gone[rows] = rays[rows] >= least[hits[rows]]
    return np.asarray(gone & (opacity == OPACITY_OF_SURFACE) if at_one_height else gone)


def least_rays(share: float, n: int) -> I64:
    """(n,) of how many rays 0, 1 … n - 1 hits are so few that they show that what stops `share` of them is gone."""
    return _few_hits(share).least(n)


class _FewHits:
    """From how many rays on P(at most k hits) <= _CHANCE, by k: walked along that edge, where P never underflows."""

    def __init__(self, share: float) -> None:
        self._share, self._least, self._growing = share, array("q"), Lock()
        self._rays, self._exactly, self._most = 0, 1.0, 1.0  # P(k hits), P(at most k hits)

    def least(self, n: int) -> I64:
        """(n,) the first of them."""
        with self._growing:
            self._grow(n)
            return np.array(self._least[:n], np.int64)

    def _grow(self, n: int) -> None:
        p, q, rays, exactly, most = self._share, 1.0 - self._share, self._rays, self._exactly, self._most
        for hits in range(len(self._least), n):
            if hits:
                exactly *= (rays - hits + 1) * p / (hits * q)
                most += exactly
            while most > _CHANCE:
                most -= exactly * p
                exactly *= (rays + 1) * q / (rays + 1 - hits)
                rays += 1
            self._least.append(rays)
        self._rays, self._exactly, self._most = rays, exactly, most


@cache
def _few_hits(share: float) -> _FewHits:
    return _FewHits(share)
