"""Where the vehicle believes it is."""

import math

import numpy as np
import pytest
from vehicle_scene import FRAME

from gnd.schemas.drive import GnssFix, MotionSample
from gnd.vehicle_agent.localise.estimates import PoseEstimate
from gnd.vehicle_agent.place import Place

SECOND = 1_000_000_000


def fix(t_s: float, east_m: float, north_m: float) -> GnssFix:
    lat, lon, height = FRAME.geodetic_from_enu(np.array([[east_m, north_m, 30.0]]))
    return GnssFix(int(t_s * SECOND), float(lat[0]), float(lon[0]), float(height[0]), 2.5)


def estimate(east_m: float, north_m: float, heading_rad: float, health: str) -> PoseEstimate:
    T = np.eye(4)
    T[:2, :2] = [
        [math.cos(heading_rad), -math.sin(heading_rad)],
        [math.sin(heading_rad), math.cos(heading_rad)],
    ]
    T[:3, 3] = (east_m, north_m, 30.0)
    return PoseEstimate(0, T, 0.02, 0.001, 0.9, health)  # type: ignore[arg-type]


def test_satellites_lead_until_the_localiser_knows() -> None:
    place = Place(FRAME, fix(0, 0, 0))
    assert place.ahead_map_m(100.0).shape == (1, 3)
    place.take(fix(1, 1, 0), None)
    assert place.heading_rad is None
    place.take(fix(2, 0, 8), estimate(50, 50, 1.0, "lost"))
    assert place.heading_rad == pytest.approx(math.pi / 2, abs=1e-3)
    np.testing.assert_allclose(place.position_map_m, [0, 8, 30], atol=1e-3)
    assert place.health == "lost"
    np.testing.assert_allclose(place.ahead_map_m(100.0)[1], [0, 108, 30], atol=0.1)


def test_the_localiser_leads_once_it_knows() -> None:
    place = Place(FRAME, fix(0, 0, 0))
    place.take(fix(1, 9, 9), estimate(3, 4, 0.5, "good"))
    np.testing.assert_allclose(place.position_map_m, [3, 4, 30])
    assert place.heading_rad == pytest.approx(0.5)
    assert place.health == "good"
    assert place.height_m == pytest.approx(30.0, abs=1e-3)
    lat, lon = place.geodetic
    np.testing.assert_allclose(FRAME.enu_from_geodetic(lat, lon, 30.0), [3, 4, 30], atol=1e-3)


def test_the_odometer_counts_way_in_both_directions_but_no_gaps() -> None:
    place = Place(FRAME, fix(0, 0, 0))
    for t_s, speed in ((0.0, 5.0), (0.5, 10.0), (1.0, -2.0), (31.0, 10.0)):
        place.take(MotionSample(int(t_s * SECOND), speed, 0.0), None)
    assert place.odometer_m == pytest.approx(0.5 * 10 + 0.5 * 2 + 1.0 * 10)
    assert place.t_ns == 31 * SECOND


def test_in_reverse_gear_the_course_is_where_the_vehicle_goes() -> None:
    place = Place(FRAME, fix(0, 0, 0))
    assert place.course.heading_rad is None
    place.take(MotionSample(0, -2.0, 0.0), None)
    place.take(fix(4, 8, 0), None)  # satellites tell the way, wheels that it was driven backwards
    assert math.cos(place.heading_rad or 0.0) == pytest.approx(-1.0)
    assert math.cos(place.course.heading_rad or 0.0) == pytest.approx(1.0)
    np.testing.assert_allclose(place.ahead_map_m(10.0)[1], [18, 0, 30], atol=0.1)
    assert (place.course.x_m, place.course.speed_mps) == (pytest.approx(8.0, abs=1e-3), 2.0)
    place.take(MotionSample(SECOND, 3.0, 0.0), estimate(8, 0, math.pi, "good"))
    assert math.cos(place.course.heading_rad or 0.0) == pytest.approx(-1.0)
