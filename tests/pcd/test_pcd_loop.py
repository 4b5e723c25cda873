"""From scans to the updated cloud: what came and went is found, what stayed stays."""

import itertools

import numpy as np
import pytest
from pcd_world import COMES, GOES, PLAN, STAYS, inside

from gnd.fleet_sim.evaluate import evaluate_maps
from gnd.fleet_sim.truth import grid_of, make_truth
from gnd.gnd_map.similarity import similarity
from studies.pcd import PcdError, PcdMap, evaluate_gnd, gnd_of, merge_pcd, settled
from studies.pcd.merge import count_votes
from studies.pcd.points import cell_keys, cells_of, downsample, key_cells


@pytest.fixture(scope="module")
def truth(boxes):
    return make_truth(boxes, plan=PLAN)


def test_one_box_is_deleted_one_is_new_and_the_wall_stays(boxes, cloud, reports):
    for report in reports:
        gone = np.zeros(len(cloud), np.bool_)
        gone[report.deleted_index] = True
        goes = inside(boxes, cloud.points_m, GOES, 0.05)
        assert gone[goes].mean() > 0.5
        assert gone[inside(boxes, cloud.points_m, STAYS, 0.2)].mean() < 0.01
        assert gone[~inside(boxes, cloud.points_m, GOES, 0.5)].mean() < 0.01
        comes = inside(boxes, report.new_points, COMES, 0.1)
        assert comes.sum() > 300
        assert inside(boxes, report.new_points, STAYS, 0.3).sum() == 0


def test_the_merged_map_is_far_better_than_the_stale_one(cloud, reports, truth):
    grid, before = grid_of(truth), gnd_of(cloud, grid_of(truth))
    stale = evaluate_gnd(truth, before, before).f1()
    single, fleet = (evaluate_gnd(truth, before, gnd_of(merge_pcd(cloud, r), grid)) for r in (reports[:1], reports))
    assert stale < 70 < single.f1()
    scores = fleet.scores["scored"].classes
    assert min(scores[name].f1 for name in ("normal", "new", "empty")) > 85
    assert scores["deleted"].f1 > 60


def test_the_unchanged_cloud_gives_the_truths_gaussians(cloud, truth):
    found = gnd_of(cloud, grid_of(truth))
    assert {t: g.voxel_id.tolist() for t, g in found.items()} == {
        t: g.voxel_id.tolist() for t, g in truth.before.items() if len(g)
    }
    for tile, a in found.items():
        b = truth.before[tile]
        alike = similarity(a.exists, a.mean_m, a.cov_m2, b.exists, b.mean_m, b.cov_m2)
        assert alike.min() > 0.5
        assert np.median(alike) > 0.97
    for level in ("all", "observable", "scored"):
        base = evaluate_maps(truth, truth.before, truth.before).f1(level)
        assert evaluate_gnd(truth, found, found).f1(level) == base


def test_without_reports_and_without_changes_the_map_stays(cloud, reports):
    assert merge_pcd(cloud, []) is cloud
    r = reports[0]
    quiet = type(r)(r.new_points[:0], r.deleted_index[:0], r.observed, r.map_size)
    np.testing.assert_array_equal(merge_pcd(cloud, [quiet, quiet]).points_m, cloud.points_m)


def test_the_order_of_reports_does_not_matter(cloud, reports):
    merged = [merge_pcd(cloud, list(order)).points_m for order in itertools.permutations(reports)]
    for other in merged[1:]:
        assert other.shape == merged[0].shape
        np.testing.assert_allclose(other, merged[0], atol=1e-5)


def test_one_of_three_decides_nothing_where_two_saw_nothing(cloud, reports):
    r = reports[0]
    quiet = type(r)(r.new_points[:0], r.deleted_index[:0], r.observed, r.map_size)
    merged = merge_pcd(cloud, [r, quiet, quiet])
    np.testing.assert_array_equal(merged.points_m, cloud.points_m)


def test_a_report_on_another_map_is_refused(cloud, reports):
    with pytest.raises(PcdError, match="refers to a map"):
        merge_pcd(PcdMap(cloud.points_m[1:], cloud.frame), reports)


def test_votes_are_the_reports_with_a_point_near(cloud):
    rng, grid = np.random.default_rng(1), cloud.grid_frame
    middle = np.floor(grid.grid_of(np.zeros((1, 3)))[0]).astype(np.int64) * 10
    cells = [middle + np.unique(rng.integers(0, 12, (60, 3)), axis=0) for _ in range(70)]
    key, which = np.unique(cell_keys(np.concatenate(cells), grid), return_inverse=True)
    owner = np.repeat(np.arange(70), [len(c) for c in cells])
    said = np.zeros((len(key), 2), np.uint64)
    np.bitwise_or.at(said, (which, owner // 64), np.uint64(1) << (owner % 64).astype(np.uint64))
    votes = count_votes(key, said, 1)
    for at, n in zip(key_cells(key, grid)[::17], votes[::17], strict=True):
        assert n == sum(bool((np.abs(c - at) <= 1).all(axis=1).any()) for c in cells)


def test_downsampling_keeps_the_centroid_of_each_leaf(cloud):
    rng, grid = np.random.default_rng(0), cloud.grid_frame
    points = rng.uniform(-1.0, 1.0, (5000, 3))
    found = downsample([points[:1500], points[1500:]], grid)
    cells = [cells_of(p.astype(np.float64), grid) for p in (points, found)]
    assert len(np.unique(cells[1], axis=0)) == len(found) == len(np.unique(cells[0], axis=0))
    for row in (0, 77, len(found) - 1):
        mine = (cells[0] == cells[1][row]).all(axis=1)
        np.testing.assert_allclose(found[row], points[mine].mean(axis=0), atol=1e-6)


def test_gaussians_that_hardly_changed_are_settled(cloud, truth):
    before = gnd_of(cloud, grid_of(truth))
    rng = np.random.default_rng(0)
    fewer = PcdMap(cloud.points_m[rng.random(len(cloud)) < 0.97], cloud.frame)
    after = settled(before, gnd_of(fewer, grid_of(truth)))
    same = [np.isin(g.voxel_id, before[t].voxel_id) for t, g in after.items()]
    kept = [(g.mean_m == before[t].select(g.voxel_id).mean_m).all() for t, g in after.items()]
    assert all(s.all() for s in same)
    assert np.mean(kept) > 0.5
