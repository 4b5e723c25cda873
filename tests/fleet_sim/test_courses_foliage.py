"""Leaves that let rays through: how many pass, where the others end, what hides what."""

from dataclasses import astuple

import numpy as np
import pytest

from gnd.fleet_sim.courses.foliage import Foliage, Leaves
from gnd.fleet_sim.errors import DriveSimError
from gnd.fleet_sim.lidar import Lidar
from gnd.fleet_sim.raycast import Scene
from gnd.fleet_sim.sensors import VLP16
from gnd.fleet_sim.shapes import Block

COLUMNS, BEAMS = 500, 20
HEDGE = Leaves(10.0, 0.0, 0.0, 1.0, 3.0, 3.0, 0.8, box=True)
CROWN = Leaves(12.0, 0.5, 0.2, 2.5, 2.0, 1.5, 0.5)


def shots(spread: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays from the origin ahead, in a fan of `spread` rad (one direction where it is 0)."""
    poses = np.tile(np.eye(4)[:3], (COLUMNS + 1, 1, 1))
    side, up = np.meshgrid(
        spread * np.linspace(-0.5, 0.5, COLUMNS), spread * np.linspace(-0.5, 0.5, BEAMS), indexing="ij"
    )
    directions = np.stack([np.ones_like(side), side, up], axis=-1)
    return poses, directions / np.linalg.norm(directions, axis=-1, keepdims=True), np.zeros(BEAMS)


def met(leaves, spread=0.0, seed=1, t_s=0.0, opaque_m=np.inf, limit_m=100.0):
    """Ranges (COLUMNS, BEAMS) and what was found there; an opaque wall stands at `opaque_m`."""
    size = (COLUMNS, BEAMS)
    found = np.full(size, 0 if np.isfinite(opaque_m) else -1, np.int32)
    hits = (np.full(size, opaque_m), found, np.ones(size))
    Foliage(leaves, seed).meet(shots(spread), limit_m, (t_s, 0.5), 1, hits)
    return hits


@pytest.mark.parametrize("per_m", [0.2, 0.8, 2.0])
def test_the_share_that_passes_falls_exponentially_with_the_way(per_m):
    leaves = Leaves(10.0, 0.0, 0.0, 1.0, 3.0, 3.0, per_m, box=True)
    passed = np.mean(met([leaves])[1] < 0)
    expected = np.exp(-2.0 * per_m)
    assert passed == pytest.approx(expected, abs=4 * np.sqrt(expected * (1 - expected) / (COLUMNS * BEAMS)))


def test_two_volumes_along_a_ray_are_as_one_of_both_lengths():
    other = Leaves(20.0, 0.0, 0.0, 1.5, 3.0, 3.0, 0.4, box=True)
    _, found, _ = met([HEDGE, other])
    assert np.mean(found < 0) == pytest.approx(np.exp(-2.0 * 0.8 - 3.0 * 0.4), abs=0.015)
    assert np.mean(found == 1) == pytest.approx(1 - np.exp(-2.0 * 0.8), abs=0.02)


def test_leaves_are_met_inside_and_the_way_to_them_is_exponential():
    ranges, found, incidence = met([HEDGE])
    depth = ranges[found >= 0] - 9.0
    assert 0.0 < depth.min() < 0.01 < depth.max() < 2.0
    mean = 1 / 0.8 - 2.0 / np.expm1(0.8 * 2.0)  # of an exponential cut off at 2 m
    assert depth.mean() == pytest.approx(mean, abs=0.03)
    assert 0.3 <= incidence[found >= 0].min() < incidence[found >= 0].max() <= 1.0


def test_points_in_a_crown_lie_in_its_ellipsoid_and_rays_that_miss_it_pass():
    ranges, found, _ = met([CROWN], spread=0.9)
    x, y, z, a, b, c, *_ = astuple(CROWN)
    _, directions, _ = shots(0.9)
    hit = found >= 0
    points = directions[hit] * ranges[hit][:, None]
    inside = (((points - [x, y, z]) / [a, b, c]) ** 2).sum(axis=1)
    assert hit.sum() > 500
    assert inside.max() <= 1.0 + 1e-9
    closest = np.cross(directions, np.array([x, y, z])) / 1.0
    assert not hit[np.linalg.norm(closest, axis=-1) > max(a, b, c)].any()


def test_the_share_through_a_crown_is_that_of_its_chords():
    """A plain twin: every ray's chord through the ellipsoid, in numpy."""
    _, directions, _ = shots(0.9)
    middle, axes = np.array(astuple(CROWN)[:3]), np.array(astuple(CROWN)[3:6])
    o, d = -middle / axes, directions / axes
    a, b, c = (d * d).sum(-1), (d * o).sum(-1), (o * o).sum() - 1.0
    chord = 2.0 * np.sqrt(np.maximum(b * b - a * c, 0.0)) / a
    expected = 1.0 - np.exp(-CROWN.per_m * chord)
    assert np.mean(met([CROWN], spread=0.9)[1] >= 0) == pytest.approx(expected.mean(), abs=0.01)


def test_what_stands_before_the_leaves_hides_them_and_a_sensor_sees_no_farther_than_it_can():
    assert not (met([HEDGE], opaque_m=8.0)[1] == 1).any()
    behind = met([HEDGE], opaque_m=15.0)
    assert set(np.unique(behind[1])) == {0, 1}
    assert behind[0][behind[1] == 0] == pytest.approx(15.0)
    assert (met([HEDGE], limit_m=9.5)[0][met([HEDGE], limit_m=9.5)[1] >= 0] < 9.5).all()


def test_a_sensor_inside_the_leaves_meets_them_at_once():
    ranges, found, _ = met([Leaves(0.0, 0.0, 0.0, 2.0, 2.0, 2.0, 5.0)])
    assert np.mean(found >= 0) > 0.99
    assert ranges[found >= 0].mean() == pytest.approx(0.2, abs=0.02)


def test_the_same_seed_and_time_give_the_same_leaves_another_time_others():
    first, again, later, other = met([HEDGE]), met([HEDGE]), met([HEDGE], t_s=0.1), met([HEDGE], seed=2)
    assert np.array_equal(first[0], again[0])
    assert not np.array_equal(first[0], later[0])
    assert not np.array_equal(first[0], other[0])
    assert np.mean((first[1] >= 0) & (later[1] >= 0)) == pytest.approx(np.mean(first[1] >= 0) ** 2, abs=0.02)


def test_a_lidar_sees_leaves_and_the_wall_behind_them():
    scene = Scene.build((Block(14.0, 0.0, 0.5, 20.0, -5.0, 10.0), Block(0.0, 0.0, 30.0, 30.0, -6.0, -5.0)))
    foliage = Foliage([Leaves(8.0, 0.0, 0.0, 1.0, 15.0, 5.0, 0.5, box=True)], 3)
    poses = np.tile(np.eye(4), (VLP16.columns + 1, 1, 1))
    sweep = Lidar(VLP16).sweep(scene, poses, np.random.default_rng(0), None, 0.0, foliage)
    ahead = (np.abs(sweep.points_lidar_m[:, 1]) < 2.0) & (sweep.points_lidar_m[:, 0] > 0.0)
    leaf = sweep.primitive[ahead] == len(scene.packed)
    assert 0.3 < leaf.mean() < 0.9
    x = sweep.points_lidar_m[ahead, 0]
    assert ((x[leaf] > 6.8) & (x[leaf] < 9.2)).all()
    assert x[~leaf] == pytest.approx(13.5, abs=0.2)


@pytest.mark.parametrize("change", [{"per_m": 0.0}, {"half_x_m": -1.0}, {"x_m": np.nan}])
def test_impossible_leaves_are_refused(change):
    values = dict(zip(Leaves.__dataclass_fields__, astuple(HEDGE), strict=True))
    with pytest.raises(DriveSimError):
        Leaves(**{**values, **change})
    with pytest.raises(DriveSimError, match="at least one"):
        Foliage([], 0)
