"""The shift test: it finds the shift that was put in, and calls no true change one."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from merger_world import TILE
from plain_shift import Surfaces, fits, moved, plain_shift_of
from scipy.spatial import cKDTree
from street_corner import WALLS, displaced, mapped, seen_as, street

from gnd.cloud_merger import shift_kernels
from gnd.cloud_merger.shift import SHIFT_FITS, SHIFT_LEAST_GAUSSIANS, CommonShift, _fits, _Surfaces, shift_of
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.similarity import similarity

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
    assert found.gaussians < SHIFT_LEAST_GAUSSIANS


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
    assert shift_of(flags, BASE) == CommonShift(False, 0)
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


def plain_fits(surfaces, known, motion):
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
        found.append(best >= SHIFT_FITS)
    return found


@settings(max_examples=20, deadline=None)
@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-0.0175, 0.0175))
def test_what_fits_is_what_the_plain_twin_says(east_m, north_m, turn_rad):
    grid = VoxelGrid.of(TILE)
    known, plain = _Surfaces.of(grid, BASE), Surfaces.of(grid, BASE)
    rows = np.arange(0, len(BASE), 60)
    motion = np.array([east_m, north_m, turn_rad])
    found = _fits(_Surfaces.of(grid, BASE, rows), known, motion).tolist()
    assert found == plain_fits(plain.take(rows), plain, motion)
    assert found == fits(plain.take(rows), plain, cKDTree(plain.place_m), motion).tolist()


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 10_000),
    st.floats(-0.9, 0.9),
    st.floats(-0.9, 0.9),
    st.floats(-0.5, 0.5),
    st.floats(-0.017, 0.017),
    st.sampled_from([WALLS, WALLS[:1], WALLS[1:], (*WALLS, (0, -3.0))]),
)
def test_the_kernels_say_what_plain_numpy_says(seed, east_m, north_m, up_m, turn_rad, walls):
    """The same verdict from the same cell of the grid; figures that are rounded otherwise, no more."""
    points = street(seed, walls, 0.02)[::4]
    lifted = points + np.array([0.0, 0.0, up_m])
    points = lifted if seed % 3 == 0 else displaced(points, east_m, north_m, turn_rad)
    change = seen_as(BASE, points)
    ours, twin = shift_of(change, BASE), plain_shift_of(change, BASE)
    assert (ours.is_explained, ours.gaussians) == (twin.is_explained, twin.gaussians)
    for name in ("fit", "chance", "unchanged", "east_m", "north_m", "turn_rad", "up_m"):
        assert getattr(ours, name) == pytest.approx(getattr(twin, name), abs=1e-9), name


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(["ball", "line", "plane", "point", "any"]))
def test_normals_are_those_of_an_eigenvalue_solver(seed, form):
    rng = np.random.default_rng(seed)
    deviation = {"ball": (1, 1, 1), "line": (0, 0, 1), "plane": (0, 1, 1), "point": (0, 0, 0), "any": rng.random(3)}
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0] if seed % 2 else np.eye(3)
    cov = (axes * (0.3 * np.array(deviation[form])) ** 2) @ axes.T
    normal, flat = shift_kernels.normals(cov[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]][None])
    value = np.linalg.eigvalsh(cov)
    least = normal[0] @ cov @ normal[0]
    assert np.linalg.norm(normal[0]) == pytest.approx(1.0, abs=1e-14)
    assert least == pytest.approx(value[0], abs=1e-15)
    expected = 1.0 - np.sqrt(max(value[0], 0.0) / max(value[1], 1e-9))
    assert flat[0] == pytest.approx(expected, abs=3e-4)  # of a line: the root of what rounding leaves


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 10_000), st.floats(1.0, 400.0))
def test_buckets_find_what_a_tree_finds(seed, spread_m):
    """Over a tile, and over more than the buckets span: then the last ones hold the rest."""
    rng = np.random.default_rng(seed)
    *rest, at = rng.uniform(0.0, 1.0, (301, 3)) * [spread_m, 20.0, 6.0]
    place = np.array(rest)
    found, off = np.empty(len(place), np.int64), np.empty(len(place))
    tree = cKDTree(place)
    n = shift_kernels._within(*at, 1.6, place, shift_kernels.buckets_of(place), found, off)
    assert sorted(found[:n].tolist()) == sorted(tree.query_ball_point(at, 1.6))
    n = shift_kernels._nearest(*at, place, shift_kernels.buckets_of(place), found, off)
    distance, nearest = tree.query(at, k=12, distance_upper_bound=1.0)
    assert sorted(found[:n].tolist()) == sorted(nearest[np.isfinite(distance)].tolist())
