"""The shift test: it finds the shift that was put in, and calls no true change one."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from merger_world import TILE
from scipy.spatial import cKDTree
from street_corner import WALLS, displaced, mapped, seen_as, street

from cloud_merger.errors import MergerError
from cloud_merger.shift import Shift, ShiftParameters, _fits, _Surfaces, moved, shift_of
from gnd_map.gaussian import Gaussians, concat
from gnd_map.grid import VoxelGrid
from gnd_map.similarity import similarity

BASE = mapped(street(0))


@pytest.mark.parametrize(
    ("east_m", "north_m", "turn_deg"),
    [(0.2, 0.0, 0.0), (0.0, 0.31, 0.0), (-0.4, 0.3, 0.4), (0.6, -0.6, -0.3), (0.1, 0.15, 0.0)],
)
def test_the_shift_of_wrong_poses_is_found(east_m, north_m, turn_deg):
    turn_rad = np.radians(turn_deg)
    found = shift_of(seen_as(BASE, displaced(street(1), east_m, north_m, turn_rad)), BASE)
    assert found.is_explained
    c, s = np.cos(turn_rad), np.sin(turn_rad)  # back: turned back, about the tile's centre
    back = np.array([[c, s], [-s, c]]) @ [-east_m, -north_m]
    np.testing.assert_allclose([found.east_m, found.north_m], back, atol=0.04)
    assert abs(found.turn_rad + turn_rad) < np.radians(0.25)


@pytest.mark.parametrize("up_m", [0.2, -0.3, 0.5])
def test_a_lidar_that_hangs_elsewhere_raises_all_roads(up_m):
    found = shift_of(seen_as(BASE, street(1) + np.array([0.0, 0.0, up_m])), BASE)
    assert found.is_explained
    assert found.up_m == pytest.approx(-up_m, abs=0.06)
    assert (found.east_m, found.north_m, found.length_m) == (0.0, 0.0, abs(found.up_m))


def test_a_road_of_which_half_was_raised_is_no_shift():
    points = street(3)
    points[(points[:, 2] < 0.35) & (points[:, 0] < -1.0), 2] += 0.3
    change = seen_as(BASE, points)
    assert len(change.changed) > 30
    assert not shift_of(change, BASE).is_explained


def test_an_unchanged_street_says_nothing():
    found = shift_of(seen_as(BASE, street(2)), BASE)
    assert not found.is_explained
    assert found.gaussians < ShiftParameters().least_gaussians


@pytest.mark.parametrize(
    "walls",
    [
        (*WALLS[:2], (1, -5.8)),  # one of two facades that face this way is renewed
        (*WALLS, (0, -3.0), (1, 2.0)),  # two new walls
        WALLS[:1],  # two are gone
    ],
)
def test_a_changed_street_is_no_shift(walls):
    change = seen_as(BASE, street(3, walls))
    assert len(change.changed) > 30
    assert not shift_of(change, BASE).is_explained


def test_without_gaussians_or_without_a_map_nothing_is_said():
    change = seen_as(BASE, displaced(street(1), 0.3, 0.0))
    flags = replace(change, changed=Gaussians.nothing_at(change.changed.voxel_id))
    assert shift_of(flags, BASE) == Shift(False, 0)
    assert not shift_of(change, Gaussians.empty()).is_explained


def test_it_is_wrong_where_all_that_faces_one_way_has_moved():
    """Nothing in the tile tells such a change from a shift; a second vehicle does (`belief`)."""
    assert shift_of(seen_as(BASE, street(3, ((0, 5.6), *WALLS[1:]))), BASE).is_explained


def with_gaussians_of(change, rows):
    """The change with the Gaussians of these rows only, the others not asked for."""
    asked = change.changed.take(rows)
    withheld = np.setdiff1d(change.changed.voxel_id, asked.voxel_id)
    return replace(change, changed=concat([asked, Gaussians.nothing_at(withheld)]))


def test_some_of_the_gaussians_are_enough_and_very_few_say_nothing():
    change = seen_as(BASE, displaced(street(1), 0.3, 0.2))
    asked = np.flatnonzero(change.changed.exists)[::8]
    assert shift_of(with_gaussians_of(change, asked), BASE).is_explained
    assert not shift_of(with_gaussians_of(change, asked[:11]), BASE).is_explained


def test_it_is_a_pure_function():
    change = seen_as(BASE, displaced(street(1), -0.2, 0.4, 0.005))
    assert shift_of(change, BASE) == shift_of(replace(change), BASE.take(np.arange(len(BASE))))


def plain_fits(surfaces, known, motion, parameters):
    """One pair at a time, all base Gaussians within a metre."""
    found = []
    for place, cov in zip(moved(surfaces.place_m, motion), surfaces.cov_m2, strict=True):
        best = 0.0
        for k in np.argsort(np.linalg.norm(known.place_m - place, axis=1), kind="stable")[:12]:
            step = place - known.place_m[k]
            if np.linalg.norm(step) >= 1.0:
                continue
            if known.flat[k] > 0.5:
                step = (step @ known.normal[k]) * known.normal[k]
            yes, zero = np.ones(1, bool), np.zeros((1, 3))
            best = max(best, similarity(yes, zero, known.cov_m2[k][None], yes, step[None], cov[None])[0])
        found.append(best >= parameters.fits)
    return found


@settings(max_examples=20, deadline=None)
@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-0.0175, 0.0175))
def test_what_fits_is_what_the_plain_twin_says(east_m, north_m, turn_rad):
    grid = VoxelGrid.of(TILE)
    known = _Surfaces.of(grid, BASE)
    some = known.take(np.arange(0, len(BASE), 60))
    motion, parameters = np.array([east_m, north_m, turn_rad]), ShiftParameters()
    found = _fits(some, known, cKDTree(known.place_m), motion, parameters)
    assert found.tolist() == plain_fits(some, known, motion, parameters)


@pytest.mark.parametrize("bad", [{"max_m": 0.0}, {"fits": 1.2}, {"least_gaussians": 2}, {"displaced_m": float("nan")}])
def test_parameters_out_of_range_are_refused(bad):
    with pytest.raises(MergerError, match=next(iter(bad))):
        ShiftParameters(**bad)
