"""Every kernel of the pole detector against a plain twin that is written from its description."""

import itertools
from math import pi

import numpy as np
import pytest

from gnd.gnd_map.arrays import F64, I64
from gnd.vehicle_agent.features.poles.kernels import (
    HIDDEN,
    JOINED,
    STEP_RAD,
    Beside,
    Rows,
    azimuth_step,
    layer_gaps,
    polar_of,
    row_order,
    thin_slices,
)
from gnd.vehicle_agent.features.poles.place_kernels import (
    GroundCells,
    around,
    by_cell,
    cone_heights,
    heights_over,
    lowest_heights,
    rays_below,
)

GROUND = GroundCells(-6.0, -6.0, 1.0, 12)
ROWS = Rows(-0.6, 0.007, 172, 36)


def cloud(n: int, seed: int) -> F64:
    rng = np.random.default_rng(seed)
    return np.ascontiguousarray(rng.uniform([-7.0, -7.0, -1.0], [7.0, 7.0, 4.0], (n, 3)))


def polar_cloud(seed: int) -> F64:
    """Rows of a sensor in front of a few things at their own ranges, so that there is something to find."""
    rng = np.random.default_rng(seed)
    azimuth = np.arange(-pi, pi, 0.01)
    rows = []
    for tangent in np.arange(-0.2, 0.25, 0.03):
        distance = np.full(len(azimuth), np.nan)
        for _ in range(25):
            start, width = rng.integers(len(azimuth)), rng.integers(1, 12)
            distance[(start + np.arange(width)) % len(azimuth)] = rng.choice([6.0, 9.0, 9.3, 15.0])
        met = np.isfinite(distance)
        noisy = distance[met] + rng.normal(0.0, 0.02, met.sum())
        rows.append(np.column_stack([azimuth[met], noisy, np.full(met.sum(), tangent)]))
    return np.ascontiguousarray(rng.permutation(np.concatenate(rows)))


@pytest.mark.parametrize("seed", [1, 2])
def test_polar_of_is_numpy(seed: int) -> None:
    points = cloud(500, seed)
    points[::50] = np.nan
    origins = np.random.default_rng(seed).normal(0.0, 0.1, (500, 3))
    kept, polar = polar_of(points, origins, 1.0, 6.0)
    off = points - origins
    distance = np.hypot(off[:, 0], off[:, 1])
    want = np.flatnonzero((distance >= 1.0) & (distance <= 6.0))
    assert kept.tolist() == want.tolist()
    off, distance = off[want], distance[want]
    expected = np.column_stack([np.arctan2(off[:, 1], off[:, 0]), distance, off[:, 2] / distance])
    np.testing.assert_allclose(polar, expected, atol=1e-12)
    one = polar_of(points, origins[:1].copy(), 1.0, 6.0)
    np.testing.assert_array_equal(one[1], polar_of(points, np.repeat(origins[:1], 500, axis=0), 1.0, 6.0)[1])


def test_lowest_heights_are_the_second_lowest_of_each_cell() -> None:
    points = cloud(3000, 3)
    points[:5, 2] = -9.0  # echoes far below the ground
    found = lowest_heights(points, GROUND, 0.0, 0.1, 1.0)
    for i, j in itertools.product(range(12), range(12)):
        inside = (np.floor(points[:, 0] + 6.0) == i) & (np.floor(points[:, 1] + 6.0) == j)
        low = -1.0 - 0.1 * np.hypot(points[:, 0], points[:, 1])
        z = np.sort(points[inside & (points[:, 2] >= low), 2])
        assert found[i, j] == (z[1] if len(z) > 1 else np.inf)


def test_cone_heights_rise_from_the_lowest_along_the_shortest_way() -> None:
    rng = np.random.default_rng(4)
    low = np.where(rng.random((9, 9)) < 0.2, rng.uniform(0.0, 3.0, (9, 9)), np.inf)
    i, j = np.indices(low.shape)
    want = np.full(low.shape, np.inf)
    for a, b in zip(*np.nonzero(np.isfinite(low)), strict=True):
        di, dj = np.abs(i - a), np.abs(j - b)
        steps = np.abs(di - dj) + np.sqrt(2.0) * np.minimum(di, dj)
        want = np.minimum(want, low[a, b] + 0.3 * steps)
    np.testing.assert_allclose(cone_heights(low, 0.3), want)


