"""Gone, or passed as always: against scipy.stats, and against Gaussians that are there but let most rays pass."""

import numpy as np
import pytest
import scipy.special
import scipy.stats

from gnd.gnd_map.gaussian import Gaussians
from gnd.vehicle_agent.detect.permeable import (
    OPACITY_OF_SURFACE,
    OPACITY_OF_VOLUME,
    is_gone,
    least_opacity,
    least_rays,
)

PLANE = (0.0004, 0.0, 0.0, 0.08, 0.0, 0.08)
BUSH = (0.02, 0.0, 0.0, 0.03, 0.0, 0.07)


def gaussians(covs: list[tuple[float, ...]]) -> Gaussians:
    n = len(covs)
    counts = np.full(n, 60, np.int32)
    return Gaussians(np.arange(n, dtype=np.int32), counts, counts, np.zeros((n, 3), np.float32), np.float32(covs))


def counts(*numbers: int) -> np.ndarray:
    return np.array(numbers, np.int32)


def test_a_plane_stops_more_than_what_has_no_plane() -> None:
    assert least_opacity(gaussians([PLANE, BUSH])).tolist() == [OPACITY_OF_SURFACE, OPACITY_OF_VOLUME]


def test_the_number_of_hits_is_binomial() -> None:
    rng = np.random.default_rng(1)
    hits, passes = (rng.integers(0, top, 500).astype(np.int32) for top in (12, 300))
    for cov, opacity in ((PLANE, OPACITY_OF_SURFACE), (BUSH, OPACITY_OF_VOLUME)):
        expected = scipy.stats.binom.cdf(hits, hits + passes, opacity) <= 0.02
        np.testing.assert_array_equal(is_gone(gaussians([cov] * 500), hits, passes), expected)
        assert 20 < expected.sum() < 480


@pytest.mark.parametrize("share", [OPACITY_OF_SURFACE, OPACITY_OF_VOLUME])
def test_the_table_of_few_hits_is_scipys_binomial_to_the_ray(share: float) -> None:
    least, rays = least_rays(share, 400), np.arange(8000)
    for hits in range(400):
        n = np.maximum(rays, hits)
        np.testing.assert_array_equal(n >= least[hits], scipy.special.bdtr(hits, n, share) <= 0.02)
    far = least_rays(share, 20_000)[-1]  # what rounding adds up to on the way there
    assert scipy.special.bdtr(19_999, far, share) <= 0.02 < scipy.special.bdtr(19_999, far - 1, share)


def test_no_ray_deletes_nothing() -> None:
    assert not is_gone(gaussians([PLANE, BUSH]), counts(0, 0), counts(0, 0)).any()


@pytest.mark.parametrize("opacity", [0.1, 0.15, 0.4])
@pytest.mark.parametrize("rays", [15, 40, 120, 400])
def test_leaves_that_are_there_are_called_gone_once_in_fifty_at_most(opacity: float, rays: int) -> None:
    """The test is wrong where chance lets all rays pass: that must stay as rare as it says."""
    rng = np.random.default_rng(rays)
    hits = rng.binomial(rays, opacity, 4000).astype(np.int32)
    gone = is_gone(gaussians([BUSH] * 4000), hits, (rays - hits).astype(np.int32))
    assert gone.mean() <= 0.025


@pytest.mark.parametrize(("cov", "rays"), [(PLANE, 14), (BUSH, 38)])
def test_what_is_gone_is_found_with_enough_rays_and_not_before(cov: tuple[float, ...], rays: int) -> None:
    assert is_gone(gaussians([cov, cov]), counts(0, 0), counts(rays, rays - 1)).tolist() == [True, False]


def test_rays_at_one_height_delete_planes_only() -> None:
    both = gaussians([PLANE, BUSH])
    assert is_gone(both, counts(0, 0), counts(900, 900)).tolist() == [True, True]
    assert is_gone(both, counts(0, 0), counts(900, 900), at_one_height=True).tolist() == [True, False]
