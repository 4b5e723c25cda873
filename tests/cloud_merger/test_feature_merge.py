"""What the merge of a feature layer decides: new, confirmed, deleted, moved, told apart, joined."""

import dataclasses

import numpy as np
import pytest
from feature_cloud import (
    ABSENT,
    EAST,
    EXIST,
    TILE,
    change,
    feature,
    found,
    line,
    merge,
    places,
    published,
    report,
    report_id,
    seen,
)

from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.features import FeatureMergeParameters, merge_features, merge_layer, spread
from gnd.gnd_map.features import Existence, geodetic_in_tile, points_in_tile
from gnd.schemas.features import EVERY_CELL

SIGN, OTHER = feature(7, -5.0, 3.0), feature(9, 6.0, -2.0)
MAP = published([SIGN, OTHER])
LAMP = feature(11, 2.0, 2.0, kind="streetlight", attributes=())


def test_without_reports_the_map_stays_as_it_is():
    assert merge(MAP, []).features == MAP


def test_what_two_vehicles_found_is_published_between_them():
    merged = merge(MAP, [report(1, change(found(1.0, 1.0))), report(2, change(found(1.4, 0.8)))])
    (new,) = set(merged.features) - set(MAP)
    np.testing.assert_allclose(new.points_m[0, :2], [1.2, 0.9], atol=1e-3)
    assert (new.kind, new.vehicles, new.hits, new.existence.state) == ("traffic_sign", 2, 8, "exist")
    assert merged.provenance == {new.feature_id: (report_id(1), report_id(2))}
    assert set(MAP) <= set(merged.features)


def test_what_one_vehicle_found_waits_as_a_candidate():
    merged = merge(MAP, [report(1, change(found(1.0, 1.0)))])
    assert merged.features == MAP
    assert merged.provenance == {}
    (candidate,) = [one for one in merged.estimates if one.feature_id not in (7, 9)]
    np.testing.assert_allclose(candidate.points_m[0, :2], [1.0, 1.0])


def test_a_map_feature_that_two_vehicles_do_not_see_any_more_goes():
    reports = [report(n, change(seen(7, ABSENT), seen(9), base=MAP)) for n in (1, 2)]
    merged = merge(MAP, reports)
    assert [one.feature_id for one in merged.features] == [9]
    assert merged.provenance == {7: (report_id(1), report_id(2))}
    assert merge(MAP, reports[:1]).features == MAP


def test_a_feature_that_most_still_see_stays_and_says_how_much_they_disagree():
    says = [ABSENT, EXIST, EXIST, EXIST, ABSENT]
    reports = [report(n, change(seen(7, says_it), base=MAP)) for n, says_it in enumerate(says)]
    merged = merge(MAP, reports)
    assert 7 in [one.feature_id for one in merged.features]
    (now,) = [one for one in merged.estimates if one.feature_id == 7]
    assert now.existence.state == "exist"
    assert now.existence.conflict > 0.9


def test_the_newest_word_of_a_vehicle_is_its_vote():
    reports = [report(n, change(seen(7, ABSENT), base=MAP), vehicle=f"car-{n % 2}") for n in range(4)]
    assert [one.feature_id for one in merge(MAP, reports).features] == [9]
    again = [report(10 + n, change(seen(7), base=MAP), vehicle=f"car-{n}") for n in range(2)]
    assert merge(MAP, reports + again).features == MAP


def test_others_who_looked_and_found_nothing_speak_against_a_candidate():
    finders = [report(n, change(found(1.0, 1.0))) for n in (1, 2)]
    lookers = [report(n, change(base=MAP, viewed=EVERY_CELL)) for n in (3, 4, 5, 6)]
    assert len(merge(MAP, finders).features) == 3
    assert len(merge(MAP, finders + lookers[:1]).features) == 3
    assert merge(MAP, finders + lookers).features == MAP
    elsewhere = [report(n, change(base=MAP, viewed=1)) for n in (3, 4, 5, 6)]  # the south-west corner
    assert len(merge(MAP, finders + elsewhere).features) == 3


