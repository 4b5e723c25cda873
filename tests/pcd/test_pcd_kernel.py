import numpy as np
import pytest
from pcd_world import scans
from plain_pcd import PlainPcd

from gnd.gnd_map.errors import ShapeError
from studies.pcd import PcdDetector, PcdError, PcdMap
from studies.pcd.detector import box_sums
from studies.pcd.index import index_of
from studies.pcd.kernel import EMPTY, support_sums, surface_normals


@pytest.fixture(scope="module")
def some_scans(boxes):
    rng = np.random.default_rng(5)
    chosen = []
    for points, origins in list(scans(boxes, 9))[::9]:
        rows = np.sort(rng.choice(len(points), 250, replace=False))
        chosen.append((points[rows], origins[rows], rng.random(250) < 0.1))
    return chosen


def test_rays_count_as_the_plain_twin_does(cloud, some_scans):
    detector = PcdDetector(cloud)
    plain = PlainPcd(detector)
    for points, origins, moving in some_scans:
        detector.add_scan(points, origins, moving)
        plain.scan(points, origins, moving)
    c, rows, shape = detector._counts, len(detector.index.base.start), detector.index.base.shape
    np.testing.assert_array_equal(c.map_hits, plain.hits)
    np.testing.assert_array_equal(c.map_passes, plain.passes)
    assert plain.hits.sum() > 300
    assert plain.passes.sum() > 5
    state = c.state.reshape(shape)
    empty = {tuple(b): int(EMPTY - state[tuple(b)]) for b in np.argwhere(state < EMPTY).tolist()}
    assert empty == {b: n for b, n in plain.block_passes.items() if b not in plain.new_blocks}
    assert int((c.state >= rows).sum()) + int((c.new_of >= 0).sum()) == len(plain.new_blocks)
    row, cell = np.nonzero(c.new_hits)
    at = detector.index.corners_of(c.new_block[row]) + np.stack(np.unravel_index(cell, (5, 5, 5)), axis=1)
    assert {tuple(a): int(n) for a, n in zip(at.tolist(), c.new_hits[row, cell], strict=True)} == plain.new_hits
    assert int(c.new_passes.sum()) == sum(plain.new_passes.values())


def test_one_origin_for_all_is_the_same(cloud, some_scans):
    one, each = PcdDetector(cloud), PcdDetector(cloud)
    points, origins, _ = some_scans[0]
    one.add_scan(points, origins[0])
    each.add_scan(points, np.broadcast_to(origins[0], points.shape))
    np.testing.assert_array_equal(one._counts.map_hits, each._counts.map_hits)
    np.testing.assert_array_equal(one._counts.state, each._counts.state)


def test_rows_for_new_blocks_grow(cloud, some_scans, monkeypatch):
    monkeypatch.setattr("studies.pcd.detector._FIRST_ROWS", 1)
    small = PcdDetector(cloud)
    monkeypatch.undo()
    large = PcdDetector(cloud)
    for points, origins, moving in some_scans:
        small.add_scan(points, origins, moving)
        large.add_scan(points, origins, moving)
    assert small._used == large._used > 1
    np.testing.assert_array_equal(small._counts.new_hits[: small._used], large._counts.new_hits[: large._used])


def test_normals_are_those_of_numpy(cloud):
    index = index_of(cloud, 10.0)
    rows = np.random.default_rng(2).choice(len(index.cells), 400, replace=False)
    normal = surface_normals(index.base, index.state, index.cells, 10.0)
    at = {tuple(c): u for u, c in enumerate(index.cells.tolist())}
    planar = 0
    for u in rows.tolist():
        around = [at.get(tuple(index.cells[u] + np.array(s) - 1)) for s in np.ndindex(3, 3, 3)]
        points = index.base.point_m[[w for w in around if w is not None]].astype(float)
        values, vectors = np.linalg.eigh(np.cov(points.T, bias=True) + 1e-6 * np.eye(3)) if len(points) > 3 else (0, 0)
        if len(points) < 4 or not 9.9 < values[1] / values[0] < 10.1:
            flat = len(points) >= 4 and values[1] >= 10.0 * values[0]
            assert normal[u].any() == flat
            if flat:
                assert abs(normal[u] @ vectors[:, 0]) == pytest.approx(1.0, abs=1e-3)
                planar += 1
    assert planar > 200


def test_support_is_the_sum_over_the_cells_around(cloud):
    index, rng = index_of(cloud, 10.0), np.random.default_rng(3)
    n = len(index.cells)
    hits, passes = rng.integers(0, 3, n).astype(np.int32), (rng.random(n) < 0.02).astype(np.int32)
    hit_sums, pass_sums = support_sums(index.base, index.state, index.cells, hits, passes, 2, 2)
    for u in rng.choice(n, 200, replace=False):
        near = (np.abs(index.cells - index.cells[u]) <= 2).all(axis=1)
        assert pass_sums[u] == passes[near].sum()
        assert hit_sums[u] == (hits[near].sum() if pass_sums[u] >= 2 else 0)


def test_box_sums_are_the_sums_of_listed_cells():
    rng = np.random.default_rng(4)
    at = np.unique(rng.integers(-4, 5, (200, 3)), axis=0).astype(np.int64)
    values = rng.integers(1, 9, len(at)).astype(np.int32)
    expected = [values[(np.abs(at - a) <= 1).all(axis=1)].sum() for a in at]
    np.testing.assert_array_equal(box_sums(at, values, 1), expected)


def test_bad_scans_are_refused_and_empty_ones_are_nothing(cloud):
    detector = PcdDetector(cloud)
    detector.add_scan(np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(ShapeError, match="not finite"):
        detector.add_scan(np.array([[np.nan, 0.0, 0.0]]), np.zeros(3))
    with pytest.raises(ShapeError, match="2 points, 3 origins"):
        detector.add_scan(np.ones((2, 3)), np.zeros((3, 3)))
    report = detector.finish()
    assert (len(report.new_points), len(report.deleted_index), len(report.observed)) == (0, 0, 0)


def test_a_map_without_points_is_refused(cloud):
    with pytest.raises(PcdError, match="without points"):
        PcdDetector(PcdMap(np.empty((0, 3), np.float32), cloud.frame))
    with pytest.raises(PcdError, match="float32"):
        PcdMap(np.zeros((2, 3)), cloud.frame)  # type: ignore[arg-type]
