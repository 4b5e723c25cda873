"""A sensor of a few level layers beside a wall: what it meets, and passes, of the Gaussians at the wall's foot, which
hold the wall and the ground together.
"""

import numpy as np
import pytest
from gate_scene import CORRIDOR, Wall, surfaces
from numpy.typing import NDArray
from vehicle_scene import FIGURE_2, GRID_FRAME, GROUND_M, tiles_of

from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.se3 import exp_so3
from gnd.vehicle_agent.detect.classify import Classification, classify
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.level import sees_tilt

LEVEL = np.radians([-1.2, -0.4, 0.4, 1.2])
MANY = np.radians(np.arange(-15.0, 16.0, 2.0))
EYE_M = 0.6
FAR_M = 40.0
LOW_M = 0.6
"""The ground lies so much lower than in the yard: most of a wall's lowest metre is in one voxel with it."""
TURNED = exp_so3(np.array([0.0, 0.0, np.radians(25.0)]))
"""The walls cross the voxels aslant."""
WITHOUT_LEFT: tuple[Wall, ...] = CORRIDOR[:1]


def lain(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((points - [0.0, 0.0, LOW_M]) @ TURNED.T)


@pytest.fixture(scope="module")
def street() -> LocalMap:
    local_map = LocalMap(GRID_FRAME)
    held = tiles_of(lain(surfaces(CORRIDOR, np.random.default_rng(1), 150.0, 0.01)))
    for tile_id in {*held, *FIGURE_2}:
        local_map.set_tile(held[tile_id]) if tile_id in held else local_map.set_absent(tile_id)
    return local_map


def scan(
    walls: tuple[Wall, ...], x_m: float, elevations: NDArray[np.float64], rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points on walls along x (3 m high) and on the ground, with 2 cm of noise; where nothing is met they lie far."""
    azimuth, elevation = (a.ravel() for a in np.meshgrid(np.radians(np.arange(0.0, 360.0, 0.5)), elevations))
    v = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
    t = np.full(len(v), FAR_M)
    with np.errstate(divide="ignore"):
        for (_, y_m), _ in walls:
            at = np.where(y_m / v[:, 1] > 0.0, y_m / v[:, 1], np.inf)
            inside = (np.abs(x_m + at * v[:, 0]) < 23.0) & (np.abs(EYE_M - 1.5 + at * v[:, 2]) < 1.5)
            t = np.where(inside, np.minimum(t, at), t)
        t = np.minimum(t, np.where(v[:, 2] < 0.0, -EYE_M / v[:, 2], np.inf))
    eye = np.array([x_m, 0.0, GROUND_M + EYE_M])
    points = eye + v * t[:, None] + rng.normal(0.0, 0.02, v.shape)
    return lain(points), lain(np.broadcast_to(eye, v.shape))


def driven(street: LocalMap, walls: tuple[Wall, ...], elevations: NDArray[np.float64]) -> list[Classification]:
    detector, rng = ChangeDetector(street), np.random.default_rng(3)
    for x_m in np.arange(-10.0, 10.0, 0.5):
        points, origins = scan(walls, float(x_m), elevations, rng)
        detector.add_scan(points, origins, sees_heights=sees_tilt(points - origins))
    return [classify(evidence, detector.parameters) for evidence in detector.finish(detector.touched_tiles()).values()]


def number(found: list[Classification], *classes: ChangeClass) -> int:
    return sum(int(np.isin(one.change_class, classes).sum()) for one in found)


def test_nothing_has_changed_where_nothing_has(street: LocalMap) -> None:
    found = driven(street, CORRIDOR, LEVEL)
    assert number(found, ChangeClass.NORMAL) > 50
    assert number(found, ChangeClass.MODIFIED, ChangeClass.DELETED) == 0


def test_a_wall_that_is_gone_is_found_by_its_planes(street: LocalMap) -> None:
    found = driven(street, WITHOUT_LEFT, LEVEL)
    planes = number(found, ChangeClass.DELETED)
    assert planes > 20
    assert all(one.evidence.at_one_height for one in found)


def test_many_layers_delete_what_is_no_plane_too(street: LocalMap) -> None:
    level, many = (driven(street, WITHOUT_LEFT, elevations) for elevations in (LEVEL, MANY))
    assert not any(one.evidence.at_one_height for one in many)
    assert number(many, ChangeClass.DELETED) > number(level, ChangeClass.DELETED)
