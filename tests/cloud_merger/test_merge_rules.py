"""What the merge decides, one rule a test."""

from dataclasses import replace

import numpy as np
import pytest
from merger_world import (
    BALL,
    GROUND,
    GROUND_AGAIN,
    POLE,
    WALL,
    WALL_AGAIN,
    change_of,
    gaussians_of,
    report_id,
    sha_of,
)

from gnd.cloud_merger import decide_kernels, merge
from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.merge import MergeParameters, merge_tile
from gnd.cloud_merger.statements import Report, statements_of
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians, Moments

EPOCH = gaussians_of({0: GROUND, 1: WALL})


def merged(changes, *, epoch=EPOCH, bases=(), mode="default", **parameters):
    known = {sha_of(base): base for base in (epoch, *bases)}
    reports = [Report(report_id(number), change) for number, change in enumerate(changes)]
    statements = statements_of(epoch, reports, known, mode)
    return merge_tile(epoch, statements, MergeParameters(mode=mode, **parameters))


def test_without_reports_the_tile_stays():
    result = merged([])
    assert result.gaussians == EPOCH
    assert len(result.changed) == 0


def test_one_drive_publishes_a_new_voxel():
    result = merged([change_of(EPOCH, [0, 1, 2], {2: POLE})])
    assert result.gaussians == gaussians_of({0: GROUND, 1: WALL, 2: POLE})
    assert result.changed.tolist() == [2]
    assert result.provenance == {2: (report_id(0),)}


def test_one_drive_deletes_a_voxel():
    result = merged([change_of(EPOCH, [0, 1], {1: None}, change_class=ChangeClass.DELETED)])
    assert result.gaussians == gaussians_of({0: GROUND})
    assert result.changed.tolist() == [1]


def test_a_deletion_of_what_was_never_there_changes_nothing():
    assert merged([change_of(EPOCH, [0, 5], {5: None})]).gaussians == EPOCH


def test_what_resembles_the_map_is_not_published():
    result = merged([change_of(EPOCH, [0], {0: GROUND_AGAIN})])
    assert result.gaussians == EPOCH
    assert len(result.changed) == 0


def test_observers_who_saw_no_change_outvote_one_parked_car():
    sees_car = change_of(EPOCH, [0, 1, 2], {2: BALL})
    sees_none = change_of(EPOCH, [0, 1, 2], {})
    assert merged([sees_car, sees_none, sees_none]).gaussians == EPOCH
    assert merged([sees_car, sees_none, sees_none], mode="paper").changed.tolist() == [2]  # counts uploads only
    assert merged([sees_car, sees_none, sees_none], mode="paper-observers").gaussians == EPOCH


def test_the_readings_of_xi_differ_in_the_denominator_alone():
    """ξ = 0.6 of what: of the uploads about the voxel, or of the vehicles that observed it."""
    change, none = change_of(EPOCH, [0, 1, 2], {2: BALL}), change_of(EPOCH, [0, 1, 2], {})
    elsewhere = change_of(EPOCH, [0], {})
    for silent, observers_publish in ((1, True), (2, False)):  # 3 of 4 are more than 0.6; 3 of 5 are not
        reports = [change] * 3 + [none] * silent + [elsewhere] * 3
        assert merged(reports, mode="paper").changed.tolist() == [2]
        read = merged(reports, mode="paper-observers")
        assert read.changed.tolist() == ([2] if observers_publish else [])
    for mode in ("paper", "paper-observers"):  # all who observed it uploaded it: nothing is left to differ
        alike = merged([change] * 3 + [elsewhere] * 2, mode=mode).gaussians
        assert alike == merged([change] * 3, mode="paper").gaussians


def test_silent_observers_neither_join_a_cluster_nor_move_its_representative():
    """Four uploads that say "gone" and one silent vehicle: the Gaussian is removed; what the fifth saw is no upload."""
    gone = change_of(EPOCH, [0, 1], {1: None}, change_class=ChangeClass.DELETED)
    silent = change_of(EPOCH, [0, 1], {})
    assert merged([gone] * 4 + [silent], mode="paper-observers").changed.tolist() == [1]
    assert merged([gone] * 3 + [silent] * 2, mode="paper-observers").gaussians == EPOCH
    again = change_of(EPOCH, [0, 1], {1: BALL})
    whole, part = (merged([again] * 4 + [silent] * n, mode="paper-observers").gaussians for n in (0, 2))
    assert part == whole != EPOCH


