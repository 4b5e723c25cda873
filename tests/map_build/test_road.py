"""Where the road lies in the vehicle frame: right, wrong, tilted, and not to be seen."""

import numpy as np
import pytest

from gnd.vehicle_agent.map_build.bodywork import BodyworkSurvey
from gnd.vehicle_agent.map_build.quality import mount_height
from gnd.vehicle_agent.map_build.road import road_below
from gnd.vehicle_agent.map_build.survey import DriveSurvey

LIDAR = np.array([0.5, 0.0, 1.8])


def scene(rng: np.random.Generator, slope: float = 0.0, road: bool = True) -> np.ndarray:
    """A road with house fronts, cars, and a few echoes below."""
    xy = rng.uniform(-20, 20, (12_000, 2))
    ground = np.c_[xy, slope * xy[:, 0] + 0.02 * rng.standard_normal(len(xy))]
    wall = np.c_[rng.uniform(-20, 20, 4000), np.full(4000, 7.0), rng.uniform(0, 8, 4000)]
    cars = rng.uniform([3, 2, 0.1], [7, 4, 1.5], (2000, 3))
    echoes = np.c_[rng.uniform(-15, 15, (20, 2)), rng.uniform(-6, -1, 20)]
    return np.concatenate([ground, wall, cars, echoes] if road else [wall, cars])


@pytest.mark.parametrize("offset_m", [0.0, -1.8, 0.3])
@pytest.mark.parametrize("slope", [0.0, 0.08])
def test_the_height_of_the_road_is_found(offset_m: float, slope: float) -> None:
    points = scene(np.random.default_rng(1), slope) + np.array([0, 0, offset_m])
    expected = offset_m + slope * LIDAR[0]
    found = road_below(points, LIDAR + np.array([0, 0, offset_m]))
    assert found == pytest.approx(expected, abs=0.03)


def test_without_a_road_nothing_is_said() -> None:
    rng = np.random.default_rng(2)
    assert road_below(scene(rng, road=False), LIDAR) is None
    assert road_below(np.empty((0, 3)), LIDAR) is None
    assert road_below(scene(rng, slope=0.5), LIDAR) is None


def test_a_mount_at_height_zero_is_told_from_the_right_one() -> None:
    """A LiDAR 1.8 m over the road whose header says 0: the road lies 1.8 m below the vehicle frame."""
    points = scene(np.random.default_rng(4)) - LIDAR
    z = road_below(points, np.zeros(3))
    assert z is not None
    body = BodyworkSurvey().bodywork(0.0)
    survey = DriveSurvey(np.arange(3), np.arange(3.0), np.array([z, z, np.nan]), body, ())
    found = mount_height("d", 0.0, survey)
    assert found.seen_m == pytest.approx(1.8, abs=0.03)
    assert found.road_m == pytest.approx(-1.8, abs=0.03)
    assert (found.scans, found.scans_with_road) == (3, 2)