def test_heights_over_and_by_cell() -> None:
    points, z = cloud(400, 5), np.random.default_rng(5).random((12, 12))
    cells = np.floor(points[:, :2] + 6.0).astype(int)
    inside = ((cells >= 0) & (cells < 12)).all(axis=1)
    height = heights_over(points, z, GROUND)
    np.testing.assert_allclose(height[inside], points[inside, 2] - z[cells[inside, 0], cells[inside, 1]])
    assert np.isinf(height[~inside]).all()
    order, start = by_cell(points, GROUND)
    flat = np.where(inside, cells[:, 0] * 12 + cells[:, 1], 10**6)
    assert order.tolist() == np.argsort(flat, kind="stable")[: inside.sum()].tolist()
    assert start.tolist() == np.searchsorted(np.sort(flat), np.arange(145)).tolist()


@pytest.mark.parametrize("columns", [36, 1])
def test_row_order_is_a_sort_by_row_and_azimuth(columns: int) -> None:
    polar = polar_cloud(6)
    rows = ROWS._replace(columns=columns)  # with one column the cells are long enough for numpy's own sort
    order, start = row_order(polar, rows)
    row = np.floor((polar[:, 2] + 0.6) / 0.007).astype(int)
    assert order.tolist() == np.lexsort((polar[:, 0], row)).tolist()
    assert start.tolist() == np.searchsorted(np.sort(row), np.arange(173)).tolist()


def test_layer_gaps_count_rows_between_returns_of_a_column() -> None:
    polar = polar_cloud(7)
    row = np.floor((polar[:, 2] + 0.6) / 0.007).astype(int)
    column = np.floor((polar[:, 0] + pi) / (2 * pi) * 36).astype(int)
    want = np.zeros(173, int)
    for c in range(36):
        np.add.at(want, np.diff(np.unique(row[column == c])), 1)
    assert layer_gaps(polar, ROWS).tolist() == want.tolist()


def test_azimuth_step_is_the_median_between_neighbours() -> None:
    polar = polar_cloud(8)
    order, start = row_order(polar, ROWS)
    assert azimuth_step(polar, order, start, 0.25) == pytest.approx(0.01, abs=2 * STEP_RAD)
    few = np.ascontiguousarray(polar[:40])
    assert azimuth_step(few, *row_order(few, ROWS), 0.25) == 0.0


def plain_slices(polar: F64, order: I64, start: I64, step: float, beside: Beside) -> set[tuple[frozenset[int], str]]:
    """Slices with what lies to their right and left, row by row, by looking at every pair of rays."""
    found = set()
    for a, b in itertools.pairwise(start.tolist()):
        rays = order[a:b].tolist()
        near = {k: [m for m in rays if m != k and _linked(polar, k, m, step, beside)] for k in rays}
        left, runs = set(rays), []
        while left:
            run, edge = set(), [next(iter(left))]
            while edge:
                k = edge.pop()
                run.add(k)
                edge += [m for m in near[k] if m not in run and _adjacent(polar, rays, k, m)]
            left -= run
            runs.append(run)
        for run in runs:
            sides = _sides(polar, rays, run, step, beside)
            if sides is not None:
                found.add((frozenset(run), sides))
    return found


def _apart(polar: F64, k: int, m: int) -> float:
    """Azimuth from k to m, -pi … pi."""
    return float((polar[m, 0] - polar[k, 0] + pi) % (2 * pi) - pi)


def _adjacent(polar: F64, rays: list[int], k: int, m: int) -> bool:
    n, i, j = len(rays), rays.index(k), rays.index(m)
    return (i - j) % n in (1, n - 1)


def _linked(polar: F64, k: int, m: int, step: float, beside: Beside) -> bool:
    near = min(polar[k, 1], polar[m, 1])
    across = abs(_apart(polar, k, m)) * near
    return bool(across < max(beside.link_m, 2.5 * step * near) and abs(polar[k, 1] - polar[m, 1]) < beside.link_m)


def _sides(polar: F64, rays: list[int], run: set[int], step: float, beside: Beside) -> str | None:
    """What lies beside a run, None when it is no slice."""
    any_ray = next(iter(run))
    along = sorted(run, key=lambda k: _apart(polar, any_ray, k))
    first, last = along[0], along[-1]
    if _apart(polar, first, last) * polar[first, 1] > beside.width_m + step * polar[first, 1]:
        return None
    if np.ptp(polar[along, 1]) >= beside.width_m:
        return None
    sides = []
    for edge, way in ((first, -1), (last, 1)):
        reach = max(beside.clear_m, 1.5 * step * polar[edge, 1])
        off = {m: way * _apart(polar, edge, m) * polar[edge, 1] for m in rays if m not in run}
        inside = [polar[m, 1] - polar[edge, 1] for m, across in off.items() if 0.0 <= across <= reach]
        joined = any(abs(d) <= beside.jump_m for d in inside) or _lies_on_a_line(polar, rays, edge, way, step)
        sides.append(JOINED if joined else HIDDEN if any(d < 0.0 for d in inside) else 0)
    return None if JOINED in sides or sides == [HIDDEN, HIDDEN] else f"{sides[0]}{sides[1]}"


