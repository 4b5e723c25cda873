"""Submaps: Gaussians of half a metre in a frame of their own, and the points that stand for them."""

import numpy as np
import pytest

from gnd.gnd_map.errors import MapError
from gnd.gnd_map.submap import CELL_M, REACH_TILES, SubmapPoints, decode_submap, spread_points


def wall(rng: np.random.Generator) -> np.ndarray:
    """A wall with a thickness of 2 cm, 5.3 m to the left."""
    along, up = rng.uniform(-20.0, 20.0, 60_000), rng.uniform(0.0, 4.0, 60_000)
    return np.column_stack([along, 5.3 + rng.normal(0.0, 0.02, 60_000), up])


def test_a_wall_stays_where_it_was_for_two_bytes_a_gaussian() -> None:
    points = SubmapPoints()
    points.add(wall(np.random.default_rng(1)))
    bodies = points.encoded()
    found = decode_submap(bodies)
    assert len(found) == pytest.approx(40 / CELL_M * 4 / CELL_M, rel=0.1)
    assert np.abs(found.mean_m[:, 1] - 5.3).max() < 0.02
    assert sum(map(len, bodies.values())) < 3 * len(found)
    assert np.sqrt(np.linalg.eigvalsh(found.cov_m2)[:, 0]).mean() == pytest.approx(0.02, abs=0.003)


def test_points_that_stand_for_gaussians_have_their_moments() -> None:
    points = SubmapPoints()
    points.add(wall(np.random.default_rng(2)))
    found = decode_submap(points.encoded())
    for row in range(0, len(found), 97):
        one = found.take(np.array([row]))
        spread = spread_points(one, 0.09)
        np.testing.assert_allclose(spread.mean(axis=0), one.mean_m[0], atol=1e-9)
        np.testing.assert_allclose(np.cov(spread.T, bias=True), one.cov_m2[0], atol=1e-9)


def test_what_lies_beyond_the_reach_is_left_out_and_a_forged_tile_refused() -> None:
    points = SubmapPoints()
    points.add(np.array([[1e4, 0.0, 0.0]]))
    assert points.encoded() == {}
    assert len(decode_submap({})) == 0
    with pytest.raises(MapError, match="it reaches"):
        decode_submap({(REACH_TILES + 1, 0): b""})
    with pytest.raises(MapError):
        decode_submap({(0, 0): b"nonsense"})
