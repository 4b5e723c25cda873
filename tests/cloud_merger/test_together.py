"""What vehicles met and none decides upon, decided together; and all that may not be decided so."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from merger_world import BALL, GROUND, POLE, WALL, WALL_AGAIN, change_of, gaussians_of, report_id, sha_of

from gnd.cloud_merger.agreement import agreement_of
from gnd.cloud_merger.hearing import Said, heard, spoken_of, without_silent
from gnd.cloud_merger.merge import MergeParameters, merge_tile
from gnd.cloud_merger.statements import Report, statements_of
from gnd.cloud_merger.together import LEAST_AREA_M2, TOGETHER_CELLS, met_together
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians
from gnd.schemas.limits import MAX_UNSURE_CELLS

EPOCH = gaussians_of({0: GROUND, 1: WALL})
SOME, MUCH = 5, 10


def met(states, cells=MUCH):
    return gaussians_of(states, cells, cells)


def says(number, vehicle, unsure=None, changed=None, observed=(0, 1), base=EPOCH):
    """A report: it is unsure of some voxels, calls others new, and finds the rest as it was."""
    change = change_of(base, sorted({*observed, *(changed or {})}), changed or {}, change_class=ChangeClass.NEW)
    change = replace(change, unsure=unsure or Gaussians.empty())
    at_ns = number * 3_600_000_000_000
    return Report(report_id(number), change, vehicle=vehicle, first_ns=at_ns, last_ns=at_ns, received_ns=at_ns)


def merged(*reports, epoch=EPOCH, mode="default"):
    bases = {sha_of(one): one for one in (EPOCH, epoch)}
    return merge_tile(epoch, statements_of(epoch, reports, bases, mode), MergeParameters(mode=mode))


def unsure(vehicles, cells=MUCH, state=WALL):
    return [says(k, name, met({7: state}, cells)) for k, name in enumerate(vehicles)]


def test_two_that_met_much_make_a_voxel_new_with_what_both_met():
    lower, upper = (0.3, 0.0, -0.25, 0.02, 0.28, 0.1), (0.3, 0.0, 0.25, 0.02, 0.28, 0.1)
    result = merged(says(0, "a", met({7: lower})), says(1, "b", met({7: upper})))
    assert result.changed.tolist() == [7]
    assert result.provenance == {7: (report_id(0), report_id(1))}
    found = result.gaussians.select(np.array([7], np.int32))
    assert np.allclose(found.mean_m, [[0.3, 0.0, 0.0]], atol=1e-6)
    assert found.full_cov()[0, 2, 2] == pytest.approx(0.1**2 + 0.25**2, rel=1e-5)


@pytest.mark.parametrize(
    ("numbers", "decides"),
    [
        ([MUCH], False),
        ([MAX_UNSURE_CELLS], False),
        ([MUCH, MUCH], True),
        ([SOME, SOME], False),
        ([SOME, SOME, SOME], True),
        ([MAX_UNSURE_CELLS, SOME], False),  # nobody counts for more than all others together
        ([MAX_UNSURE_CELLS, TOGETHER_CELLS // 2], True),
    ],
)
def test_the_sum_decides_in_which_nobody_counts_for_more_than_all_others(numbers, decides):
    reports = [says(k, f"car-{k}", met({7: WALL}, cells)) for k, cells in enumerate(numbers)]
    assert (merged(*reports).changed.tolist() == [7]) == decides


def test_many_reports_of_one_vehicle_are_one_word():
    assert not len(merged(*unsure(["liar"] * 9, MAX_UNSURE_CELLS)).changed)
    assert len(merged(*unsure([""] * 2)).changed) == 1, "without a name each report is a vehicle"


def test_who_calls_it_new_alone_counts_with_those_who_met_something():
    """It and one that met some are two votes; two that met some and nobody else decide nothing."""
    one, two = says(8, "a", changed={7: WALL}), says(9, "b", met({7: WALL_AGAIN}, SOME))
    empty = says(10, "c", observed=(0, 1, 7))
    three = [says(11, "d", met({7: WALL}, SOME)), two, one, empty]
    assert set(merged(*three).provenance[7]) == {report_id(k) for k in (8, 9, 11)}
    assert not len(merged(one, empty).changed)


def test_those_who_saw_it_empty_outvote_what_moved_through():
    """Three met something where a car drove by; three others looked and met nothing."""
    empty = [says(10 + k, f"other-{k}", observed=(0, 1, 7)) for k in range(3)]
    assert not len(merged(*unsure(["a", "b", "c"]), *empty).changed)
    assert len(merged(*unsure(["a", "b", "c"]), *empty[:1]).changed) == 1


def test_what_the_map_holds_is_not_added_up():
    """A newer version has it already; or the vehicle claims to be unsure where there is a wall."""
    healed = gaussians_of({0: GROUND, 1: WALL, 7: POLE})
    assert merged(*unsure(["a", "b", "c"]), epoch=healed).gaussians == healed
    assert not len(merged(*(says(k, f"car-{k}", met({1: BALL}), observed=(0,)) for k in range(5))).changed)


@pytest.mark.parametrize("mode", ["paper", "paper-observers"])
def test_the_papers_rules_know_nothing_of_it(mode):
    assert not len(merged(*unsure(["a", "b", "c"]), mode=mode).changed)


def test_nobody_judges_and_nobody_is_judged_by_what_all_decide_together():
    """Five vehicles decide together upon twenty voxels; three that saw them empty have missed nothing, and the five
    have claimed nothing.
    """
    ids = range(20, 40)
    five = [says(k, f"car-{k}", met(dict.fromkeys(ids, WALL))) for k in range(5)]
    three = [says(10 + k, f"other-{k}", observed=(0, 1, *ids)) for k in range(3)]
    statements = statements_of(EPOCH, [*five, *three], {sha_of(EPOCH): EPOCH})
    result = merge_tile(EPOCH, statements, MergeParameters())
    assert result.changed.tolist() == list(ids)
    spoken = spoken_of(EPOCH, statements, result.for_epoch, {})
    assert (spoken.said[spoken.voter < 5] == Said.OPEN).all()
    found = heard(EPOCH, statements, spoken)
    assert found.silent == ()
    assert not any(test.is_refuted for test in agreement_of(EPOCH, statements, spoken, found).tests)


def test_who_is_not_heard_about_new_things_is_not_heard_about_what_it_met():
    """It invents twenty voxels that five others see empty, and is unsure of a last one: that counts as little."""
    ids = range(20, 40)
    liar = says(0, "liar", met({7: WALL}), changed=dict.fromkeys(ids, BALL))
    others = [says(1 + k, f"car-{k}", observed=(0, 1, *ids)) for k in range(4)]
    other = says(9, "met", met({7: WALL}), observed=(0, 1, *ids))
    statements = statements_of(EPOCH, [liar, *others, other], {sha_of(EPOCH): EPOCH})
    result = merge_tile(EPOCH, statements, MergeParameters())
    assert 7 in result.changed
    found = heard(EPOCH, statements, spoken_of(EPOCH, statements, result.for_epoch, {}))
    assert found.silent == (("liar", Said.NEW),)
    left = without_silent(statements, found).rows
    assert left["report"][left["voxel_id"] == 7].tolist() == [5]


def test_reports_of_before_give_the_same_statements_to_the_bit():
    """Without anything that is met, nothing is different."""
    reports = [says(k, f"car-{k}", changed={7: WALL_AGAIN}, observed=(0, 1, 8)) for k in range(3)]
    rows = statements_of(EPOCH, reports, {sha_of(EPOCH): EPOCH}).rows
    assert rows["claim"].tolist() == [True] * 3
    assert rows["voxel_id"].tolist() == [7] * 3


def test_the_corner_of_a_thing_is_not_new_however_many_meet_it():
    """Twenty vehicles met a patch of 25 cm x 25 cm; a pole of 6 cm is as little. Twice as large a patch is new."""
    for state in ((0.4, 0.4, 0.4, 0.01, 0.07, 0.07), POLE):
        assert not len(merged(*unsure([f"car-{k}" for k in range(20)], state=state)).changed)
    assert len(merged(*unsure(["a", "b"], state=(0.2, 0.2, 0.2, 0.01, 0.14, 0.14))).changed) == 1


def plain(epoch, told, new, voter, turn):
    """What is added up, one voxel at a time: {voxel: reports that vote}."""
    found = {}
    words = defaultdict(dict)
    for r in np.argsort(turn).tolist():
        for voxel, cells in [
            *zip(told[r].voxel_id.tolist(), told[r].cells.tolist(), strict=True),
            *((v, 0) for v in new[r]),
        ]:
            words[int(voxel)][int(voter[r])] = r, cells
    some = {int(voxel) for one in told for voxel in one.voxel_id}
    for voxel in sorted(some - {int(one) for one in epoch.voxel_id}):
        each = {of: cells or MAX_UNSURE_CELLS for of, (_, cells) in words[voxel].items()}
        capped = [min(cells, sum(each.values()) - cells) for cells in each.values()]
        votes = sorted(r for r, cells in words[voxel].values() if cells)
        if sum(capped) >= TOGETHER_CELLS and votes and area_m2(voxel, [told[r] for r in votes]) >= LEAST_AREA_M2:
            found[voxel] = votes
    return found


def area_m2(voxel, told):
    """Of a rectangle with the spread of all that was met."""
    each = [one.select(np.array([voxel], np.int32)) for one in told]
    weight = np.array([one.cells[0] for one in each]) / sum(one.cells[0] for one in each)
    mean = sum(w * one.mean_m[0] for w, one in zip(weight, each, strict=True))
    off = [one.mean_m[0] - mean for one in each]
    cov = sum(w * (one.full_cov()[0] + np.outer(d, d)) for w, one, d in zip(weight, each, off, strict=True))
    a, b, c = np.linalg.eigvalsh(cov)
    return 12 * np.sqrt(a * b + a * c + b * c)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=150, deadline=None)
def test_any_reports_are_added_up_as_one_voxel_at_a_time_and_in_any_order(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(0, 9))
    told, new = [], []
    for _ in range(n):
        ids = np.flatnonzero(rng.random(12) < 0.5)
        is_new = rng.random(len(ids)) < 0.3
        states = {int(v): (*rng.uniform(-0.4, 0.4, 3), *rng.uniform(0.02, 0.3, 3)) for v in ids[~is_new]}
        some = met(states)
        cells = rng.integers(1, MAX_UNSURE_CELLS + 1, len(some)).astype(np.int32)
        told.append(Gaussians(some.voxel_id, cells, cells.copy(), some.mean_m, some.cov_m2))
        new.append(ids[is_new].astype(np.int32))
    voter, turn = rng.integers(0, 5, n), rng.permutation(n)
    found = met_together(EPOCH, told, new, voter, turn)
    votes = defaultdict(list)
    for voxel, report in zip(found.voxel_id.tolist(), found.report.tolist(), strict=True):
        votes[voxel].append(report)
    assert votes == plain(EPOCH, told, new, voter, turn)
    for voxel, reports in votes.items():
        rows = found.voxel_id == voxel
        weight = np.array([told[r].select(np.array([voxel], np.int32)).cells[0] for r in reports], float)
        mean = np.stack([told[r].select(np.array([voxel], np.int32)).mean_m[0] for r in reports])
        assert np.allclose(found.mean_m[rows], (weight @ mean) / weight.sum(), atol=1e-6)
        six = Gaussians(np.arange(rows.sum(), dtype=np.int32), *(np.full(rows.sum(), 20, np.int32),) * 2,
                        found.mean_m[rows], found.cov_m2[rows])  # fmt: skip
        assert np.linalg.eigvalsh(six.full_cov()).min() > 0.0