def test_who_passed_before_a_thing_was_there_does_not_deny_it():
    lookers = [report(n, change(base=MAP, viewed=EVERY_CELL)) for n in range(5)]
    finders = [report(n, change(found(1.0, 1.0))) for n in (10, 11)]
    assert len(merge(MAP, lookers + finders).features) == 3


def test_who_had_the_feature_in_its_map_and_did_not_judge_it_abstains():
    finders = [report(n, change(found(1.0, 1.0))) for n in (1, 2)]
    later = merge(MAP, finders).features
    lookers = [report(n, change(base=later, viewed=EVERY_CELL)) for n in (3, 4, 5)]
    bases = {lookers[0].tiles[0].base_sha: later}
    assert merge_features(TILE, MAP, finders + lookers, bases=bases).features == later
    assert merge_features(TILE, MAP, finders + lookers).features == later  # an unknown base: abstains


def test_a_published_feature_is_judged_by_the_id_that_it_was_given():
    finders = [report(n, change(found(1.0, 1.0))) for n in (1, 2)]
    first = merge(MAP, finders).features
    (new,) = set(first) - set(MAP)
    deniers = [report(n, change(seen(new.feature_id, ABSENT), base=first)) for n in (3, 4, 5)]
    assert merge(MAP, finders + deniers).features == MAP
    measuring = [report(n, change(seen(new.feature_id, EXIST, (1.3, 1.0)), base=first)) for n in (3, 4)]
    (moved,) = set(merge(MAP, finders + measuring).features) - set(MAP)
    assert moved.feature_id == new.feature_id
    assert moved.vehicles == 4
    np.testing.assert_allclose(moved.points_m[0, :2], [1.15, 1.0], atol=2e-3)


def test_a_feature_whose_finders_are_forgotten_lives_by_those_who_confirm_it():
    finders = [report(n, change(found(1.0, 1.0))) for n in (1, 2)]
    later = merge(MAP, finders).features
    (new,) = set(later) - set(MAP)
    confirming = [report(n, change(seen(new.feature_id), base=later)) for n in (3, 4)]
    bases = {confirming[0].tiles[0].base_sha: later}
    (kept,) = set(merge_features(TILE, MAP, confirming, bases=bases).features) - set(MAP)
    assert (kept.feature_id, kept.points_m.tolist()) == (new.feature_id, new.points_m.tolist())
    stale = [*confirming, report(5, change(found(1.1, 1.0)))]  # one that has an old map finds it anew
    assert len(merge_features(TILE, MAP, stale, bases=bases).features) == 3


def test_a_map_feature_that_stands_elsewhere_now_is_deleted_and_inserted():
    reports = [report(n, change(seen(7, EXIST, (-1.0, 3.0)), base=MAP)) for n in (1, 2)]
    assert merge(MAP, reports[:1]).features == MAP
    merged = merge(MAP, reports)
    (new,) = set(merged.features) - set(MAP)
    assert 7 not in [one.feature_id for one in merged.features]
    assert (new.kind, new.attributes) == (SIGN.kind, SIGN.attributes)
    np.testing.assert_allclose(new.points_m[0, :2], [-1.0, 3.0], atol=1e-3)


def test_measurements_that_contradict_the_map_and_each_other_move_nothing():
    at = [(-1.0, 3.0), (-5.0, 8.0), (-9.0, -3.0)]
    reports = [report(n, change(seen(7, EXIST, place), base=MAP)) for n, place in enumerate(at)]
    assert merge(MAP, reports).features == MAP


def test_an_outlier_does_not_corrupt_a_feature():
    reports = [report(n, change(found(1.0 + 0.01 * n, 1.0, sigma_m=0.1))) for n in range(6)]
    wild = report(6, change(found(2.5, 1.0, sigma_m=0.1)))
    (new,) = merge((), [*reports, wild]).features
    assert abs(new.points_m[0, 0] - 1.02) < 0.02
    merged = merge((), [wild, *reports])
    assert len(merged.features) == 1
    assert len(merged.estimates) == 2


