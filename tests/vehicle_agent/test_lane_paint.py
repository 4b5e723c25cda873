"""Paint in one scan: found by contrast whatever the sensor's unit, and not where there is none."""

import numpy as np
import pytest
from lane_road import BORDERS, rings

from gnd.vehicle_agent.features.errors import BadLook
from gnd.vehicle_agent.features.lanes.paint import paint_look, rings_of_order


def _near(look, y):
    return int((np.abs(look.runs_m[:, 1] - y) < 0.15).sum())


@pytest.mark.parametrize("unit", [1.0, 0.004, 250.0])
def test_paint_is_found_whatever_the_unit(unit):
    points, intensity, ring = rings()
    look = paint_look(points, intensity * unit, ring)
    assert _near(look, -3.5) >= 6
    assert _near(look, 3.5) >= 6
    on = min(_near(look, y) for y, _ in BORDERS)
    off = len(look.runs_m) - sum(_near(look, y) for y, _ in BORDERS)
    assert on >= 2
    assert off <= 6


def test_a_wet_road_shows_no_paint_but_shows_road():
    look = paint_look(*rings(wet=True))
    assert len(look.runs_m) <= 3
    assert len(look.ground_m) > 5000


def test_a_narrow_seam_is_no_paint():
    look = paint_look(*rings(borders=(), seam_y=1.0))
    assert _near(look, 1.0) <= 2


def test_a_kerb_is_no_paint():
    points, intensity, ring = rings(borders=((3.5, "solid"),))
    behind = points[:, 1] > 3.43
    points[behind, 2] += 0.07
    assert _near(paint_look(points, intensity, ring), 3.5) <= 2


def test_rings_are_counted_where_none_are_given():
    points, intensity, ring = rings()
    assert (rings_of_order(points)[::-1][0] - rings_of_order(points)[0]) >= 7
    with_rings, without = paint_look(points, intensity, ring), paint_look(points, intensity, None)
    assert abs(len(with_rings.runs_m) - len(without.runs_m)) <= 2


def test_points_without_return_are_left_out():
    points, intensity, ring = rings()
    bad = points.copy()
    bad[::7] = np.nan
    assert np.isfinite(paint_look(bad, intensity, ring).runs_m).all()


def test_bad_scans_are_refused():
    points, intensity, ring = rings()
    with pytest.raises(BadLook, match="shape"):
        paint_look(points, intensity[:-1], ring)
    with pytest.raises(BadLook, match="rings of shape"):
        paint_look(points, intensity, ring[:-1])
    intensity[5] = np.nan
    with pytest.raises(BadLook, match="1 of"):
        paint_look(points, intensity, ring)
    with pytest.raises(BadLook, match="at most"):
        paint_look(np.zeros((4_000_001, 3)), np.zeros(4_000_001), None)


def test_an_empty_scan_shows_nothing():
    assert len(paint_look(np.zeros((0, 3)), np.zeros(0), None).runs_m) == 0
