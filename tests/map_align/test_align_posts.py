"""Posts of an HD map on those of a LiDAR map: places that are known, and those that must be refused."""

import numpy as np
import pytest

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.map_align.align_posts import PostAlignment, align_posts
from gnd.vehicle_agent.map_align.candidates import Reach

REACH = Reach(10.0, 5.0, 10.0)


def street(seed: int, n: int = 26, length_m: float = 160.0) -> F64:
    """Posts on both sides of a street, at places that differ, 4 m apart at least."""
    rng, posts = np.random.default_rng(seed), list[F64]()
    while len(posts) < n:
        one = np.array([rng.uniform(-length_m / 2, length_m / 2), rng.choice([-6.5, 6.5]) + rng.normal(0, 0.8)])
        if all(np.linalg.norm(one - other) > 4.0 for other in posts):
            posts.append(one)
    return np.array(posts)


def known_of(posts: F64) -> F64:
    """Where the LiDAR map knows anything: the street between its posts."""
    low, high = posts.min(axis=0) - 3.0, posts.max(axis=0) + 3.0
    grid = np.meshgrid(*(np.arange(a, b, 1.0) for a, b in zip(low, high, strict=True)))
    return np.stack(grid, axis=-1).reshape(-1, 2)


def placed(posts: F64, turn_deg: float, shift: tuple[float, float]) -> F64:
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    return posts @ np.array([[c, s], [-s, c]]) + shift


def lidar_of(posts: F64, seed: int, found: float = 0.8, others: int = 20) -> F64:
    """As a LiDAR map holds them: a fifth is missing, 5 cm off, and trunks and corners beside them."""
    rng = np.random.default_rng([seed, 1])
    kept = posts[rng.random(len(posts)) < found]
    low, high = posts.min(axis=0), posts.max(axis=0)
    clutter = np.c_[rng.uniform(low[0], high[0], others), rng.choice([-9.0, 9.0], others) + rng.normal(0, 1, others)]
    return np.concatenate([kept + rng.normal(0, 0.05, kept.shape), clutter])


def aligned(lidar: F64, vector: F64, known: F64 | None = None) -> PostAlignment:
    return align_posts(lidar, known_of(lidar) if known is None else known, vector, REACH)


@pytest.mark.parametrize("seed", range(1000, 1012))
def test_a_moved_map_is_found(seed):
    posts, rng = street(seed), np.random.default_rng([seed, 2])
    turn, shift = float(rng.uniform(-3.5, 3.5)), rng.uniform(-6, 6, 2)
    found = aligned(lidar_of(posts, seed), placed(posts, turn, tuple(shift)))
    assert found.fits, found.reasons
    back = placed(posts, turn, tuple(shift)) @ found.T_lidar_vector[:2, :2].T + found.T_lidar_vector[:2, 3]
    off = back - posts
    assert np.linalg.norm(off.mean(axis=0)) < 4.0 * found.sigma_m < 0.2
    assert np.linalg.norm(off, axis=1).max() < 0.15
    assert abs(found.heading_deg + turn) < 4.0 * found.sigma_deg
    both = found.T_vector_lidar @ found.T_lidar_vector
    np.testing.assert_allclose(both, np.eye(4), atol=1e-9)


@pytest.mark.parametrize("seed", range(1000, 1012))
def test_another_street_is_refused(seed):
    found = aligned(lidar_of(street(seed), seed), street(seed + 500))
    assert any("residuals too high" in reason or "too few" in reason for reason in found.reasons), found.reasons


@pytest.mark.parametrize("seed", range(1000, 1012))
@pytest.mark.parametrize("change", ["mirrored", "feet", "scaled"])
def test_wrong_axes_and_units_are_refused(seed, change):
    posts = street(seed)
    vector = {"mirrored": posts * [1, -1], "feet": posts / 0.3048, "scaled": posts * 1.006}[change]
    found = aligned(lidar_of(posts, seed, found=1.0), vector)
    assert not found.fits
    if change == "scaled":
        assert any("larger" in reason or "residuals" in reason for reason in found.reasons), found.reasons


@pytest.mark.parametrize("shift", [0.0, 3.0])
def test_lamps_at_equal_distances_are_refused(shift):
    """Both sides, set off by half a distance of 8 m: a shift by one lamp fits all but the last ones."""
    x = np.arange(-80.0, 80.1, 8.0)
    posts = np.concatenate([np.c_[x, np.full(len(x), 6.0)], np.c_[x + 3.0, np.full(len(x), -6.0)]])
    rng = np.random.default_rng(7)
    found = aligned(posts + rng.normal(0, 0.04, posts.shape), posts + np.array([shift, 0.5]))
    assert any("ambiguous" in reason for reason in found.reasons), found.reasons


CROSSING = np.array([[4.0, 22.0], [11.5, 35.0], [-6.0, -15.0], [3.0, -28.0], [9.0, 14.0], [-8.0, 27.0], [12.0, -21.0]])


def test_lamps_at_equal_distances_beyond_the_search_and_a_crossing_decide():
    """30 m apart, no shift of the search brings one onto the next; the crossing's posts tell the sides apart."""
    x = np.arange(-90.0, 90.1, 30.0)
    posts = np.concatenate([np.c_[x, np.full(len(x), 6.0)], CROSSING])
    rng = np.random.default_rng(7)
    found = aligned(posts + rng.normal(0, 0.04, posts.shape), placed(posts, 1.0, (2.0, -1.0)))
    assert found.fits, found.reasons


def test_a_street_that_is_its_own_mirror_image_is_refused():
    rng = np.random.default_rng(3)
    x = np.sort(rng.uniform(-80, 80, 14))
    posts = np.concatenate([np.c_[x, np.full(14, 6.0)], np.c_[x, np.full(14, -6.0)]])
    found = aligned(posts + rng.normal(0, 0.03, posts.shape), posts + np.array([1.0, 1.0]))
    assert any("mirror image" in reason for reason in found.reasons), found.reasons


def test_posts_on_one_line_are_refused():
    rng = np.random.default_rng(4)
    posts = np.c_[np.sort(rng.uniform(-80, 80, 16)), rng.normal(6.0, 0.1, 16)]
    found = aligned(posts + rng.normal(0, 0.03, posts.shape), posts + np.array([1.0, 1.0]))
    assert any("one line" in reason for reason in found.reasons), found.reasons


def test_too_few_posts_and_no_overlap_are_refused():
    posts = street(1000)
    few = aligned(lidar_of(posts, 1000), posts[:7])
    away = aligned(lidar_of(posts, 1000), posts + np.array([500.0, 0.0]))
    none = aligned(np.zeros((0, 2)), posts, known=known_of(posts))
    empty = align_posts(np.zeros((0, 2)), np.zeros((0, 2)), posts, REACH)
    for found in (few, away, none, empty):
        assert any("too few posts" in reason for reason in found.reasons)
        assert found.as_dict()["fits"] is False


def test_what_lies_beyond_the_search_is_refused():
    posts = street(1001)
    assert not aligned(lidar_of(posts, 1001), posts + np.array([14.0, 0.0])).fits
    assert not aligned(lidar_of(posts, 1001), placed(posts, 9.0, (0.0, 0.0))).fits