def test_one_vehicle_that_claims_millimetres_does_not_decide_where_a_feature_is():
    reports = [report(n, change(found(1.0 + 0.02 * n, 1.0))) for n in range(4)]
    sure = report(9, change(found(1.4, 1.0, sigma_m=1e-3)))
    (before,) = merge((), reports).features
    (after,) = merge((), [*reports, sure], FeatureMergeParameters(renewal_gain=1.0)).features
    assert abs(after.points_m[0, 0] - (4 * 1.03 + 4 * 1.4) / 8) < 2e-3
    assert after.cov_m2[0] > 0.3**2 / 10
    second = report(10, change(found(1.4, 1.0, sigma_m=1e-3)))
    (agreed,) = merge((), [*reports, sure, second], FeatureMergeParameters(renewal_gain=1.0)).features
    assert abs(agreed.points_m[0, 0] - 1.4) < 2e-3
    assert before.points_m[0, 0] < 1.1


def test_an_outlier_that_came_first_is_outlived():
    wild = report(0, change(found(2.5, 1.0, sigma_m=0.1)))
    reports = [report(n, change(found(1.0, 1.0, sigma_m=0.1))) for n in (1, 2, 3)]
    (new,) = merge((), [wild, *reports]).features
    np.testing.assert_allclose(new.points_m[0, :2], [1.0, 1.0], atol=1e-3)


def test_two_signs_side_by_side_that_each_report_tells_apart_stay_two():
    reports = [report(n, change(found(1.0 + 0.02 * n, 1.0), found(1.9 - 0.02 * n, 1.0))) for n in range(5)]
    got = places(merge((), reports).features)
    np.testing.assert_allclose(np.sort(got[:, 0]), [1.04, 1.86], atol=0.01)


def test_two_signs_on_one_pole_are_told_apart_by_their_heights():
    pair = [found(1.0, 1.0, height_m=h, height_m2=0.01) for h in (2.0, 3.0)]
    got = merge((), [report(n, change(*pair)) for n in range(3)]).features
    assert sorted(one.points_m[0, 2] for one in got) == [2.0, 3.0]


def test_association_is_one_to_one_and_prefers_the_nearer():
    known = [report(n, change(found(0.0, 0.0, sigma_m=0.5), found(3.0, 0.0, sigma_m=0.5))) for n in range(3)]
    shifted = report(9, change(found(0.8, 0.0, sigma_m=0.5), found(3.8, 0.0, sigma_m=0.5)))
    merged = merge((), [*known, shifted], FeatureMergeParameters(renewal_gain=1.0))
    np.testing.assert_allclose(np.sort(places(merged.features)[:, 0]), [0.2, 3.2], atol=0.01)


def test_what_began_with_an_outlier_does_not_draw_to_itself_what_belongs_to_its_neighbour():
    """Known well along one axis only, as by lanes: the outlier is off along the other, and vague along the first."""
    known = [report(n, change(stretched(x, 0.0))) for n, x in enumerate((-3.0, -2.0, 1.0, 4.0))]
    outlier = report(5, change(stretched(-5.0, -2.6)))
    between = [report(n, change(stretched(6.0, -1.4))) for n in (6, 7)]
    merged = merge((), [*known, outlier, *between])
    assert sorted(one.vehicles for one in merged.estimates) == [1, 6]


def stretched(east_m, north_m):
    return dataclasses.replace(found(east_m, north_m), cov_m2=np.array([25.0, 0.0, 0.0, 0.25, 0.0, 1e4]))


def test_candidates_that_turn_out_to_be_one_are_joined():
    """Two drives know the place so little that neither gate holds the other; a third, sure one, lies between."""
    apart = [report(1, change(found(0.0, 0.0, sigma_m=0.5))), report(2, change(found(2.7, 0.0, sigma_m=0.5)))]
    assert len(merge((), apart).estimates) == 2
    between = [report(n, change(found(1.35, 0.0, sigma_m=0.5))) for n in (3, 4, 5, 6)]
    merged = merge((), [*apart, *between])
    (new,), (now,) = merged.features, merged.estimates
    assert now.vehicles == 6
    assert len(merged.provenance[new.feature_id]) == 6


