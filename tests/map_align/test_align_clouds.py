"""Aligning maps of built worlds whose place is known, and those that look right and must be refused."""

import numpy as np
import pytest

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.se3 import T_inverse, exp_so3, transform
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId, covering_circle
from gnd.vehicle_agent.map_align.align import MapAlignment, align_clouds, difference
from gnd.vehicle_agent.map_align.candidates import Reach, about
from gnd.vehicle_agent.map_align.cloud import GaussianCloud, cloud_of_tiles
from gnd.vehicle_agent.map_align.fit import lay_onto, pairs_of

PLACE = np.radians(37.5597), np.radians(127.0365)
FRAME = LocalFrame.of_tile(TileId.from_geodetic(*PLACE))
HALF_M = 45.0
NOISE_M = 0.02
REACH = Reach(8.0, 4.0, 8.0)


def wall(rng: np.random.Generator, start: tuple[float, float], end: tuple[float, float], high_m: float = 5.0) -> F64:
    """Points (N, 3) of an upright wall, 150 a square metre."""
    length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
    part = rng.uniform(0, 1, (int(150 * length * high_m), 1))
    flat = np.array(start) * (1 - part) + np.array(end) * part
    return np.asarray(np.c_[flat, rng.uniform(0, high_m, len(part))])


def road(rng: np.random.Generator, half_width_m: float = 7.0) -> F64:
    n = int(100 * 4 * HALF_M * half_width_m)
    return np.asarray(np.c_[rng.uniform(-HALF_M, HALF_M, n), rng.uniform(-half_width_m, half_width_m, n), np.zeros(n)])


def town(seed: int) -> tuple[list[tuple[float, float, float]], list[tuple[float, float]]]:
    """House fronts (from x, to x, y) and posts (x, y) of a street of houses that differ."""
    rng, fronts = np.random.default_rng(seed), list[tuple[float, float, float]]()
    for side in (-1, 1):
        x = -HALF_M
        while x < HALF_M - 4.0:
            wide = rng.uniform(5, 12)
            fronts.append((x, min(x + wide, HALF_M), side * rng.uniform(7, 11)))
            x += wide + rng.uniform(0.5, 4)
    return fronts, [(rng.uniform(-HALF_M, HALF_M), rng.choice([-6.0, 6.0])) for _ in range(14)]


def points_of(seed: int, pass_: int) -> F64:
    """Points of one pass through the town."""
    rng, (fronts, posts) = np.random.default_rng([seed, pass_]), town(seed)
    parts = [road(rng)]
    for left, right, y in fronts:
        back = y + np.sign(y) * 4.0
        parts += [wall(rng, (left, y), (right, y)), wall(rng, (left, y), (left, back))]
        parts += [wall(rng, (right, y), (right, back))]
    for x, y in posts:
        parts.append(np.array([x, y, 0]) + rng.uniform([-0.1, -0.1, 0], [0.1, 0.1, 4], (1500, 3)))
    points = np.concatenate(parts)
    return points + NOISE_M * rng.standard_normal(points.shape)


def corridor(pass_: int, period_m: float | None) -> F64:
    """A tunnel; with a period, posts along its walls."""
    rng = np.random.default_rng([7, pass_])
    parts = [road(rng), *(wall(rng, (-HALF_M, y), (HALF_M, y)) for y in (-7.0, 7.0))]
    if period_m is not None:
        for x in np.arange(-HALF_M, HALF_M, period_m):
            for y in (-6.0, 6.0):
                parts += [wall(rng, (x, y), (x, y + np.sign(y) * 0.9)), wall(rng, (x + 0.6, y), (x + 0.6, y * 1.15))]
    points = np.concatenate(parts)
    return points + NOISE_M * rng.standard_normal(points.shape)


def map_of(points_m: F64) -> GaussianCloud:
    """The map that these points become, in the voxels of where they lie."""
    accumulator = VoxelAccumulator(GridFrame.around(FRAME, covering_circle(*PLACE, 150.0)))
    accumulator.add(points_m)
    return cloud_of_tiles([Tile(tile, 1, found) for tile, found in accumulator.finish().items()], FRAME)


def motion(seed: int) -> F64:
    rng = np.random.default_rng(seed)
    T = about(np.zeros(3), float(np.radians(rng.uniform(-2.5, 2.5))))
    T[:3, :3] = exp_so3(np.radians([*rng.uniform(-0.3, 0.3, 2), 0.0])) @ T[:3, :3]
    T[:3, 3] = [*rng.uniform(-5, 5, 2), rng.uniform(-3, 3)]
    return T


def why(found: MapAlignment) -> str:
    return " | ".join(found.reasons)


