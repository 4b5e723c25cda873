"""Which Gaussians are asked for: those that could still win the vote, until enough are in hand."""

import dataclasses

import numpy as np
import pytest
from merger_world import GROUND_AGAIN, NEIGHBOUR, POLE, TILE, WALL_AGAIN, report_of, sha_of
from short_world import BASE, flagged

from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.parameters import MergeParameters
from gnd.cloud_merger.statements import Report
from gnd.cloud_merger.votes import TileVotes
from gnd.cloud_merger.wants import Known, WantParameters, asked_voxels, wanted
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.schemas.changes import ChangeReport, TileChange

BASES = {sha_of(BASE): BASE}
MERGE = MergeParameters(poses=False)
SAME = flagged()  # saw all five voxels as the map has them


def withheld(change: TileChange) -> TileChange:
    return dataclasses.replace(change, changed=Gaussians.nothing_at(change.changed.voxel_id))


def known(*changes: TileChange, bases=None, promised=()) -> Known:
    reports = [Report(f"{n:026d}", change) for n, change in enumerate(changes)]
    return Known(BASE, TileVotes.of(reports), BASES | (bases or {}), np.array(promised, np.int32))


def mask(change: TileChange, held: Known, want: WantParameters | None = None, merge: MergeParameters = MERGE) -> list:
    return wanted(report_of(99, change), {change.tile: held}, merge, want or WantParameters()).mask.tolist()


NEW, MODIFIED = flagged(new={3: POLE}), flagged(modified={1: WALL_AGAIN})


def test_the_first_to_see_a_change_is_asked_for_all_of_it():
    change = flagged(new={3: POLE, 4: POLE}, modified={1: WALL_AGAIN}, deleted=(2,))
    assert mask(change, known()) == [True, True, True]
    assert mask(withheld(change), known()) == [True, True, True]


def test_what_is_deleted_has_no_gaussian_to_ask_for():
    assert mask(flagged(deleted=(1, 2)), known()) == []


@pytest.mark.parametrize(("others", "expected"), [(0, True), (1, True), (2, False), (6, False)])
def test_a_new_voxel_that_the_vote_would_leave_out_is_not_asked_for(others, expected):
    """1 of 1 + n votes against 0.8 x 0.6."""
    assert mask(NEW, known(*[SAME] * others)) == [expected]


def test_flags_of_others_are_votes_even_when_their_gaussians_were_withheld():
    assert mask(NEW, known(SAME, SAME, withheld(NEW), withheld(NEW))) == [True]
    assert mask(NEW, known(SAME, SAME, NEW, withheld(NEW))) == [True]
    assert mask(NEW, known(SAME, SAME, SAME, SAME, SAME, withheld(NEW))) == [False]


def test_a_modified_voxel_needs_fewer_votes(monkeypatch):
    """2 of 5 exceeds 0.7 x 0.5, and not 0.7 x 0.6."""
    monkeypatch.setattr("gnd.cloud_merger.wants.WANT_SHARE", 0.7)
    assert mask(MODIFIED, known(SAME, SAME, SAME, MODIFIED)) == [True]
    assert mask(NEW, known(SAME, SAME, SAME, NEW)) == [False]
    paper = MergeParameters(mode="paper", xi=0.6)
    assert mask(NEW, known(), merge=paper) == [True]


@pytest.mark.parametrize(("in_hand", "expected"), [(0, True), (3, True), (4, False), (9, False)])
def test_what_is_in_hand_often_enough_is_not_asked_for(in_hand, expected):
    assert mask(NEW, known(*[NEW] * in_hand, withheld(NEW))) == [expected]
    assert mask(MODIFIED, known(*[MODIFIED] * in_hand, withheld(MODIFIED))) == [expected]


def test_what_was_promised_by_others_counts_as_in_hand():
    assert mask(NEW, known(NEW, promised=[3, 3, 7])) == [True]
    assert mask(NEW, known(NEW, promised=[3, 3, 3, 7])) == [False]


