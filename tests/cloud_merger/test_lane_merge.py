"""Pieces of lanes in the cloud's merge: one drive is not enough, drives agree, shift and change their minds."""

import sys
from pathlib import Path

import numpy as np
import pytest

from gnd.cloud_merger.features.association import costs
from gnd.cloud_merger.features.lanes_shift import LateralShift
from gnd.cloud_merger.features.merge import merge_features
from gnd.cloud_merger.features.parameters import FeatureMergeParameters
from gnd.cloud_merger.features.rls import PlaceEstimate, estimate
from gnd.cloud_merger.features.spread import spread
from gnd.cloud_merger.features.window import LayerMerger, LayerState, LayerWindow
from gnd.vehicle_agent.features.lanes.lane_mapper import MARKINGS

sys.path.append(str(Path(__file__).parents[1] / "vehicle_agent"))
from lane_road import BORDERS, across, drive, merged, report_of, tiles_of

PIECE = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
AHEAD = np.array([5.0, 0.0, 0.0])


def _place(left, sigma=0.05, points=PIECE):
    return PlaceEstimate(points + np.array([0.0, left, 0.0]), np.diag([1.0, sigma**2, 0.02]))


def test_one_drive_publishes_nothing():
    assert not any(merged([drive()]).values())


def test_two_drives_publish_the_borders_once():
    layer = merged([drive(seed=0), drive(seed=1)])
    places = [across(tile, one) for tile, some in layer.items() for one in some]
    for y, _ in BORDERS:
        assert 25 <= sum(abs(place - y) < 0.1 for place in places) <= 36
    assert all(min(abs(place - y) for y, _ in BORDERS) < 0.1 for place in places)


def test_a_border_that_three_drives_deny_goes_and_others_stay():
    before = tiles_of()
    layer = merged([drive(BORDERS[:2], held=before, seed=k) for k in range(3)], before)
    inner = [across(t, one) for t, some in layer.items() for one in some if _is_inner(t, one)]
    assert sum(abs(place + 3.5) < 0.15 for place in inner) >= 12
    assert sum(abs(place - 3.5) < 0.15 for place in inner) == 0


def _is_inner(tile, one):
    from lane_road import FRAME, pose

    from gnd.gnd_map.geodesy import LocalFrame

    T = FRAME.T_self_other(LocalFrame.of_tile(tile))
    middle = T[:3, :3] @ one.points_m.mean(axis=0) + T[:3, 3]
    return abs(float((np.linalg.inv(pose(0.0, 0.0)[:3, :3]) @ middle)[0])) < 40.0


def test_pieces_that_follow_each_other_are_not_taken_for_one():
    cost = costs([_place(0.01)], [_place(0.0, points=PIECE + AHEAD), _place(0.0)], FeatureMergeParameters())
    assert np.isinf(cost[0, 0])
    assert np.isfinite(cost[0, 1])


def test_a_border_half_a_metre_off_is_another():
    assert np.isinf(costs([_place(0.5)], [_place(0.0)], FeatureMergeParameters())).all()


def test_both_vertices_learn_though_a_drive_cut_the_line_askew():
    askew = PlaceEstimate(PIECE + np.array([[0.05, 0.1, 0.0], [-0.05, 0.1, 0.0]]), _place(0.0).cov_m2)
    both = estimate([_place(0.0), askew])
    assert both.points_m[:, 1] == pytest.approx([0.05, 0.05])


@pytest.mark.parametrize("shift", [0.0, 0.1])
def test_nees_of_merged_pieces_is_near_one(shift):
    """Ten drives that claim 5 cm and are off by `shift` more in common with themselves; one degree of freedom."""
    rng = np.random.default_rng(5)
    errors = []
    for _ in range(600):
        drives = [_place(rng.normal(0.0, 0.05) + rng.normal(0.0, shift)) for _ in range(10)]
        scatter = LateralShift()
        for one in drives:
            scatter.add(one)
        both = estimate(drives)
        variance = both.cov_m2[1, 1] + scatter.added_m2()[1, 1]
        errors.append(both.points_m[0, 1] ** 2 / variance)
    assert 0.8 < np.mean(errors) < 1.5


def test_drives_that_agree_have_no_shift_and_two_that_do_not_have_some():
    shift = LateralShift()
    for left in (0.0, 0.01, -0.01, 0.02):
        shift.add(_place(left))
    assert shift.variance_m2 == 0.0
    for left in (0.5, -0.5):
        shift.add(_place(left))
    assert shift.variance_m2 > 0.01
    assert shift.added_m2()[0, 0] == pytest.approx(0.0)


def test_the_shift_of_a_place_beside_no_piece_is_left_out():
    shift = LateralShift()
    shift.add(_place(0.0))
    shift.add(_place(3.0, points=PIECE + 100.0 * AHEAD))
    assert shift.variance_m2 == 0.0


def test_a_closed_window_is_remembered():
    """Two drives before the window closes and two after it come to what four at once come to."""
    reports = [one for k in range(4) for one in report_of(drive(seed=k).leave_all(), k)]
    parameters = FeatureMergeParameters().of_layer(MARKINGS)
    parts: dict = {}
    for report in reports:
        for tile, part in spread(report, parameters.reach_m).items():
            parts.setdefault(tile, []).append(part)
    tile = max(parts, key=lambda one: sum(len(change.found) for part in parts[one] for change in part.tiles))
    merger = LayerMerger(tile, parameters, {}, {})
    first, second = LayerWindow(tuple(parts[tile][:2]), 100), LayerWindow(tuple(parts[tile][2:]), 101)
    state = merger.fold(LayerState(()), merger.merge(LayerState(()), first), first)
    state = LayerState.stored((), state.encoded(1))
    later = {one.feature_id: one for one in merger.merge(state, second).features}
    once = {one.feature_id: one for one in merge_features(tile, (), parts[tile], parameters).features}
    assert len(once) >= 5
    assert later.keys() == once.keys()
    for name, one in later.items():
        assert one.points_m == pytest.approx(once[name].points_m, abs=5e-3)
        assert one.vehicles == 4