def test_a_height_that_nobody_measured_stays_unknown_however_often_that_is_said():
    reports = [report(n, change(found(1.0, 1.0)), vehicle=f"car-{n % 30}") for n in range(60)]
    (new,) = merge((), reports).features
    assert 0.9e4 < new.cov_m2[5] < 1.1e4
    tall = report(99, change(found(1.0, 1.0, height_m=5.0, height_m2=0.04)))
    (now,) = merge((), [*reports, tall]).features
    assert abs(now.points_m[0, 2] - 5.0) < 1e-3
    assert now.cov_m2[5] < 0.05


def test_kinds_are_never_mixed():
    reports = [report(n, change(found(2.0, 2.0, kind="pole"), found(2.05, 2.0, kind="streetlight"))) for n in (1, 2)]
    assert sorted(one.kind for one in merge((), reports).features) == ["pole", "streetlight"]


def test_attributes_are_those_that_enough_vehicles_say():
    said = [(("code", "274"),), (("code", "274"), ("text", "x")), (("code", "275"),)]
    reports = [report(n, change(found(1.0, 1.0, attributes=one))) for n, one in enumerate(said)]
    (new,) = merge((), reports).features
    assert new.attributes == (("code", "274"),)


def test_published_places_are_renewed_seldom_while_the_estimate_goes_on():
    reports = [report(n, change(found(1.0 + 0.003 * n, 1.0))) for n in range(40)]
    versions = {merge((), reports[: n + 1]).features for n in range(1, 40)}
    assert len(versions) <= 14
    last = merge((), reports)
    (shown,), (now,) = last.features, last.estimates
    assert now.vehicles == 40
    assert shown.vehicles < 40
    assert shown.cov_m2[0] <= 1.3 * now.cov_m2[0] * 1.06
    doubling = {merge((), reports[: n + 1], FeatureMergeParameters(renewal_gain=2.0)).features for n in range(1, 40)}
    assert len(doubling) <= 7


def test_places_are_renewed_at_numbers_of_vehicles_a_quarter_apart():
    reports = [report(n, change(found(1.0, 1.0))) for n in range(20)]
    shown = [merge((), reports[:n]).features[0].vehicles for n in range(2, 21)]
    assert sorted(set(shown)) == [2, 3, 4, 5, 7, 9, 12, 15, 19]


def test_a_place_that_moves_by_more_than_its_sigma_is_renewed_at_once():
    parameters = FeatureMergeParameters(renewal_gain=16.0)
    reports = [report(n, change(found(1.0, 1.0))) for n in range(2)]
    reports += [report(n, change(found(1.6, 1.0))) for n in range(2, 8)]
    shown = [merge((), reports[:n], parameters).features[0].points_m[0, 0] for n in range(2, 9)]
    assert len(set(shown)) == 2
    assert 1.2 < shown[-1] < 1.6


def test_map_features_that_are_measured_where_they_are_stay_to_the_byte():
    reports = [report(n, change(seen(7, EXIST, (-5.0, 3.0), 1.0), seen(9), base=MAP)) for n in range(4)]
    assert merge(MAP, reports).features == MAP


def test_a_vague_map_feature_is_measured_better():
    vague = published([feature(7, -5.0, 3.0, sigma_m=1.0)])
    reports = [report(n, change(seen(7, EXIST, (-4.6, 3.0), 0.2), base=vague)) for n in (1, 2)]
    assert merge(vague, reports[:1]).features == vague
    (now,) = merge(vague, reports).features
    assert now.feature_id == 7
    assert abs(now.points_m[0, 0] + 4.6) < 0.02