def test_gaussians_of_an_earlier_change_are_not_those_of_a_later_one():
    """Four measured what was published since; a vehicle that compared with that denies it."""
    published = concat([BASE.take(BASE.voxel_id != 1), flagged(modified={1: WALL_AGAIN}).changed])
    later = flagged(modified={1: GROUND_AGAIN}, base=published, version=2)
    held = known(*[MODIFIED] * 4, bases={sha_of(published): published})
    assert mask(later, held) == [True]
    more = known(*[MODIFIED] * 4, *[later] * 4, bases={sha_of(published): published})
    assert mask(later, more) == [False]
    assert mask(MODIFIED, held) == [False], "who compares with the old map confirms the earlier change"


def test_who_saw_the_published_change_confirmed_supports_whoever_flags_it_anew():
    published = concat([BASE, NEW.changed])
    confirmed = flagged(base=published, version=2)
    assert mask(NEW, known(SAME, SAME, confirmed, confirmed, bases={sha_of(published): published})) == [True]


def test_the_own_report_among_the_known_does_not_count():
    own = report_of(99, NEW)
    held = Known(BASE, TileVotes.of([Report(own.report_id, NEW)] * 9), BASES)
    assert wanted(own, {TILE: held}, MERGE, WantParameters(enough=1)).mask.tolist() == [True]


def test_votes_are_weighed_as_the_merge_weighs_them():
    """The only witness against it has a poor sensor."""
    weak = Known(BASE, TileVotes.of([Report(f"{n:026d}", SAME, weight=0.5) for n in range(2)]), BASES)
    assert mask(NEW, weak) == [True]
    assert mask(NEW, known(SAME, SAME)) == [False]


def test_masks_run_over_tiles_and_voxels_in_order():
    changes = [
        flagged(new={3: POLE, 4: POLE}),
        flagged(modified={1: WALL_AGAIN}, tile=NEIGHBOUR),
        flagged(deleted=(2,)),
    ]
    first, second = sorted(changes[:2], key=lambda change: change.tile)
    report: ChangeReport = report_of(99, first, second)
    bases = {sha_of(BASE, tile): BASE for tile in (TILE, NEIGHBOUR)}
    full = Known(BASE, TileVotes.of([Report(f"{n:026d}", changes[0]) for n in range(9)]), bases)
    found = wanted(report, {TILE: full, NEIGHBOUR: Known(BASE, bases=bases)}, MERGE, WantParameters()).mask
    asked = asked_voxels(report, found)
    assert {tile: ids.tolist() for tile, ids in asked.items()} == {TILE: [], NEIGHBOUR: [1]}
    assert sorted(found.tolist()) == [False, False, True]


def test_of_many_outvoted_flags_some_are_asked_for_to_test_the_poses():
    many = {3 + k: POLE for k in range(100)}
    change, quiet = flagged(new=many), flagged(observed=range(103))
    against = known(*[quiet] * 3)
    assert 32 <= sum(mask(change, against)) <= 50
    assert mask(change, against, WantParameters(sample=0)) == [False] * 100
    assert mask(change, against, WantParameters(sample=101)) == [False] * 100
    half = flagged(new={3 + k: POLE for k in range(51)}, observed=range(103))
    confirmed = known(quiet, *[half] * 4)
    assert sum(mask(change, confirmed)) == 0, "who is right about most of it is not tested for the rest"


def test_absurd_parameters_are_refused():
    with pytest.raises(MergerError, match="sample = -1 lies outside ≥ 0"):
        WantParameters(sample=-1)
    with pytest.raises(MergerError, match="enough = -1 lies outside ≥ 0"):
        WantParameters(enough=-1)


def test_a_tile_is_hopeless_where_nothing_that_is_flagged_could_win():
    def hopeless(change, *others):
        found = wanted(report_of(99, change), {TILE: known(*others)}, MERGE, WantParameters())
        return found.hopeless == {TILE}

    assert hopeless(NEW, SAME, SAME)
    assert not hopeless(NEW, SAME)
    assert not hopeless(flagged(new={3: POLE}, deleted=(2,)), SAME, SAME), "what is gone needs no Gaussian to win"
    assert not hopeless(NEW, *[NEW] * 4), "enough Gaussians are in hand, and it wins"
    assert not hopeless(SAME, SAME)
    many = {3 + k: POLE for k in range(100)}
    assert not hopeless(flagged(new=many), *[flagged(observed=range(103))] * 3), "some are asked for to test the poses"
