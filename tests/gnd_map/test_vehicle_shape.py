"""What has the shape of a vehicle, and what has not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components
from things_testing import GRID, GROUND_M, box, car, gaussians, new_against, street

from gnd.gnd_map.beside import count_beside, groups_of
from gnd.gnd_map.over_ground import ground_m, places_m
from gnd.gnd_map.vehicle_shape import (
    GROUND_BELOW_M,
    GROUND_REACH_M,
    _footprint_m,
    _size_m,
    has_vehicle_shape,
)

STREET = gaussians(street())
MIDDLE = (15.0, 18.0)


def share(*points, before=STREET):
    """The share of the new voxels that have the shape of a vehicle."""
    new = new_against(before, *points)
    assert len(new)
    return has_vehicle_shape(GRID, before, new).mean()


@given(st.floats(0.0, np.pi), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(3.6, 5.2), st.floats(1.4, 1.9))
@settings(max_examples=60, deadline=None)
def test_a_car_is_one_wherever_and_however_it_stands(turned_rad, dx, dy, length, top):
    assert share(car(MIDDLE[0] + dx, MIDDLE[1] + dy, turned_rad, length=length, top=top)) == 1.0


@pytest.mark.parametrize("level_m", [40.02, 40.25, 40.5, 40.75, 40.98])
def test_a_car_is_one_wherever_the_road_lies_in_its_voxels(level_m):
    before = gaussians(street(level_m=level_m))
    assert share(car(*MIDDLE, 0.5, ground_m=level_m), before=before) == 1.0


@pytest.mark.parametrize("turned_rad", [0.0, 0.6, 1.57])
def test_vans_rows_of_cars_and_boxes_that_stand_on_the_ground_are_vehicles(turned_rad):
    along = np.array([np.cos(turned_rad), np.sin(turned_rad)])
    row = [car(*(MIDDLE + k * 6.0 * along), turned_rad) for k in (-1, 0, 1)]
    assert share(*row) == 1.0
    assert share(box(*MIDDLE, 5.3, 2.0, GROUND_M + 0.3, GROUND_M + 2.5, turned_rad)) == 1.0  # a van
    assert share(box(*MIDDLE, 4.5, 1.8, GROUND_M, GROUND_M + 1.5, turned_rad)) == 1.0  # a car as a box on the road


def row_of_cars(pitch_m, number, turned_rad, away_rad):
    along = np.array([np.cos(turned_rad), np.sin(turned_rad)])
    places = MIDDLE + (np.arange(number) - (number - 1) / 2)[:, None] * pitch_m * along
    return [car(*place, turned_rad + away_rad) for place in places]


@given(st.floats(0.0, np.pi), st.floats(4.8, 7.0), st.integers(2, 3))
@settings(max_examples=40, deadline=None)
def test_cars_one_behind_the_other_are_vehicles_however_near_they_stand(turned_rad, pitch_m, number):
    assert share(*row_of_cars(pitch_m, number, turned_rad, 0.0)) > 0.9


@given(st.floats(0.0, np.pi), st.floats(2.3, 2.6), st.integers(2, 5))
@settings(max_examples=40, deadline=None)
def test_cars_side_by_side_are_vehicles(turned_rad, pitch_m, number):
    assert share(*row_of_cars(pitch_m, number, turned_rad, np.pi / 2)) > 0.9


@pytest.mark.parametrize("turned_rad", [0.0, 0.6, 1.2])
def test_a_car_on_a_pavement_that_is_new_is_one_and_the_pavement_is_none(turned_rad):
    before = gaussians(street(level_m=40.9))
    paving = box(*MIDDLE, 14.0, 6.0, 40.9, 41.06)
    assert share(paving, before=before) == 0.0
    both = new_against(before, paving, car(*MIDDLE, turned_rad, ground_m=41.05))
    found = has_vehicle_shape(GRID, before, both)
    assert found[~np.isin(both.voxel_id, new_against(before, paving).voxel_id)].all()


@given(st.floats(0.0, np.pi), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
@settings(max_examples=40, deadline=None)
def test_a_footprint_is_that_of_the_thing(turned_rad, dx, dy):
    new = new_against(STREET, box(15.0 + dx, 18.0 + dy, 6.0, 0.3, GROUND_M, GROUND_M + 1.4, turned_rad))
    width, length = _size_m(*_footprint_m(places_m(GRID, new)[:, :2], new.cov_m2.astype(np.float64)))
    assert 0.2 < width < 1.0  # in a voxel with an end of it the Gaussian is rounder than the wall
    assert length == pytest.approx(6.1, abs=0.3)


def test_places_are_those_of_the_grid():
    ids = GRID.voxel_id(*np.meshgrid([0, 3, 17], [0, 5, 21], [40, 41]))
    new = gaussians(street()).take(np.arange(ids.size))
    moved = type(new)(np.sort(ids.ravel()), new.count, new.cells, new.mean_m, new.cov_m2)
    apart = np.diff(places_m(GRID, moved), axis=0)
    oracle = np.diff(GRID.centre_m(moved.voxel_id) + moved.mean_m, axis=0)
    assert np.abs(apart - oracle).max() < 0.01  # the tile's ENU frame is curved against its grid


@pytest.mark.parametrize("slope", [-0.12, 0.12])
def test_a_car_on_a_steep_street_is_one(slope):
    before = gaussians(street(slope))
    x, y = MIDDLE
    assert share(car(x, y, ground_m=GROUND_M + slope * x), before=before) == 1.0


THINGS = {
    "a wall": box(*MIDDLE, 12.0, 0.3, GROUND_M, GROUND_M + 1.6, 0.3),
    "a low wall": box(*MIDDLE, 5.0, 0.4, GROUND_M, GROUND_M + 1.3, 0.6),
    "a long low front": box(*MIDDLE, 14.0, 1.8, GROUND_M, GROUND_M + 1.5, 0.3),
    "a container": box(*MIDDLE, 6.06, 2.6, GROUND_M, GROUND_M + 2.6, 0.4),
    "a barrier": np.concatenate([box(15.0, y, 0.6, 1.9, GROUND_M, GROUND_M + 0.9) for y in (14.0, 16.3, 18.6)]),
    "a house": box(*MIDDLE, 9.0, 8.0, GROUND_M, GROUND_M + 6.0),
    "a tall container": box(*MIDDLE, 12.0, 2.5, GROUND_M, GROUND_M + 2.8),
    "a pole": box(*MIDDLE, 0.2, 0.2, GROUND_M, GROUND_M + 6.0),
    "a bollard": box(*MIDDLE, 0.2, 0.2, GROUND_M, GROUND_M + 1.0),
    "a balcony": box(*MIDDLE, 4.0, 1.5, GROUND_M + 3.0, GROUND_M + 4.2),
    "a cabinet": box(*MIDDLE, 1.8, 1.2, GROUND_M, GROUND_M + 2.0, 0.4),
    "a kerb": box(*MIDDLE, 9.0, 2.0, GROUND_M, GROUND_M + 0.6),
    "a field of rubble": box(*MIDDLE, 11.0, 10.0, GROUND_M, GROUND_M + 1.5),
}


@pytest.mark.parametrize("thing", THINGS)
def test_what_is_no_vehicle_is_none(thing):
    assert share(THINGS[thing]) == 0.0


def test_a_car_beside_a_house_is_one_and_the_house_is_none():
    x, y = MIDDLE
    parked, house = new_against(STREET, car(x, y)), new_against(STREET, box(x, y + 4.1, 9.0, 5.0, GROUND_M, 47.0))
    both = new_against(STREET, car(x, y), box(x, y + 4.1, 9.0, 5.0, GROUND_M, 47.0))
    assert len(groups_of(np.stack(GRID.unravel(both.voxel_id), 1), np.arange(len(both)))) == 1  # they touch
    found = has_vehicle_shape(GRID, STREET, both)
    own = np.isin(both.voxel_id, parked.voxel_id) & ~np.isin(both.voxel_id, house.voxel_id)
    assert found[own].mean() > 0.9
    assert found[~own].mean() < 0.1


def test_where_the_map_has_no_ground_nobody_knows():
    empty = STREET.take(np.zeros(0, np.int64))
    assert not has_vehicle_shape(GRID, empty, gaussians(car(*MIDDLE))).any()
    assert len(has_vehicle_shape(GRID, STREET, empty)) == 0


@given(st.lists(st.tuples(*[st.integers(0, 6)] * 3), min_size=1, max_size=60, unique=True))
@settings(max_examples=100, deadline=None)
def test_groups_are_those_of_a_graph_of_neighbours(voxels):
    index = np.array(voxels, np.int64)
    near = (np.abs(index[:, None] - index[None]) <= 1).all(axis=2)
    label = connected_components(near, directed=False)[1]
    plain = sorted(np.flatnonzero(label == k).tolist() for k in range(label.max() + 1))
    assert sorted(one.tolist() for one in groups_of(index, np.arange(len(index)))) == plain


def test_the_ground_is_the_median_of_what_is_flat_near_and_below():
    rng = np.random.default_rng(3)
    place, flat = rng.uniform([0, 0, 0], [12, 12, 6], (80, 3)), rng.uniform([0, 0, 0], [12, 12, 6], (150, 3))
    found = ground_m(place, flat, GROUND_REACH_M, GROUND_BELOW_M)
    for (x, y, z), height in zip(place, found, strict=True):
        near = np.hypot(flat[:, 0] - x, flat[:, 1] - y) <= GROUND_REACH_M
        below = flat[near & (flat[:, 2] < z) & (flat[:, 2] > z - GROUND_BELOW_M), 2]
        assert np.isnan(height) if not len(below) else height == np.median(below)


def test_voxels_that_touch_are_counted_as_a_tree_counts_them():
    rng = np.random.default_rng(4)
    one, other = rng.integers(0, 9, (60, 3)), rng.integers(0, 9, (40, 3))
    plain = (np.abs(one[:, None] - other[None]).max(axis=2) <= 1).sum(axis=1)
    assert count_beside(one, other).tolist() == plain.tolist()