def _lies_on_a_line(polar: F64, rays: list[int], edge: int, way: int, step: float) -> bool:
    n, i = len(rays), rays.index(edge)
    p, q, r = (polar[rays[(i + way * k) % n]] for k in range(3))
    turns = [way * ((b[0] - a[0] + pi) % (2 * pi) - pi) for a, b in ((p, q), (q, r))]
    if n < 4 or not all(0.0 < turn <= 2.5 * step for turn in turns):
        return False
    inverse = 1.0 / q[1] + (1.0 / q[1] - 1.0 / p[1]) * turns[1] / turns[0]
    return bool(inverse > 0.0 and abs(1.0 / inverse - r[1]) < 0.15 + 0.15 * abs(r[1] - q[1]))


@pytest.mark.parametrize("seed", range(4))
def test_thin_slices_are_those_of_the_plain_search(seed: int) -> None:
    polar, beside = polar_cloud(10 + seed), Beside(0.25, 0.55, 0.35, 0.4)
    order, start = row_order(polar, ROWS)
    members, begin, sides = thin_slices(polar, order, start, 0.01, beside)
    found = {
        (frozenset(members[a:b].tolist()), "".join(map(str, side)))
        for (a, b), side in zip(itertools.pairwise(begin.tolist()), sides.tolist(), strict=True)
    }
    assert len(found) == len(sides) > 20
    assert found == plain_slices(polar, order, start, 0.01, beside)


def test_around_counts_by_belt_and_height() -> None:
    points, rng = cloud(4000, 20), np.random.default_rng(20)
    height = points[:, 2] + 1.0
    axes = np.column_stack([rng.uniform(-5, 5, (6, 2)), np.full(6, 1.5), rng.normal(0, 0.05, (6, 2)), np.full(6, 0.1)])
    axes = np.column_stack([axes, np.tile([0.6, 0.8], (6, 1))])
    belts = np.array([0.15, 0.2, 0.65, 0.9, 2.4])
    counts, sums = around(points, height, *by_cell(points, GROUND), GROUND, axes, belts, 0.5, 8)
    inside = (np.abs(points[:, :2]) < 6.0).all(axis=1)
    for c, axis in enumerate(axes):
        off = points[:, :2] - axis[:2] - axis[3:5] * (height - axis[2])[:, None]
        out = np.hypot(*off.T) - axis[5]
        behind = off @ axis[6:8] > axis[5] + belts[3]
        masks = (out <= 0.15, (out > 0.2) & (out <= 0.65), out <= 0.9, (out > 0.9) & (out <= 2.4) & ~behind)
        for b in range(8):
            here = inside & (np.floor(height / 0.5) == b)
            assert counts[c, b].tolist() == [int((here & mask).sum()) for mask in masks]
            x, y = off[here & masks[2]].T
            np.testing.assert_allclose(sums[c, b], [x.sum(), y.sum(), x @ x, x @ y, y @ y], atol=1e-9)


def test_rays_below_are_those_that_pass_under_or_end_before() -> None:
    points = cloud(30_000, 21) * [3.0, 3.0, 1.0]
    origins = np.array([[0.0, 0.0, 2.0]])
    places = np.array([[6.0, 1.0, 0.0, 1.5], [-4.0, 5.0, 0.2, 2.0]])
    found = rays_below(points, origins, places, 0.3)
    for place, counted in zip(places, found, strict=True):
        off, there = points - origins, place[:2] - origins[0, :2]
        length = np.hypot(off[:, 0], off[:, 1])
        along = off[:, :2] @ there / length
        across = np.abs(off[:, 0] * there[1] - off[:, 1] * there[0]) / length
        z = 2.0 + off[:, 2] / length * along
        under = (along > 0) & (across <= 0.3) & (z > place[2] + 0.1) & (z < place[3] - 0.05)
        want = [int((under & (length < along - 0.3)).sum()), int((under & (length > along + 0.3)).sum())]
        assert counted.tolist() == want
        assert min(want) > 0
