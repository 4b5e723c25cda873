"""Fields of view, and what a scan says of what hides what."""

from math import inf, nan, pi, radians

import numpy as np
import pytest

from gnd.vehicle_agent.features.errors import BadLook
from gnd.vehicle_agent.features.view import CAMERA, LIDAR, Occlusion, SensorView


def test_inside_and_soft_edges() -> None:
    ranges, bearings = np.array([79.0, 81.0, 79.0, 50.0, 50.0]), np.radians([0.0, 0.0, 19.5, 20.5, -19.0])
    assert CAMERA.inside(ranges, bearings).tolist() == [True, False, True, False, True]
    assert CAMERA.inside(ranges, bearings, 2.0, radians(0.8)).tolist() == [False, False, False, False, True]


def test_all_around_has_no_sides() -> None:
    around = np.linspace(-pi, pi, 20)
    assert LIDAR.inside(np.full(20, 49.0), around, 0.5, 3.0).all()


def clear(occlusion: Occlusion, range_m: float, bearing_deg: float, z_m: float = nan, edge_deg: float = 0.1) -> bool:
    columns = (np.array([one]) for one in (range_m, radians(bearing_deg), radians(edge_deg), z_m))
    return bool(occlusion.clear(*columns)[0])


def test_free_ranges_hide_what_is_behind() -> None:
    free = np.full(40, inf)
    free[25] = 30.0  # 5° … 6°
    occlusion = Occlusion.of_ranges(free, radians(-20.0), radians(1.0))
    assert not clear(occlusion, 50.0, 5.5)
    assert clear(occlusion, 30.5, 5.5)  # may be what was measured
    assert clear(occlusion, 20.0, 5.5)
    assert clear(occlusion, 50.0, 7.5)
    assert not clear(occlusion, 50.0, 7.5, edge_deg=2.0)  # it may stand a little farther to the right
    assert clear(occlusion, 50.0, 90.0)  # nothing is known there


def test_a_truck_in_a_scan_hides_the_sign_behind_and_not_the_one_above() -> None:
    y, z = (grid.ravel() for grid in np.meshgrid(np.arange(-1.25, 1.26, 0.05), np.arange(0.0, 3.51, 0.1)))
    truck = np.stack([np.full(len(y), 20.0), y, z], axis=1)
    occlusion = Occlusion.of_scan(truck, np.array([1.0, 0.0, 1.9]))
    assert not clear(occlusion, 60.0, 0.0, 3.0)
    assert not clear(occlusion, 60.0, 0.0, 6.4)  # the line to it passes the truck at 3.4 m
    assert clear(occlusion, 24.0, 0.0, 6.5)
    assert clear(occlusion, 60.0, 8.0, 3.0)
    assert not clear(occlusion, 60.0, 0.0)  # height unknown: that of a road sign


def test_the_vehicle_itself_and_far_returns_hide_nothing() -> None:
    points = np.array([[0.2, 0.0, 1.9], [150.0, 0.0, 3.0]])
    assert clear(Occlusion.of_scan(points, np.array([0.0, 0.0, 1.9])), 300.0, 0.0, 3.0)


def test_clear_agrees_with_a_plain_loop() -> None:
    rng = np.random.default_rng(4)
    free = np.where(rng.random(90) < 0.5, rng.uniform(5.0, 60.0, 90), inf)
    occlusion = Occlusion.of_ranges(free, radians(-45.0), radians(1.0))
    for _ in range(200):
        range_m, bearing, edge = rng.uniform(5, 60), rng.uniform(-40, 40), rng.uniform(0.0, 3.0)
        here, reach = int(np.floor(bearing + 45.0)), int(np.ceil(edge))
        want = free[here - reach : here + reach + 1].min() >= range_m - 1.0
        assert clear(occlusion, range_m, bearing, edge_deg=edge) == want


def test_bad_views_are_refused() -> None:
    with pytest.raises(BadLook, match="view of"):
        SensorView(7.0, 80.0)
    with pytest.raises(BadLook, match="-80"):
        SensorView(1.0, -80.0)
    with pytest.raises(BadLook, match="no numbers"):
        Occlusion.of_ranges([1.0, nan], 0.0, 0.1)
    with pytest.raises(BadLook, match="shape"):
        Occlusion(np.zeros((3, 2)), 0.0, 0.1, np.zeros(0))
