"""The model of the cloud's queues against answers that are known, and against bad input."""

import random
from dataclasses import replace

import numpy as np
import pytest

from studies.frame.errors import OptionError
from studies.scale.model import CloudModel, CpuCosts, HostRules, SimulatedReport

NOTHING = CpuCosts(0.0, 0.0, 0.0, 0.0)
SERVICE_S = 0.01


def poisson(per_s, count, seed=1, says=(), shards=1):
    rng, at_s, found = random.Random(seed), 0.0, []
    for n in range(count):
        at_s += rng.expovariate(per_s)
        found.append(SimulatedReport(at_s, n % shards, says))
    return found


@pytest.mark.parametrize("use", [0.3, 0.6, 0.8])
def test_acks_of_one_shard_are_a_queue_with_fixed_service(use):
    rules = HostRules(shards=1, slice_s=1.0)  # never interrupted: first come, first served
    run = CloudModel(replace(NOTHING, receive_s=SERVICE_S), rules).run(poisson(use / SERVICE_S, 4_000), 1e6)
    known_s = SERVICE_S * (1.0 + use / (2.0 * (1.0 - use)))  # M/D/1, Pollaczek and Khinchine
    assert np.mean(run.acks_s) == pytest.approx(known_s, rel=0.1)
    assert run.busy_s == pytest.approx(4_000 * SERVICE_S)
    assert run.is_drained


def test_slices_share_a_core():
    rules = HostRules(shards=1, slice_s=SERVICE_S / 20)
    run = CloudModel(replace(NOTHING, receive_s=SERVICE_S), rules).run(poisson(0.6 / SERVICE_S, 2_000), 1e6)
    assert np.mean(run.acks_s) == pytest.approx(SERVICE_S / (1.0 - 0.6), rel=0.1)  # M/G/1, processor sharing


def test_two_shards_have_two_queues_and_one_core_is_one():
    costs = replace(NOTHING, receive_s=SERVICE_S)
    reports = poisson(1.5 / SERVICE_S, 3_000, shards=2)  # one core is not enough for it, two are
    two = CloudModel(costs, HostRules(cores=2, shards=2)).run(reports, 1e6)
    one = CloudModel(costs, HostRules(cores=1, shards=2)).run(reports, 1e6)
    assert one.ended_s == pytest.approx(3_000 * SERVICE_S, rel=0.01)  # the core never rests
    assert two.ended_s == pytest.approx(reports[-1].at_s, rel=0.05)


def test_a_lonely_report_waits_for_the_merge_delay_and_its_own_work():
    costs = CpuCosts(receive_s=0.002, flags_s=0.01, half_s=0.004, merge_s=0.03, news=1e9, answer_s=0.1)
    rules = HostRules(shards=1, merge_delay_s=0.5)
    plain = CloudModel(costs, rules).run([SimulatedReport(0.0, 0, ((7, "plain"),))], 60.0)
    assert plain.lags_s == pytest.approx([0.002 + 0.01 + 0.5 + 0.03], abs=0.01)
    asked = CloudModel(costs, rules).run([SimulatedReport(0.0, 0, ((7, "asked"),))], 60.0)
    first_s, half_s = sorted(asked.lags_s, reverse=True)
    assert first_s - half_s == pytest.approx(0.002 + 0.01 + 0.1, abs=0.01)  # the second half came so much later
    assert half_s == pytest.approx(0.002 + 0.004 + 0.5 + 0.03, abs=0.01)
    assert asked.merges == 1
    quiet = CloudModel(costs, rules).run([SimulatedReport(0.0, 0, ((7, "quiet"),))], 60.0)
    assert (quiet.merges, quiet.is_drained) == (0, True)


def test_what_was_known_is_merged_again_and_changes_nothing():
    costs, reports = replace(NOTHING, merge_s=0.03, news=1e9), [SimulatedReport(0.0, 0, ((7, "plain"),))]
    run = CloudModel(costs, HostRules(shards=1), again=lambda street: 1.0 - street).run(reports, 60.0)
    assert (run.merges, run.versions, len(run.lags_s), run.is_drained) == (2, 1, 1, True)
    other = [replace(reports[0], says=((1007, "plain"),))]  # of another street
    assert CloudModel(costs, HostRules(shards=1), again=lambda street: 1.0 - street).run(other, 60.0).merges == 1


def test_costs_of_a_core_that_is_worth_less():
    costs = CpuCosts(0.001, 0.002, 0.003, 0.004, begin_s=0.1, publish_s=0.001, notice_share=0.1, news=3.0)
    slow = costs.times(1.5)
    assert (slow.receive_s, slow.flags_s, slow.half_s) == pytest.approx((0.0015, 0.003, 0.0045))
    assert (slow.merge_s, slow.publish_s, slow.begin_s) == pytest.approx((0.006, 0.0015, 0.15))
    assert (slow.notice_share, slow.news, slow.answer_s) == (0.1, 3.0, costs.answer_s)


def test_beyond_saturation_more_reports_go_into_a_merge():
    costs = CpuCosts(receive_s=0.001, flags_s=0.002, half_s=0.0, merge_s=0.1, news=1e9)
    says = tuple((tile, "plain") for tile in range(8))
    light, heavy = (CloudModel(costs, HostRules()).run(poisson(per_s, 60, says=says), 600.0) for per_s in (0.3, 20.0))
    assert light.is_drained
    assert heavy.is_drained
    assert heavy.merges < light.merges / 2
    assert heavy.busy_s < light.busy_s / 2


def test_publications_have_the_database_alone():
    costs = CpuCosts(0.0, 0.0, 0.0, merge_s=0.02, publish_s=0.02, news=1e9)
    reports = [SimulatedReport(0.0, n % 8, ((n, "plain"),)) for n in range(80)]
    rules = HostRules(cores=8, shards=8, merge_delay_s=0.1)
    alone = CloudModel(costs, rules).run(reports, 60.0)
    beside = CloudModel(replace(costs, publish_s=0.0), rules).run(reports, 60.0)
    assert alone.ended_s >= 0.1 + 80 * 0.02
    assert beside.ended_s < alone.ended_s / 2


def test_a_run_that_is_not_done_says_so():
    run = CloudModel(replace(NOTHING, receive_s=1.0), HostRules(shards=1)).run(poisson(100.0, 50), 5.0)
    assert not run.is_drained
    assert run.ended_s == pytest.approx(5.0)
    assert len(run.acks_s) < 50


@pytest.mark.parametrize(
    "wrong",
    [{"receive_s": -1.0}, {"merge_s": float("nan")}, {"database_share": 1.5}, {"news": 0.0}, {"publish_s": 9.0}],
)
def test_costs_that_cannot_be_are_refused(wrong):
    with pytest.raises(OptionError):
        replace(NOTHING, **wrong)


@pytest.mark.parametrize("wrong", [{"cores": 0}, {"shards": 0}, {"poll_s": 0.0}, {"slice_s": 0.0}])
def test_hosts_that_cannot_be_are_refused(wrong):
    with pytest.raises(OptionError):
        HostRules(**wrong)