@pytest.fixture(scope="module")
def a() -> GaussianCloud:
    return map_of(points_of(1001, 1))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_a_second_pass_is_found_where_it_is(a: GaussianCloud, seed: int) -> None:
    T = motion(seed)
    found = align_clouds(a, map_of(transform(T_inverse(T), points_of(1001, 2))), REACH)
    assert found.fits, why(found)
    error_m, error_rad = difference(found.T_a_b, T, found.pivot_m)
    assert error_m < 0.03
    assert error_rad < np.radians(0.1)
    sigma = np.sqrt(np.diag(found.covariance))
    assert error_m < 4.0 * np.linalg.norm(sigma[3:])
    assert found.median_m < 0.02
    assert found.as_dict()["second_best"]["worth"] < 0.75


@pytest.mark.slow
def test_another_street_is_refused(a: GaussianCloud) -> None:
    for seed in (1002, 1003):
        found = align_clouds(a, map_of(points_of(seed, 1)), REACH)
        assert not found.fits, seed


@pytest.mark.slow
@pytest.mark.parametrize("period_m", [None, 5.0])
def test_what_repeats_itself_or_leaves_the_way_open_is_ambiguous(period_m: float | None) -> None:
    tunnel = map_of(corridor(1, period_m))
    found = align_clouds(tunnel, map_of(corridor(2, period_m) + np.array([1.3, 0.2, 0.1])), REACH)
    assert "ambiguous" in why(found), found.as_dict()
    assert found.second > 0.9


@pytest.mark.slow
def test_a_bent_map_is_refused_although_most_of_it_fits(a: GaussianCloud) -> None:
    p = points_of(1001, 2)
    bent = p + np.c_[np.zeros(len(p)), 0.6 * np.maximum(p[:, 0], 0.0) ** 2 / HALF_M**2, np.zeros(len(p))]
    found = align_clouds(a, map_of(bent), REACH)
    assert "bent" in why(found), found.as_dict()
    assert found.bend_m > 0.12


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.3048, 1.006, 3.2808])
def test_other_units_are_refused(a: GaussianCloud, scale: float) -> None:
    found = align_clouds(a, map_of(scale * points_of(1001, 2)), REACH)
    assert not found.fits
    if scale == 1.006:
        assert found.scale == pytest.approx(0.006, abs=0.002)
        assert "% larger" in why(found)


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1])
def test_mirrored_axes_are_refused(a: GaussianCloud, axis: int) -> None:
    p = points_of(1001, 2)
    p[:, axis] *= -1
    assert not align_clouds(a, map_of(p), REACH).fits


def test_no_overlap_is_refused_with_its_size(a: GaussianCloud) -> None:
    away = np.eye(4)
    away[1, 3] = 200.0
    found = align_clouds(a, a.moved(away), REACH)
    assert "too little overlap: 0 m2" in why(found)
    assert "too little overlap" in why(align_clouds(a, a.take(np.empty(0, np.int64)), REACH))
    assert "too little overlap" in why(align_clouds(a, a.take(a.mean_m[:, 0] > HALF_M - 5.0), REACH))


def test_what_lies_beyond_the_search_is_not_pulled_to_its_edge(a: GaussianCloud) -> None:
    away = np.eye(4)
    away[0, 3] = 11.0
    assert not align_clouds(a, a.moved(away), Reach(4.0, 1.0, 5.0)).fits


def test_a_wall_says_nothing_along_itself() -> None:
    """Voxels cut a wall at the same places in both maps; that must not hold them together along it."""
    tunnel = corridor(1, None)
    a, b = map_of(tunnel), map_of(tunnel + np.array([0.4, 0.0, 0.0]))
    fit = lay_onto(a, b, np.eye(4))
    assert fit is not None
    information = np.diag(fit.H)[3:]
    assert information[0] < 0.05 * information[1]


def test_pairs_are_the_nearest_surfaces_of_the_same_kind(a: GaussianCloud) -> None:
    """Against the plain search over all pairs."""
    b = a.take(np.arange(0, len(a), 40))
    shift = np.eye(4)
    shift[:3, 3] = 0.15, -0.1, 0.05
    b = b.moved(shift)
    pairs = pairs_of(a, b, 0.15)
    assert len(pairs.row) > 50
    apart = np.linalg.norm(b.mean_m[pairs.row][:, None] - a.mean_m[a.surfaces][None], axis=2)
    found = np.linalg.norm(pairs.offset_m, axis=1)
    assert (found >= apart.min(axis=1) - 1e-9).all()
    assert (found <= np.sort(apart, axis=1)[:, 3] + 1e-9).all()  # among the four nearest
    assert (pairs.across_m <= found + 1e-9).all()