def test_who_did_not_observe_the_voxel_has_no_vote():
    sees_car = change_of(EPOCH, [0, 1, 2], {2: BALL})
    elsewhere = change_of(EPOCH, [0, 1], {})
    assert merged([sees_car, elsewhere, elsewhere]).changed.tolist() == [2]


def put(patch: pytest.MonkeyPatch, name: str, value: float) -> None:
    """Another value of a rule, for the kernel and for its twin."""
    for module in (merge, decide_kernels):
        patch.setattr(module, name, value)


def test_the_share_must_exceed_xi_not_only_reach_it():
    yes, no = change_of(EPOCH, [2], {2: BALL}), change_of(EPOCH, [2], {})
    assert merged([yes, yes, yes, no, no], xi=0.6).changed.tolist() == []
    assert merged([yes, yes, yes, no, no], xi=0.59).changed.tolist() == [2]


def test_the_biggest_cluster_wins_and_is_represented_by_its_moments(monkeypatch):
    put(monkeypatch, "MERGE_D_RENEWED", 1.0)
    one = gaussians_of({1: POLE}, count=100, cells=40)
    two = gaussians_of({1: (*POLE[:2], 0.05, *POLE[3:])}, count=300, cells=55)
    result = merged([change_of(EPOCH, [1], g) for g in (one, gaussians_of({1: BALL}), two)], xi=0.5)
    expected = (Moments.of(one) + Moments.of(two)).to_gaussians([1])
    got = result.gaussians.select([1])
    assert (got.count.tolist(), got.cells.tolist()) == ([400], [55])
    np.testing.assert_allclose(got.mean_m, expected.mean_m, atol=1e-7)
    np.testing.assert_allclose(got.cov_m2, expected.cov_m2, atol=1e-8)
    assert result.provenance == {1: (report_id(0), report_id(2))}


