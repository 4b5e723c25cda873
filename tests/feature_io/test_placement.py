"""Local points on the Earth and back: by an anchor, and by poses that bend."""

import numpy as np
import pytest

from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.se3 import T_from_R_t, exp_so3
from gnd.tile_store.feature_io.errors import BadGeometry, FeatureFileError
from gnd.tile_store.feature_io.placement import Placement

RNG = np.random.default_rng(5)


def bent() -> Placement:
    """Poses every 3 m of a street of 600 m that is driven twice, with a drift that grows to metres."""
    x = np.concatenate([np.arange(0.0, 600.0, 3.0), np.arange(600.0, 0.0, -3.0)])
    at_m = np.column_stack([x, np.where(np.arange(len(x)) < 200, 0.0, 4.0), np.zeros(len(x))])
    share = np.linspace(0.0, 1.0, len(x))
    T = np.stack([T_from_R_t(exp_so3([0.0, 0.0, 0.5 + 0.004 * s]), [3 * s, -2 * s, 0.5 * s]) for s in share])
    return Placement(LocalFrame(0.8, 0.2, 0.0), at_m, T, height_known=False)


def test_an_anchor_is_a_rigid_frame() -> None:
    placement = Placement.anchored(0.8, 0.2, 100.0, np.radians(90.0))
    lat, lon, height = placement.geodetic(np.array([[0.0, 0.0, 0.0], [0.0, 50.0, 2.0]]))
    assert (lat[0], lon[0], height[0]) == pytest.approx((0.8, 0.2, 100.0))
    east, north, up = LocalFrame(0.8, 0.2, 100.0).enu_from_geodetic(lat, lon, height)[1]
    assert (east, north, up) == pytest.approx((50.0, 0.0, 2.0), abs=1e-6)  # y points east at a bearing of 90 degrees
    assert placement.height_known
    assert not Placement.anchored(0.8, 0.2).height_known


def test_the_way_back_is_the_inverse() -> None:
    placement = bent()
    points = placement.at_m[RNG.integers(0, 400, 300)] + RNG.normal(0.0, [10.0, 10.0, 2.0], (300, 3))
    again = placement.local(*placement.geodetic(points))
    assert np.abs(again - points).max() < 1e-6


def test_lines_stay_smooth_where_two_drifts_meet() -> None:
    line = np.column_stack([np.arange(100.0, 200.0, 0.1), np.full(1000, 2.0), np.zeros(1000)])  # between the two drives
    placement = bent()
    step = np.diff(placement.frame.enu_from_geodetic(*placement.geodetic(line)), axis=0)
    assert np.abs(np.linalg.norm(step, axis=1) - 0.1).max() < 0.01


def test_a_placement_comes_back_from_its_text() -> None:
    placement = bent()
    again = Placement.from_dict(placement.as_dict())
    assert again.frame == placement.frame
    assert np.array_equal(again.T_frame_local, placement.T_frame_local)
    assert np.array_equal(again.at_m, placement.at_m)
    assert not again.height_known
    with pytest.raises(FeatureFileError, match="no georeference: KeyError"):
        Placement.from_dict({})


def test_far_points_are_refused() -> None:
    with pytest.raises(BadGeometry, match=r"local point .* lies 60 km from the georeference"):
        Placement.anchored(0.8, 0.2).geodetic(np.array([[60_000.0, 0.0, 0.0]]))
    with pytest.raises(FeatureFileError, match="at least one pose"):
        Placement(LocalFrame(0.0, 0.0), np.zeros((0, 3)), np.zeros((0, 4, 4)))