def test_a_lamp_beyond_the_border_is_published_once_by_the_tile_in_which_it_was_first_confirmed():
    (south, _), (north, east) = TILE.south_west_rad, TILE.north_east_rad
    border_m = points_in_tile(TILE, (south + north) / 2, east, 0.0)[0, 0]
    rng = np.random.default_rng(13)
    parts, all_reports = {TILE: [], EAST: []}, []
    for n in range(12):
        at = np.array([[border_m + rng.normal(0.4, 2.0), rng.normal(0, 0.3), 0.0]])
        tile = TILE if at[0, 0] < border_m else EAST
        local = points_in_tile(tile, *geodetic_in_tile(TILE, at))[0]
        whole = report(n, change(found(local[0], local[1], sigma_m=2.0, kind="streetlight"), tile=tile))
        all_reports.append(whole)
        for where, part in spread(whole, 15.0).items():
            if where in parts:
                parts[where].append(part)
    merged = {tile: merge_features(tile, (), own) for tile, own in parts.items()}
    everywhere = merge_layer({}, all_reports)
    assert sum(len(one.features) for one in merged.values()) == 1
    assert sum(len(one.features) for one in everywhere.values()) == 1
    assert {tile: one.features for tile, one in merged.items()} == {
        tile: everywhere[tile].features for tile in (TILE, EAST)
    }
    (lamp,) = [one for each in merged.values() for one in each.features]
    assert lamp.vehicles >= 10


def test_lanes_are_merged_across_and_not_along():
    lanes = [line((-10.0, 0.1 * n), (0.0, 0.1 * n), (10.0, 0.1 * n)) for n in (0, 1, 2, 3)]
    shorter = line((-6.0, 0.15), (6.0, 0.15))
    reports = [report(n, change(one)) for n, one in enumerate([*lanes, shorter])]
    (lane,) = merge((), reports, FeatureMergeParameters(renewal_gain=1.0)).features
    np.testing.assert_allclose(lane.points_m[:, 0], [-10.0, 0.0, 10.0], atol=1e-3)
    assert abs(lane.points_m[1, 1] - 0.15) < 0.02
    assert lane.vehicles == 5


def test_lanes_side_by_side_and_crossing_lanes_stay_apart():
    three = [line((-10.0, y), (10.0, y)) for y in (-3.5, 0.0, 3.5)]
    across = line((0.0, -10.0), (0.1, 10.0))
    got = merge((), [report(n, change(*three, across)) for n in range(3)]).features
    assert len(got) == 4


def test_a_lane_that_two_vehicles_do_not_see_goes():
    lane = line((-10.0, 0.0), (10.0, 0.0)).as_feature(5)
    base = published([lane])
    reports = [report(n, change(seen(5, ABSENT), base=base)) for n in (1, 2, 3)]
    assert merge(base, reports).features == ()


def test_parts_of_one_report_may_come_apart():
    east = change(found(-14.0, 0.0), tile=EAST)
    whole = [report(n, change(found(1.0, 1.0)), east) for n in (1, 2)]
    apart = [report(n, one) for n in (1, 2) for one in (change(found(1.0, 1.0)), east)]
    assert merge((), whole).features == merge((), apart).features == merge((), [*apart, *apart]).features


def test_masses_never_become_so_sure_that_nothing_could_change_them():
    sure = published([feature(7, 0.0, 0.0, existence=Existence(1.0, 0.0, 0.0))])
    certain = Existence(0.0, 1.0, 0.0)
    reports = [report(n, change(seen(7, certain), base=sure)) for n in (1, 2)]
    assert merge(sure, reports).features == ()
    reports = [report(n, change(found(1.0, 1.0, existence=Existence(1.0, 0.0, 0.0)))) for n in range(8)]
    (new,) = merge((), reports).features
    assert new.existence.exist <= 0.99


@pytest.mark.parametrize(
    "wrong",
    [
        {"reach_m": 0.0},
        {"min_vehicles": 1},
        {"min_vehicles": 7},
        {"reliability": 1.0},
        {"repeat_correlation": 1.1},
        {"renewal_gain": 0.5},
    ],
)
def test_parameters_without_meaning_are_refused(wrong):
    with pytest.raises(MergerError, match=next(iter(wrong))):
        FeatureMergeParameters(**wrong)