def test_a_representative_is_looked_at_anew_when_its_measurements_have_doubled(monkeypatch):
    poles = [change_of(EPOCH, [2], {2: (-0.3, 0.2, 0.01 * k, *POLE[3:])}) for k in range(9)]
    with monkeypatch.context() as patch:
        put(patch, "MERGE_D_RENEWED", 1.0)
        counts = [merged(poles[:n]).gaussians.select([2]).count[0] // 200 for n in range(1, 10)]
    assert counts == [1, 2, 2, 4, 4, 4, 4, 8, 8]
    assert merged(poles[:4]).gaussians == merged(poles[:7]).gaussians
    assert merged(poles[:7]).provenance[2] == tuple(map(report_id, range(7)))
    assert merged(poles[:7], mode="paper").gaussians.select([2]).count[0] == 7 * 200


def test_a_representative_stays_while_those_of_more_measurements_are_like_it():
    by_a_hair = [change_of(EPOCH, [2], {2: (-0.3 + 0.002 * k, *POLE[1:])}) for k in range(8)]
    assert merged(by_a_hair).gaussians == merged(by_a_hair[:1]).gaussians
    off = [change_of(EPOCH, [2], {2: (-0.3 + (0.08 if k else 0.0), *POLE[1:])}) for k in range(8)]
    assert merged(off).gaussians.select([2]).count[0] > 200
    assert merged(off).gaussians.select([2]).mean_m[0, 0] == pytest.approx(-0.24, abs=0.021)


def test_of_equal_clusters_the_earliest_wins_when_xi_lets_any_win():
    pole, ball = change_of(EPOCH, [2], {2: POLE}), change_of(EPOCH, [2], {2: BALL})
    assert merged([pole, ball], xi=0.4).gaussians.select([2]) == gaussians_of({2: POLE})
    assert merged([ball, pole], xi=0.4).gaussians.select([2]) == gaussians_of({2: BALL})
    assert merged([pole, ball]).changed.tolist() == []


def test_a_measured_gaussian_that_is_alone_is_published_bit_for_bit():
    alone = gaussians_of({2: (0.123456, -0.2345678, 0.34567, 0.0123, 0.27, 0.19)}, count=977)
    assert merged([change_of(EPOCH, [2], alone)]).gaussians.select([2]) == alone


def test_a_report_against_an_older_version_is_rebased():
    # Version 2 lacked the wall; this vehicle says "as in version 2", which speaks against the wall of the epoch.
    old = gaussians_of({0: GROUND})
    result = merged([change_of(old, [0, 1], {}, version=2)], bases=[old])
    assert result.gaussians == old
    assert result.provenance == {1: (report_id(0),)}


def test_a_quoted_gaussian_counts_once_and_only_where_nobody_measured():
    # Both confirm version 2, in which voxel 2 held a pole: it comes back with its own count, not with twice that.
    old = gaussians_of({0: GROUND, 1: WALL, 2: POLE}, count=150)
    quotes = [change_of(old, [2], {}, version=2)] * 2
    assert merged(quotes, bases=[old]).gaussians.select([2]).count.tolist() == [150]
    measures = change_of(EPOCH, [2], gaussians_of({2: POLE}, count=90))
    assert merged([*quotes, measures], bases=[old]).gaussians.select([2]).count.tolist() == [90]


def test_reports_that_confirm_a_published_change_do_not_alter_it():
    first = change_of(EPOCH, [0, 1, 2], {2: POLE})
    version_2 = merged([first]).gaussians
    confirms = change_of(version_2, [0, 1, 2], {}, version=2)
    assert merged([first, confirms, confirms], bases=[version_2]).gaussians == version_2


def test_of_an_unknown_base_only_the_measurements_speak():
    lost = gaussians_of({7: BALL})
    result = merged([change_of(lost, [0, 1, 2], {2: POLE})])
    assert result.gaussians == gaussians_of({0: GROUND, 1: WALL, 2: POLE})


def test_a_vehicle_without_a_map_says_what_it_saw_and_that_the_rest_is_empty():
    result = merged([change_of(None, [0, 1, 2], {0: GROUND_AGAIN, 2: POLE}, change_class=ChangeClass.NEW)])
    assert result.gaussians == gaussians_of({0: GROUND, 2: POLE})
    assert result.changed.tolist() == [1, 2]


def test_a_tile_without_a_map_gets_its_first_gaussians():
    empty = Gaussians.empty()
    change = change_of(None, [0, 1], {0: GROUND}, change_class=ChangeClass.NEW)
    assert merged([change], epoch=empty).gaussians == gaussians_of({0: GROUND})


def test_unmeasured_and_weak_entries_abstain():
    pole = change_of(EPOCH, [2], {2: POLE})
    unmeasured = change_of(EPOCH, [2], {2: None}, change_class=ChangeClass.UNMEASURED)
    weak = change_of(EPOCH, [2], gaussians_of({2: BALL}, cells=19))
    assert merged([pole, unmeasured, unmeasured, weak, weak]).changed.tolist() == [2]
    assert merged([weak]).gaussians == EPOCH
    enough = change_of(EPOCH, [2], gaussians_of({2: BALL}, cells=20))
    assert merged([enough]).changed.tolist() == [2]


def test_a_withheld_gaussian_votes_with_the_measured_ones():
    measured, none = change_of(EPOCH, [2], {2: POLE}), change_of(EPOCH, [2], {})
    withheld = change_of(EPOCH, [2], {2: None}, change_class=ChangeClass.NEW, withheld=[2])
    assert merged([measured, none]).gaussians == EPOCH  # 1 of 2
    result = merged([measured, none, withheld])  # 2 of 3
    assert result.gaussians == merged([measured]).gaussians
    assert result.provenance == {2: (report_id(0), report_id(2))}


def test_flags_alone_change_nothing_but_count_as_observers():
    withheld = change_of(EPOCH, [2], {2: None}, change_class=ChangeClass.NEW, withheld=[2])
    assert merged([withheld] * 5).gaussians == EPOCH
    gone = change_of(EPOCH, [1], {1: None})
    reshaped = change_of(EPOCH, [1], {1: None}, withheld=[1])
    assert merged([gone, gone, reshaped]).changed.tolist() == [1]
    assert merged([gone, gone, reshaped, reshaped]).gaussians == EPOCH  # 2 of 4


def test_a_withheld_gaussian_votes_with_the_larger_of_two_and_never_with_the_epoch():
    pole, ball = change_of(EPOCH, [2], {2: POLE}), change_of(EPOCH, [2], {2: BALL})
    withheld = change_of(EPOCH, [2], {2: None}, change_class=ChangeClass.NEW, withheld=[2])
    result = merged([pole, ball, ball, withheld, withheld])
    assert result.provenance == {2: tuple(report_id(k) for k in (1, 2, 3, 4))}
    quotes, reshaped = change_of(EPOCH, [1], {}), change_of(EPOCH, [1], {1: None}, withheld=[1])
    assert merged([quotes, quotes, reshaped]).gaussians == EPOCH


def test_withheld_denials_lower_the_bar_for_another_shape():
    moved = change_of(EPOCH, [1], {1: POLE})
    reshaped, quotes = change_of(EPOCH, [1], {1: None}, withheld=[1]), change_of(EPOCH, [1], {})
    changes = [moved, reshaped, reshaped, reshaped, reshaped, quotes, quotes, quotes, quotes]
    assert merged(changes).changed.tolist() == [1]  # 5 of 9 deny: more than half
    assert merged([*changes, quotes]).gaussians == EPOCH


def test_a_chain_of_neighbours_cannot_carry_those_who_confirm_the_map():
    # near resembles the ground, far resembles near but not the ground: all are one cluster.
    near = {0: (0.0, 0.0, -0.14, 0.28, 0.28, 0.02)}
    far = {0: (0.0, 0.0, -0.08, 0.28, 0.28, 0.02)}
    quotes = [change_of(EPOCH, [0], {})] * 3
    changes = [change_of(EPOCH, [0], near), *[change_of(EPOCH, [0], far)] * 2]
    assert merged([*quotes, *changes]).gaussians == EPOCH
    assert merged([*quotes[:1], *changes, *changes]).changed.tolist() == [0]


def test_the_same_report_twice_counts_once():
    sees, none = change_of(EPOCH, [2], {2: POLE}), change_of(EPOCH, [2], {})
    reports = [Report(report_id(0), sees), Report(report_id(0), sees), Report(report_id(1), none)]
    statements = statements_of(EPOCH, reports, {sha_of(EPOCH): EPOCH})
    assert merge_tile(EPOCH, statements).gaussians == EPOCH  # 1 of 2, not 2 of 3


def test_paper_mode_takes_the_same_shape_only():
    wall = change_of(EPOCH, [1], {1: WALL_AGAIN})
    ball = change_of(EPOCH, [1], {1: (*WALL[:3], 0.25, 0.25, 0.25)})
    assert merged([wall], mode="paper").gaussians == EPOCH
    assert merged([ball], mode="paper").changed.tolist() == [1]  # Eq. 17: another type, similarity 0


@pytest.mark.parametrize(
    ("name", "value"),
    [("mode", "best"), ("eps", 0.0), ("eps", 1.0), ("min_samples", 0), ("xi", 1.0), ("xi", -0.1)],
)
def test_absurd_parameters_are_refused(name, value):
    with pytest.raises(MergerError, match=name):
        MergeParameters(**{name: value})


SHIFTED = (GROUND[0] + 0.02, GROUND[1], GROUND[2] + 0.06, *GROUND[3:])


def test_a_vehicle_that_denies_the_map_is_not_counted_with_those_who_quote_it():
    denies, quotes = change_of(EPOCH, [0], {0: SHIFTED}), change_of(EPOCH, [0], {})
    assert merged([denies, denies, quotes]).changed.tolist() == [0]  # though the Gaussians are alike
    assert merged([denies, quotes, quotes]).gaussians == EPOCH
    assert merged([denies, quotes]).gaussians == EPOCH  # half is no majority


def test_votes_are_weighed_by_sensor():
    assert MergeParameters().weight_of("Scala") == 0.5
    assert MergeParameters(mode="paper").weight_of("Scala") == 1.0
    sees, none = change_of(EPOCH, [2], {2: POLE}), change_of(EPOCH, [2], {})
    reports = [Report(report_id(0), sees), *(Report(report_id(n), none, 0.25) for n in (1, 2))]
    statements = statements_of(EPOCH, reports, {sha_of(EPOCH): EPOCH})
    assert merge_tile(EPOCH, statements).changed.tolist() == [2]
    with pytest.raises(MergerError, match="weight of Scala must lie in"):
        MergeParameters(sensor_weights={"Scala": 0.0})


def posed(change, sigma_m, sigma_rad=0.0):
    return replace(change, pose_sigma_m=sigma_m, pose_sigma_rad=sigma_rad)


def merged_as_reported(changes, epoch=EPOCH, **parameters):
    p = MergeParameters(**parameters)
    reports = [p.report_of(report_id(number), "VLP-16", change) for number, change in enumerate(changes)]
    return merge_tile(epoch, statements_of(epoch, reports, {sha_of(epoch): epoch}, p.mode), p)


def test_good_poses_weigh_the_same_and_add_nothing():
    change, p = change_of(EPOCH, [2], {2: POLE}), MergeParameters()
    for pose in ((0.0, 0.0), (0.02, 0.0005), (0.04, 0.0014)):
        report = p.report_of(report_id(0), "VLP-16", posed(change, *pose))
        assert (report.weight, report.pose_m2) == (1.0, 0.0)


def test_a_vote_weighs_less_the_worse_its_poses_are():
    change, p = change_of(EPOCH, [2], {2: POLE}), MergeParameters(pose_weight_m=0.1)
    worse = p.report_of(report_id(0), "VLP-16", posed(change, np.hypot(0.05, 0.1)))
    assert worse.weight == pytest.approx(0.5)
    assert worse.pose_m2 == pytest.approx(0.01)
    turned = p.report_of(report_id(0), "VLP-16", posed(change, 0.05, 0.005))  # 10 cm at 20 m
    assert turned.weight == pytest.approx(0.5)
    assert p.report_of(report_id(0), "Scala", posed(change, np.hypot(0.05, 0.1))).weight == pytest.approx(0.25)
    paper = MergeParameters(mode="paper").report_of(report_id(0), "Scala", posed(change, 0.3))
    assert (paper.weight, paper.pose_m2) == (1.0, 0.0)
    ignored = MergeParameters(poses=False).report_of(report_id(0), "VLP-16", posed(change, 0.3))
    assert (ignored.weight, ignored.pose_m2) == (1.0, 0.0)
    unweighed = MergeParameters(pose_weight_m=0.0).report_of(report_id(0), "VLP-16", posed(change, 0.3))
    assert unweighed.weight == 1.0


def test_one_vehicle_that_knew_its_place_outvotes_two_that_did_not():
    sees, none = change_of(EPOCH, [2], {2: POLE}), change_of(EPOCH, [2], {})
    assert merged_as_reported([posed(sees, 0.02), posed(none, 0.2), posed(none, 0.2)]).changed.tolist() == [2]
    assert merged_as_reported([posed(sees, 0.2), posed(none, 0.02), posed(none, 0.02)]).gaussians == EPOCH
    assert merged_as_reported([posed(change, 0.2) for change in (sees, none, none)]).gaussians == EPOCH


def test_one_wall_seen_from_uncertain_places_is_one_wall():
    """20 cm apart: two walls for vehicles that knew their place to 2 cm, one for those that knew it to 15 cm."""
    near, far = (0.0, -0.1, 0.1, *WALL[3:]), (0.0, 0.1, 0.1, *WALL[3:])
    thin = [(*state[:3], 0.28, 0.02, 0.28) for state in (near, far)]
    changes = [change_of(EPOCH, [3], {3: state}) for state in thin]
    sure, unsure = (merged_as_reported([posed(c, s) for c in changes]).changed.tolist() for s in (0.02, 0.15))
    assert (sure, unsure) == ([], [3])


def test_the_gaussian_is_taken_from_those_who_knew_their_place():
    shifted = (POLE[0] + 0.03, *POLE[1:])
    vague = [posed(change_of(EPOCH, [2], {2: shifted}), 0.12) for _ in range(2)]
    sure = posed(change_of(EPOCH, [2], {2: POLE}), 0.02)
    for changes in ([*vague, sure], [sure, *vague]):
        result = merged_as_reported(changes)
        assert result.gaussians.select([2]) == gaussians_of({2: POLE})
        assert len(result.provenance[2]) == 3  # they voted all the same
    assert merged_as_reported(vague).gaussians.select([2]).mean_m[0, 0] == np.float32(shifted[0])


@pytest.mark.parametrize("bad", [{"pose_weight_m": -1.0}, {"pose_weight_m": float("nan")}])
def test_lengths_of_poses_out_of_range_are_refused(bad):
    with pytest.raises(MergerError, match=next(iter(bad))):
        MergeParameters(**bad)


def test_a_denied_voxel_needs_the_lower_share(monkeypatch):
    denies, quotes = change_of(EPOCH, [0, 1], {1: POLE}), change_of(EPOCH, [0, 1], {})
    assert merged([denies] * 5 + [quotes] * 4).changed.tolist() == [1]
    put(monkeypatch, "MERGE_XI_RESHAPED", 0.6)
    assert merged([denies] * 5 + [quotes] * 4).gaussians == EPOCH


@pytest.mark.parametrize("bad", [{"xi": 1.0}, {"xi": -0.1}, {"eps": 1.0}])
def test_shares_and_limits_out_of_range_are_refused(bad):
    with pytest.raises(MergerError, match=next(iter(bad))):
        MergeParameters(**bad)
